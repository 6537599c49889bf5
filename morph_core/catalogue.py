"""What there is to choose from, plug-ins included: tasks, methods, explorations and searches by name."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from morph_core.config import Settings, check_value, flattened, guess, kinds_of, paths_of, range_of
from morph_core.contract import check_task
from morph_core.exploration import Exploration
from morph_core.format_1 import RENAMED
from morph_core.method import Method
from morph_core.presets import method_of, with_preset
from morph_core.protocol import RunRecord
from morph_core.registry import Broken, Registry
from morph_core.search import Search
from morph_core.task import Task

S = TypeVar("S", bound=Settings)


def _with_defaults(kind: Callable[[], Any]) -> Any:
    """Make one with its defaults, whatever that raises."""
    return kind()


def _check_task(kind: Callable[[], Any]) -> None:
    check_task(_with_defaults(kind))


TASKS: Registry[Task] = Registry(
    "morph.tasks", Task, "morph_core.tasks", ("reacher", "pen_press", "mouse_click"), _check_task
)
METHODS: Registry[Method] = Registry("morph.methods", Method, "morph_core.methods", ("morph",), _with_defaults)
EXPLORATIONS: Registry[Exploration] = Registry(
    "morph.explorations", Exploration, "morph_core.explorations", ("design",), _with_defaults
)
SEARCHES: Registry[Search] = Registry("morph.searches", Search, "morph_core.searches", ("cma",), _with_defaults)


def broken_plugins() -> list[Broken]:
    """Return every installed plug-in that can't be used, with the reason."""
    return [broken for registry in (TASKS, METHODS, EXPLORATIONS, SEARCHES) for broken in registry.broken]


def choices_of(annotation: Any) -> Registry[Any] | None:
    """Return the registry from which a field with this annotation takes its value; None for any other field."""
    bare, _ = range_of(annotation)
    return {Exploration: EXPLORATIONS, Search: SEARCHES}.get(bare)


def make_task(name: str, options: Mapping[str, object] | None = None) -> Task:
    """Return the task `name` with its dataclass fields set to `options`; ValueError lists the choices."""
    kind: Any = TASKS[name]
    allowed = [field.name for field in dataclasses.fields(kind) if field.init]
    for option in options or {}:
        if option not in allowed:
            raise ValueError(f'{name} has no option "{option}"; choose from: {", ".join(allowed)}')
    return kind(**(options or {}))


def make_method(
    name: str | None,
    task: Task | None = None,
    settings: Mapping[str, object] | None = None,
    preset: str | None = None,
) -> Method:
    """Return the method `name` with what was found to work for the task, and with `settings` on top.

    `settings` have dotted names (`search.ridge`) or are nested; they are laid over those of the `preset`. Without a
    name it is the preset's method, or else morph. ValueError lists what can be set: a setting that does nothing for
    the chosen method, exploration or search is refused, too.
    """
    chosen = method_of(preset) if name is None else name
    kind: Any = METHODS[chosen]
    wanted = with_preset(preset, chosen, task, settings or {})
    tuned = task.tuned if task else ()
    method = configured(_tuned_for(kind, tuned), wanted, tuned)
    if task:
        method.check(task)
    return method


def _tuned_for(kind: type[Method], tuned: tuple[Settings, ...]) -> Method:
    """Return a method as the task has it; one that it does not know gets the task's shared settings and parts."""
    for settings in tuned:
        if type(settings) is kind:
            return settings
    method = kind()
    known = next((settings for settings in tuned if isinstance(settings, Method)), method)
    parts = {type(part): part for settings in tuned for part in (settings, *_parts_of(settings))}
    shared = {field.name: getattr(known, field.name) for field in dataclasses.fields(Method)}
    own = {
        field.name: parts[type(getattr(method, field.name))]
        for field in dataclasses.fields(kind)
        if type(getattr(method, field.name)) in parts
    }
    return dataclasses.replace(method, **shared | own)


def _parts_of(settings: Settings) -> list[Settings]:
    values = (getattr(settings, field.name) for field in dataclasses.fields(settings))
    return [value for value in values if isinstance(value, Settings)]


def alternatives(part: Settings, kind: Any, task: Task) -> dict[str, Settings]:
    """Return what the task can be given in a field with this annotation, by name, as the task has tuned it.

    `part` is the present one. Empty for a field that leaves no choice.
    """
    found: dict[str, Settings] = {}
    for name in choices_of(kind) or ():
        other = _chosen(part, kind, name, task.tuned)
        with contextlib.suppress(ValueError):
            other.check(task)  # pyright: ignore[reportAttributeAccessIssue] - explorations and searches have it
            found[name] = other
    return found


def _chosen(part: Settings, kind: Any, name: str, tuned: tuple[Settings, ...]) -> Settings:
    """Return the exploration or search `name`: the present one, the one among `tuned`, or one with its defaults."""
    registry: Any = choices_of(kind)
    wanted = registry[name]
    return next((settings for settings in (part, *tuned) if type(settings) is wanted), None) or wanted()


def configured(base: S, settings: Mapping[str, object], tuned: tuple[Settings, ...] = ()) -> S:
    """Return `base` with settings under dotted names, or nested, applied.

    Where another exploration or search is chosen, it is the one among `tuned`, or else has its own defaults. Raise
    ValueError that lists what can be set.
    """
    flat = flattened(dict(settings))
    chosen = _with_parts(base, flat, tuned)
    allowed = dict(paths_of(chosen))
    for name in flat:
        if name not in allowed:
            raise ValueError(_refusal(name, list(allowed), chosen))
    return _with_values(chosen, flat)


def _with_parts(base: S, flat: Mapping[str, object], tuned: tuple[Settings, ...], prefix: str = "") -> S:
    """Return `base` with the parts that are chosen by name."""
    changes: dict[str, Settings] = {}
    for name, kind in _fields(base):
        value, path = getattr(base, name), prefix + name
        if not isinstance(value, Settings):
            continue
        if path in flat and choices_of(kind):
            value = _chosen(value, kind, str(flat[path]), tuned)
        changes[name] = _with_parts(value, flat, tuned, f"{path}.")
    return dataclasses.replace(base, **changes)


def _with_values(base: S, flat: Mapping[str, object], prefix: str = "") -> S:
    """Return `base` with all plain values applied, each checked under its whole name."""
    changes: dict[str, object] = {}
    for name, kind in _fields(base):
        value, path = getattr(base, name), prefix + name
        if isinstance(value, Settings):
            changes[name] = _with_values(value, flat, f"{path}.")
        elif path in flat:
            changes[name] = check_value(path, kind, flat[path])
    return dataclasses.replace(base, **changes)


def _fields(settings: Settings) -> list[tuple[str, Any]]:
    """Return name and annotation of what can be set."""
    kinds = kinds_of(type(settings))
    return [(field.name, kinds[field.name]) for field in dataclasses.fields(settings) if field.init]


def _refusal(name: str, allowed: list[str], chosen: Settings) -> str:
    """Return the sentence on a setting that can't be set here."""
    list_of = f"choose from: {', '.join(allowed)}"
    if name in RENAMED:
        return f'"{name}" is called {" or ".join(RENAMED[name])} now; {list_of}'
    below = [other for other in allowed if other.startswith(f"{name}.")]
    if below:
        return f'"{name}" has settings of its own; choose from: {", ".join(below)}'
    head, _, rest = name.partition(".")
    registry = choices_of(kinds_of(type(chosen)).get(head))
    owners = [other for other in registry or () if rest in dict(paths_of(registry[other]()))] if registry else []
    if owners:
        present = getattr(getattr(chosen, head), "name", "")
        inside = ", ".join(other for other in allowed if other.startswith(f"{head}."))
        return f'"{name}" does nothing with {head} {present}, only with {" or ".join(owners)}; choose from: {inside}'
    others = [other for other in METHODS if name in _everything(METHODS[other]())]
    if others and isinstance(chosen, Method):
        return f'"{name}" does nothing for {chosen.name}, only for {" or ".join(others)}; {list_of}'
    return f'unknown setting "{name}"{guess(name, allowed)}; {list_of}'


def _everything(method: Method) -> set[str]:
    """Return whatever can be set for a method with one of its explorations and searches or another."""
    names = {name for name, _ in paths_of(method)}
    for field, kind in _fields(method):
        registry: Any = choices_of(kind) or {}
        for other in registry:
            names |= {f"{field}.{name}" for name, _ in paths_of(registry[other]())}
    return names


def read_method(record: RunRecord) -> Method:
    """Return the method of a run as it was recorded; ValueError where this version can't run it so."""
    kind: Any = METHODS[record.method]
    if record.format > 1:
        return configured(kind(), record.config)
    recorded = record.config  # under today's names, but with all that did nothing
    chosen = {name: recorded[name] for name in ("exploration", "search") if name in recorded}
    allowed = dict(paths_of(_with_parts(kind(), chosen, ())))
    return configured(kind(), {name: value for name, value in recorded.items() if name in allowed})
