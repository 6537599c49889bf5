"""The arguments of one command: a dataclass is its flags, its docstrings are its help, an error is one line."""

import contextlib
import dataclasses
import difflib
import io
import itertools
import re
import typing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, TypeVar

import tyro

from morph_core.config import guess
from studio.fields import docs_of
from studio.settings import at_home, default_runs

T = TypeVar("T")
Count = Annotated[int, tyro.conf.arg(metavar="N")]
RunName = Annotated[str, tyro.conf.arg(metavar="RUN")]


class UsageError(ValueError):
    """Error of a command line that asks for what is not possible; the message says what is."""


@dataclass(frozen=True)
class RunsArguments:
    """Arguments of every command that works on runs."""

    runs: Annotated[Path, tyro.conf.arg(metavar="DIR")] = field(default_factory=default_runs)
    """Folder of the runs; by default MORPH_RUNS from the environment, else `runs`."""


def parse(kind: type[T], words: Sequence[str], command: str) -> T:
    """Return the arguments; raise UsageError with one line. `--help` prints and exits."""
    _check_options(kind, words)
    _tell(kind)
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return _at_home(
                tyro.cli(kind, prog=f"morph-studio {command}", args=list(words), config=(tyro.conf.FlagCreatePairsOff,))
            )
    except SystemExit as end:
        if end.code in (0, None):
            raise
    raise UsageError(f"{command}: {_one_line(said.getvalue())}")


def _tell(kind: type) -> None:
    """Let each flag's help be its docstring as one paragraph, and say a default only where there is one.

    The parser itself keeps the line ends that a docstring has in the source.
    """
    for base in kind.__mro__:
        if not dataclasses.is_dataclass(base):
            continue
        docs, own = docs_of(base), vars(base).get("__annotations__", {})
        for name, annotation in own.items():
            bare = typing.get_args(annotation)[0] if typing.get_origin(annotation) is Annotated else annotation
            if dataclasses.is_dataclass(bare) and isinstance(bare, type):
                _tell(bare)
                continue
            marks = _marks(annotation)
            if not any(getattr(mark, "help_behavior_hint", None) is _default for mark in marks):
                said = None if any(getattr(mark, "help", None) for mark in marks) else docs.get(name)
                own[name] = Annotated[annotation, tyro.conf.arg(help=said, help_behavior_hint=_default)]


def _marks(annotation: object) -> tuple[typing.Any, ...]:
    """Return what `Annotated` adds to a type."""
    return getattr(annotation, "__metadata__", ())


def _default(shown: str) -> str:
    """Return what the help says of a default; nothing where a flag may just be left out."""
    return "" if shown in ("None", "False", "", "''") else f"(default: {shown})"


def _at_home(arguments: T) -> T:
    """Return the arguments with ~ replaced in every path: shells do so only at the start of a word."""
    paths = {
        entry.name: at_home(value)
        for entry in dataclasses.fields(arguments)  # pyright: ignore[reportArgumentType]
        if isinstance(value := getattr(arguments, entry.name), Path)
    }
    return dataclasses.replace(arguments, **paths) if paths else arguments  # pyright: ignore[reportArgumentType]


def value_after(words: Sequence[str], option: str) -> str | None:
    """Return what the words give for an option, before they can be parsed; None where it is not among them."""
    for word, following in itertools.zip_longest(words, words[1:]):
        if word == option:
            return following
        if word.startswith(option + "="):
            return word.removeprefix(option + "=")
    return None


def options(kind: type, prefix: str = "") -> Iterator[str]:
    """Yield the flags that the fields of a dataclass become, those of nested dataclasses included."""
    hints = typing.get_type_hints(kind, include_extras=True)
    for entry in dataclasses.fields(kind):
        annotation = hints[entry.name]
        bare, marks = annotation, _marks(annotation)
        if typing.get_origin(annotation) is Annotated:
            bare = typing.get_args(annotation)[0]
        if not entry.init or tyro.conf.Positional in marks:
            continue
        name = next((mark.name for mark in marks if getattr(mark, "name", None)), entry.name)
        if dataclasses.is_dataclass(bare) and isinstance(bare, type):
            yield from options(bare, prefix if tyro.conf.OmitArgPrefixes in marks else f"{prefix}{name}.")
        else:
            yield "--" + (prefix + name).replace("_", "-")


def _check_options(kind: type, words: Sequence[str]) -> None:
    """Raise UsageError that lists the choices if a word is no option of this command."""
    known = [*options(kind), "--help"]
    for word in words:
        flag = word.split("=")[0].replace("_", "-")
        if flag.startswith("--") and flag not in known:
            near = difflib.get_close_matches(flag, known, 1)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise UsageError(f"unknown option {word.split('=')[0]}{hint}; choose from: {' '.join(known)}")


def _one_line(box: str) -> str:
    """Return what an error box says, without its frame, its title and the help that follows its rule.

    The title stands in the frame or, where the terminal can't show one, above a first rule.
    """
    lines = [re.sub(r"[╭╮╰╯│]", "", line).strip() for line in box.splitlines()]
    sections: list[list[str]] = [[]]
    for line in lines:
        if re.match(r"─|-+$", line):
            sections.append([])
        else:
            sections[-1].append(line)
    message = " ".join(sections[1] if len(sections) > 1 else sections[0]).strip()
    for pattern, plain in _PLAIN:
        message = re.sub(pattern, plain, message)
    return message or "the arguments can't be read; see --help"


def _choices(match: re.Match[str]) -> str:
    value, flag, said = match.groups()
    allowed = said.replace("'", "").split(", ")
    if "None" in allowed:  # a flag that may be left out: what it can be comes in no order
        allowed = sorted({*allowed} - {"None"})
    return f'{flag} can\'t be "{value}"{guess(value, allowed)}; choose from: {", ".join(allowed)}'


_PLAIN = (
    (r"^Error parsing (config: |options: )?", ""),
    (r"^Missing from [^:]*: (\S+).*", r"\1 is missing; see --help"),
    (r"^Missing value for argument '(.*?)'.*", r"\1 needs a value"),
    (r"^Unrecognized options: ", "too many words: "),
    (r"^invalid choice '(.*)' for argument '(.*)'\. Expected one of \((.*?),?\)\.$", _choices),
    (r"no type matching (?:\{None\}\|)?(\w+) could be instantiated from \[(.*?)\].*", r"\2 is no \1"),
    (r"invalid literal for int\(\) with base 10: (.*)", r"\1 is no whole number"),
    (r"could not convert string to float: (.*)", r"\1 is no number"),
    (r"Exceeds the limit .* for integer string conversion.*", "it has too many digits"),
    (r"\bINT\b", "whole number"),
)
"""Patterns of what the parser says, each with the same in plain words."""
