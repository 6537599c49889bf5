"""What the command line writes: words that any terminal can show, whatever came from files, and JSON."""

import json
import math
import sys
import unicodedata

import msgspec

_NOT_SHOWN = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Categories of characters that a terminal obeys or can't show: controls, marks of direction, halves of characters."""


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
