"""What people have noted about a run: a star, a name, a note, tags, and whether it is archived.

It stands in one small file of the run folder, which the studio alone writes, so that it goes wherever the folder goes.
A trainer reads there which designs are starred: it keeps their checkpoints.
"""

import unicodedata
from pathlib import Path

import msgspec

from morph_core import durable, inside
from morph_core.run_folder import MARKS

FILE = MARKS
MOST_STARS = 100
"""Largest number of designs of a run that are starred."""
LONGEST_NAME, LONGEST_NOTE, LONGEST_TAG, MOST_TAGS = 80, 2000, 32, 12
"""Largest numbers of characters in a name, a note and a tag, and of tags."""
_LARGEST_FILE = 64 << 10


class Marks(msgspec.Struct, frozen=True, kw_only=True):
    """What people have noted about a run."""

    starred: bool = False
    name: str = ""
    """Name that is shown beside the folder's; the folder keeps its own, by which other runs and studies know it."""
    note: str = ""
    tags: tuple[str, ...] = ()
    archived: bool = False
    """Whether lists leave the run out unless they are asked for it."""
    starred_designs: tuple[int, ...] = ()
    """Iterations whose designs are starred."""


class MarksChange(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Wish to change some of a run's marks; what is left out stays as it is."""

    starred: bool | msgspec.UnsetType = msgspec.UNSET
    name: str | msgspec.UnsetType = msgspec.UNSET
    note: str | msgspec.UnsetType = msgspec.UNSET
    tags: tuple[str, ...] | msgspec.UnsetType = msgspec.UNSET
    archived: bool | msgspec.UnsetType = msgspec.UNSET


_decoder = msgspec.json.Decoder(Marks)


def read_marks(folder: Path) -> Marks:
    """Return the marks of the run in `folder`; none where there is no such file, or one that can't be used."""
    try:
        return marks_to_change(folder)
    except ValueError:  # a run's list is worth more than what somebody wrote into this file
        return Marks()


def marks_to_change(folder: Path) -> Marks:
    """Return the marks of the run in `folder` to change them. Raise ValueError where those that are there can't be
    used: written over, they would be lost."""
    try:
        return _checked(_decoder.decode(inside.read(folder, FILE, _LARGEST_FILE)))
    except FileNotFoundError:
        return Marks()
    except (OSError, ValueError, RecursionError) as error:
        why = f"what was noted about {folder.name} is kept in {FILE}, which can't be read: {error}"
        raise ValueError(f"{why}; mend that file, or move it away") from error


def write_marks(folder: Path, marks: Marks) -> None:
    """Write the marks of the run in `folder`, whole or not at all."""
    durable.write_file(folder / FILE, msgspec.json.format(msgspec.json.encode(marks), indent=2))


def changed(marks: Marks, change: MarksChange) -> Marks:
    """Return marks with a change. Raise ValueError that says what is allowed."""
    wanted = {name: value for name, value in msgspec.structs.asdict(change).items() if value is not msgspec.UNSET}
    return _checked(msgspec.structs.replace(marks, **wanted))


def with_star(marks: Marks, iteration: int, starred: bool) -> Marks:
    """Return marks with the design of an iteration starred, or not. Raise ValueError that says what is allowed."""
    others = set(marks.starred_designs) - {iteration}
    return _checked(msgspec.structs.replace(marks, starred_designs=tuple(others | ({iteration} if starred else set()))))


def _checked(marks: Marks) -> Marks:
    """Return marks without needless blanks and doubled tags. Raise ValueError if one is longer than is allowed."""
    tags = tuple(dict.fromkeys(tag for tag in (as_kept(tag) for tag in marks.tags) if tag))
    name, note = as_kept(marks.name), marks.note.strip()
    if len(name) > LONGEST_NAME:
        raise ValueError(f"a name has at most {LONGEST_NAME} characters, this one has {len(name)}")
    if len(note) > LONGEST_NOTE:
        raise ValueError(f"a note has at most {LONGEST_NOTE} characters, this one has {len(note)}")
    if len(tags) > MOST_TAGS:
        raise ValueError(f"a run has at most {MOST_TAGS} tags, these are {len(tags)}")
    for tag in tags:
        if len(tag) > LONGEST_TAG or "," in tag:
            raise ValueError(f'a tag has at most {LONGEST_TAG} characters and no comma: "{tag[:LONGEST_TAG]}"')
    for text in (name, note, *tags):
        _refuse_unseen(text)
    designs = tuple(sorted(set(marks.starred_designs)))
    if len(designs) > MOST_STARS:
        raise ValueError(f"at most {MOST_STARS} designs of a run are starred, these are {len(designs)}")
    return msgspec.structs.replace(marks, name=name, note=note, tags=tags, starred_designs=designs)


def as_kept(text: str) -> str:
    """Return a name or a tag as it is kept: without needless blanks, and the same letters by the same characters."""
    return unicodedata.normalize("NFC", " ".join(text.split()))


def _refuse_unseen(text: str) -> None:
    """Raise ValueError if a text holds a character that is not seen, and may make it read as another text."""
    for character in text:
        if not character.isprintable() and character not in "\n\t":
            raise ValueError(f"names, notes and tags hold letters that are seen; U+{ord(character):04X} is not")
