"""The fields of a dataclass as a form needs them: type, choices, default, and the docstring under each."""

import ast
import dataclasses
import functools
import inspect
import itertools
import textwrap
import typing

import msgspec


class Field(msgspec.Struct, frozen=True):
    """One setting."""

    name: str
    type: str
    default: object
    choices: list[object] | None = None
    doc: str = ""


def fields_of(instance: typing.Any) -> list[Field]:
    """Return what can be set in a dataclass, with the values of `instance` as defaults."""
    kind = type(instance)
    hints, docs = typing.get_type_hints(kind), _docs(kind)
    found = []
    for field in dataclasses.fields(kind):
        if field.init:
            choices = list(typing.get_args(hints[field.name])) or None
            default = getattr(instance, field.name)
            name = type(default).__name__ if choices else getattr(hints[field.name], "__name__", "object")
            found.append(Field(field.name, name, default, choices, docs.get(field.name, "")))
    return found


@functools.cache
def _docs(kind: type) -> dict[str, str]:
    """Return the string that follows each annotated field in the source, inherited ones too; Python keeps none."""
    docs: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base):
            docs |= _docs_in_source(base)
    return docs


def _docs_in_source(kind: type) -> dict[str, str]:
    try:
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    except (OSError, TypeError, SyntaxError):
        return {}
    docs = {}
    body = typing.cast(ast.ClassDef, definition).body
    for field, after in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(after, ast.Expr):
            text = after.value
            if isinstance(text, ast.Constant) and isinstance(text.value, str):
                docs[field.target.id] = inspect.cleandoc(text.value)
    return docs
