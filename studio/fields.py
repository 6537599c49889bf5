"""What can be set, as a form needs it: names, types, ranges, choices, defaults, and the docstring under each field."""

import ast
import dataclasses
import functools
import inspect
import itertools
import textwrap
import threading
import typing
from collections.abc import Iterator

import msgspec

from morph_core.catalogue import alternatives
from morph_core.config import Settings, kinds_of, limits, range_in_signs, range_of
from morph_core.method import Method
from morph_core.task import Task


class Field(msgspec.Struct, frozen=True, kw_only=True):
    """One setting: its name, type and default, and what is allowed."""

    name: str
    """Name of the setting, dotted where it belongs to a part: `search.ridge`."""
    type: str
    default: object
    choices: list[object] | None = None
    doc: str = ""
    lo: float | None = None
    """Smallest value that is allowed, or the one above which the setting must lie; None for no such end."""
    hi: float | None = None
    """Largest value that is allowed, or the one below which the setting must lie; None for no such end."""
    range: str = ""
    """Range that is allowed, for people: "> 0, ≤ 1"."""
    only_with: str | None = None
    """Choice in the field before the dot with which this setting does something; None where any does."""


def fields_of(instance: object) -> list[Field]:
    """Return what can be set in a dataclass, with the values of `instance` as defaults."""
    return [
        _field(instance, field.name, field.name) for field in dataclasses.fields(typing.cast(typing.Any, instance))
        if field.init
    ]  # fmt: skip


def settings_of(method: Method, task: Task) -> list[Field]:
    """Return every setting of a method for a task, those of each exploration and search that can be chosen, too."""
    return list(_settings(method, task, "", None))


def chosen_fields(method: Method, task: Task) -> list[Field]:
    """Return the settings that do something with the exploration and search that the method has."""
    return [field for field in settings_of(method, task) if _applies(field, method)]


def _applies(field: Field, method: Method) -> bool:
    head = field.name.split(".")[0]
    return field.only_with in (None, getattr(getattr(method, head), "name", None))


def _settings(settings: Settings, task: Task, prefix: str, only_with: str | None) -> Iterator[Field]:
    kinds = kinds_of(type(settings))
    for field in dataclasses.fields(settings):
        value, path = getattr(settings, field.name), prefix + field.name
        if not isinstance(value, Settings):
            yield msgspec.structs.replace(_field(settings, field.name, path), only_with=only_with)
            continue
        choices = alternatives(value, kinds[field.name], task)
        if not choices:
            yield from _settings(value, task, f"{path}.", only_with)
            continue
        present = typing.cast(typing.Any, value).name
        doc = docs_of(type(settings)).get(field.name, "")
        yield Field(name=path, type="str", default=present, choices=list(choices), doc=doc, only_with=only_with)
        for name, part in choices.items():
            yield from _settings(part, task, f"{path}.", name)


def _field(instance: object, name: str, path: str) -> Field:
    bare, meta = range_of(kinds_of(type(instance))[name])
    default, choices = getattr(instance, name), None
    if typing.get_origin(bare) is typing.Literal:
        choices = list(typing.get_args(bare))
    kind = type(default).__name__ if choices else getattr(bare, "__name__", "object")
    lo, hi = limits(meta)
    return Field(
        name=path, type=kind, default=default, choices=choices, doc=docs_of(type(instance)).get(name, ""),
        lo=lo, hi=hi, range=range_in_signs(meta),
    )  # fmt: skip


def told(field: Field) -> str:
    """Return what a form or a help text says of a field: its docstring, and what is allowed."""
    return f"{field.doc} Allowed: {field.range}." if field.range else field.doc


@functools.cache
def docs_of(kind: type) -> dict[str, str]:
    """Return the string that follows each annotated field in the source, inherited ones too; Python keeps none."""
    docs: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base):
            docs |= _docs_in_source(base)
    return docs


_one_at_a_time = threading.Lock()  # Python 3.11 fails where two threads parse at once: SystemError, recursion depth


def _docs_in_source(kind: type) -> dict[str, str]:
    try:
        with _one_at_a_time:
            (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    except (OSError, TypeError, SyntaxError):
        return {}
    docs = {}
    body = typing.cast(ast.ClassDef, definition).body
    for field, after in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(after, ast.Expr):
            text = after.value
            if isinstance(text, ast.Constant) and isinstance(text.value, str):
                docs[field.target.id] = " ".join(text.value.split())
    return docs
