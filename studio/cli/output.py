"""What the command line writes: words that any terminal can show, whatever came from files, and JSON."""

import json
import math
import os
import shutil
import sys
import unicodedata

import msgspec

_NOT_SHOWN = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Categories of characters that a terminal obeys or can't show: controls, marks of direction, halves of characters."""


NARROWEST = 40
"""Smallest number of columns for which words are laid out."""


def visible(words: str) -> str:
    r"""Return words whose control characters are written out, such as \x1b, but for line ends and tabs."""
    if words.isascii() and words.isprintable():
        return words
    return "".join(
        character.encode("unicode_escape").decode()
        if character not in "\n\t" and unicodedata.category(character) in _NOT_SHOWN
        else character
        for character in words
    )


def open_streams() -> None:
    """Give each standard stream that whoever started this program has closed a place where all words are lost.

    Otherwise writing to it would be an error, and the next file that is opened would be taken for it by our children.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)  # the lowest free number, which is the stream's
            os.set_inheritable(descriptor, True)
            setattr(sys, name, os.fdopen(descriptor, mode, encoding="utf-8"))


def all_written() -> bool:
    """Write out what was printed, and tell whether it could be; a reader who has seen enough counts as one of all."""
    try:
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # at its end Python writes once more
        if not isinstance(error, BrokenPipeError):
            complain(f"morph-studio: what was to be printed can't be written: {error.strerror}")
            return False
    return True


def bear_any_width() -> None:
    """Lay words out for `NARROWEST` columns at least: the parser's help never ends where there are a few."""
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)


def bear_any_encoding() -> None:
    """Let what the terminal's encoding does not hold be written out by its number, where it would raise an error."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure:
            reconfigure(errors="backslashreplace")


def say(words: object) -> None:
    """Print words on stdout."""
    print(visible(str(words)))  # noqa: T201


def complain(words: object) -> None:
    """Print words on stderr, where they are no part of what a command gives."""
    print(visible(str(words)), file=sys.stderr)  # noqa: T201


def write_json(document: object) -> None:
    """Print one JSON document in ASCII, so that it is the same in every encoding; what is not finite is null."""
    json.dump(_finite(msgspec.to_builtins(document)), sys.stdout, indent=2)
    sys.stdout.write("\n")


def _finite(value: object) -> object:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    return [_finite(item) for item in value] if isinstance(value, list | tuple) else value
