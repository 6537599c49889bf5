"""The flags of a new run: those of its task, its method, and the exploration and search that were chosen."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

from morph_core.catalogue import METHODS, TASKS, broken_plugins, configured, make_method, make_task
from morph_core.config import paths_of
from morph_core.method import Method
from morph_core.presets import PRESETS, method_of
from morph_core.task import Task
from studio.cli.arguments import UsageError, options, parse, value_after
from studio.fields import Field, chosen_fields, docs_of, fields_of, told
from studio.new_run import resettled

_KINDS: dict[str, type] = {"int": int, "float": float, "str": str, "bool": bool}


@dataclass(frozen=True)
class Wanted:
    """What the words of a command line ask for."""

    arguments: Any
    """The arguments that are not the task's or the method's, with `method` and `seed` among them."""
    task_options: Mapping[str, object]
    """Fields of the task's dataclass that differ from their defaults."""
    settings: Mapping[str, object]
    """Settings of the method that differ from those found to work for the task, under dotted names; those of a preset
    are among them."""
    everything: Mapping[str, object]
    """All settings of the method that flags can give, under dotted names."""


def parse_wanted(
    kind: type, words: Sequence[str], command: str, recorded: tuple[Task, Method, int] | None = None
) -> Wanted:
    """Return what the words ask for; raise UsageError with one line.

    `kind` is a dataclass with the other arguments. Which flags there are, and their defaults, depends on the task,
    the method and its parts; `recorded` are those, and the seed, of a run that is resumed or branched from.
    """
    if recorded:
        task, method, seed = recorded
        return _parse(kind, words, command, task, method, seed)
    task = make_task(next((word for word in words if word in TASKS), next(iter(TASKS))))
    first = _parse(kind, words, command, task, _method_of(words, command, task))
    named = first.arguments.task
    if named not in TASKS:
        said = f'unknown task "{named[:40]}"' if named else "a task is missing"
        reasons = "".join(f"; {broken}" for broken in broken_plugins() if broken.name == named)
        raise UsageError(f"{said}; choose from: {', '.join(TASKS)}{reasons}")
    try:
        task = make_task(named, first.task_options)
    except ValueError as error:
        raise UsageError(f"{command}: {error}") from error
    again = _parse(kind, words, command, task, _method_of(words, command, task))
    return dataclasses.replace(again, task_options=first.task_options)


def branch_method(words: Sequence[str], command: str, task: Task, parent: Method) -> Method:
    """Return the method that the words name for a branch: that of its parent, unless they name another or a preset."""
    preset, asked = value_after(words, "--preset"), value_after(words, "--method")
    if preset in PRESETS or (asked in METHODS and asked != parent.name):
        return _method_of(words, command, task)
    try:
        return resettled(parent, task, _choices_in(words, parent, task))
    except ValueError as error:
        raise UsageError(f"{command}: {error}") from error


def _method_of(words: Sequence[str], command: str, task: Task) -> Method:
    """Return the method that the words name, with the exploration and search that they name.

    A choice that does not exist is left to the parser, which says what does.
    """
    preset, asked = value_after(words, "--preset"), value_after(words, "--method")
    preset = preset if preset in PRESETS else None
    name = asked if asked and asked in METHODS else method_of(preset)
    try:
        return make_method(name, task, _choices_in(words, make_method(name, task), task), preset)
    except ValueError as error:
        raise UsageError(f"{command}: {error}") from error


def _choices_in(words: Sequence[str], method: Method, task: Task) -> dict[str, str]:
    """Return what the words choose by name, such as the exploration and the search, where it is there to be chosen."""
    choices = {field.name: field.choices or [] for field in chosen_fields(method, task) if field.choices}
    wanted = {path: value_after(words, f"--{path.replace('_', '-')}") for path in choices}
    return {path: word for path, word in wanted.items() if word is not None and word in choices[path]}


def _parse(kind: type, words: Sequence[str], command: str, task: Task, method: Method, seed: int = 0) -> Wanted:
    fields = chosen_fields(method, task)
    flags = _flags(kind, task, method, fields, seed)
    _check_settings(list(options(flags)), words, command, task, method)
    asked: Any = parse(flags, words, command)
    found = {field.name: _value(asked, field) for field in fields}
    parts = {field.name: found[field.name] for field in fields if _is_choice(field, fields)}
    usual = dict(paths_of(make_method(method.name, task, parts))) | dict(
        item for item in paths_of(make_method(method.name, task)) if item[0] in parts
    )
    return Wanted(
        asked,
        {f.name: value for f in _offered(task) if (value := getattr(asked.options, f.name)) != f.default},
        {name: value for name, value in found.items() if value != usual.get(name)},
        found,
    )


def _is_choice(field: Field, fields: Sequence[Field]) -> bool:
    """Tell whether a field chooses one of several parts."""
    return any(other.name.startswith(f"{field.name}.") for other in fields)


def _offered(task: Task) -> list[Field]:
    """Return the options of a task that a flag can give."""
    return [field for field in fields_of(task) if field.type in _KINDS]


def _flags(kind: type, task: Task, method: Method, fields: Sequence[Field], seed: int) -> type:
    """Return a dataclass of all flags: each part of the method is a group of them, and so are the task's options."""
    docs = docs_of(type(method))
    groups = itertools.groupby((field for field in fields if "." in field.name), lambda field: field.name.split(".")[0])
    parts = [(f"{head}_part", *_group(head, docs.get(head, ""), list(inside))) for head, inside in groups]
    chosen = Annotated[Literal[tuple(METHODS)], tyro.conf.arg(help=_methods_help())]  # pyright: ignore
    own = _group("task", f"Options of {task.name}", _offered(task))
    words = tyro.conf.arg(metavar=f"{{{','.join(PRESETS)}}}", help=_presets_help())
    named = tyro.conf.arg(metavar="TASK", help=f"{docs_of(kind)['task']} Choose from: {', '.join(TASKS)}.")
    return dataclasses.make_dataclass(
        kind.__name__,
        [
            ("task", Annotated[str, tyro.conf.Positional, named], ""),
            ("preset", Annotated[Literal[tuple(PRESETS)] | None, words], None),  # pyright: ignore
            ("method", chosen, method.name),
            ("seed", Annotated[int, tyro.conf.arg(help="Seed of all randomness.")], seed),
            *(_flag(field) for field in fields if "." not in field.name),
            *parts,
            ("options", tyro.conf.OmitArgPrefixes[own[0]], own[1]),
        ],
        bases=(kind,),
        frozen=True,
        namespace={"__doc__": "\n\n".join([kind.__doc__ or "", *(f"Left out: {b}" for b in broken_plugins())])},
    )


def _group(name: str, doc: str, fields: Sequence[Field]) -> tuple[Any, Any]:
    """Return a dataclass of flags that share the prefix `name`, and one with their defaults."""
    flags = [_flag(field) for field in fields]
    kind = dataclasses.make_dataclass(name, flags, frozen=True, namespace={"__doc__": doc})
    return Annotated[kind, tyro.conf.arg(name=name)], kind()


def _flag(field: Field) -> tuple[str, Any, Any]:
    """Return one field of such a dataclass; a choice has another name in it than the group of what is chosen."""
    kind = Literal[tuple(field.choices)] if field.choices else _KINDS[field.type]  # pyright: ignore
    name = field.name.rpartition(".")[2]
    return name, Annotated[kind, tyro.conf.arg(name=name, help=told(field))], field.default


def _value(asked: Any, field: Field) -> object:
    head, _, name = field.name.rpartition(".")
    return getattr(getattr(asked, f"{head}_part") if head else asked, name)


def _methods_help() -> str:
    return "; ".join(f"{name}: {METHODS[name].title}" for name in METHODS) + "."


def _presets_help() -> str:
    said = " ".join(f"{name}: {preset.meaning}" for name, preset in PRESETS.items())
    return f"One word for a whole set of settings; other flags are laid over it. {said}"


def _check_settings(known: Sequence[str], words: Sequence[str], command: str, task: Task, method: Method) -> None:
    """Raise UsageError with the reason where a flag is a setting, but does nothing with what is chosen."""
    for word in words:
        flag = word.split("=")[0].replace("_", "-")
        if flag.startswith("--") and flag not in known:
            path = flag.removeprefix("--").replace("-", "_")
            try:
                configured(method, {path: 0}, task.tuned)
            except ValueError as error:
                if not str(error).startswith("unknown setting"):
                    raise UsageError(f"{command}: {error}") from error
