"""The runs that wait for a trainer, in order: a small file each beside the runs, so that no restart forgets one."""

import contextlib
import os
import re
import secrets
from pathlib import Path

import msgspec

from morph_core import durable, inside
from morph_core.protocol import Whole
from morph_core.run_folder import SMALL_BYTES

FOLDER = ".waiting"
"""Folder of the queue, in that of the runs."""
_NAME = re.compile(r"[0-9]{6,12}\.json")


class Wait(msgspec.Struct, frozen=True):
    """A run that is to be started, and how."""

    run: str
    further: Whole | None = None
    from_start: bool = False


class Waiting:
    """The queue of one folder of runs. Any number of servers may share it: each start is given to one of them."""

    def __init__(self, runs: Path) -> None:
        self._runs = runs
        self._known: dict[str, Wait] = {}

    def add(self, wait: Wait) -> None:
        """Put a run at the end of the queue."""
        folder = inside.folder(self._runs, FOLDER)
        number = max((int(name[:-5]) for name in self._names()), default=0) + 1
        draft = folder / f".{secrets.token_hex(8)}"
        durable.write_file(draft, msgspec.json.encode(wait))
        try:
            while True:
                with contextlib.suppress(FileExistsError):  # another server was faster
                    os.link(draft, folder / f"{number:06d}.json")
                    return
                number += 1
        finally:
            draft.unlink(missing_ok=True)

    def take(self, run: str) -> bool:
        """Take a run out of the queue; False where it is not in it, or somebody else has taken it."""
        taken = False
        for name, wait in self._all().items():
            if wait.run == run:
                with contextlib.suppress(FileNotFoundError):
                    (self._runs / FOLDER / name).unlink()
                    taken = True
        return taken

    def all(self) -> list[Wait]:
        """Return what waits, in order."""
        return list(self._all().values())

    def places(self) -> dict[str, int]:
        """Return the place of each run that waits, from 1 on."""
        return {wait.run: place for place, wait in reversed([*enumerate(self._all().values(), 1)])}

    def place(self, run: str) -> int:
        """Return the place of a run in the queue, from 1 on; 0 where it does not wait."""
        return self.places().get(run, 0)

    def _names(self) -> list[str]:
        try:
            return [name for name in inside.names(self._runs, FOLDER) if _NAME.fullmatch(name)]
        except OSError:
            return []

    def _all(self) -> dict[str, Wait]:
        known, found = self._known, {}
        for name in self._names():
            with contextlib.suppress(OSError, ValueError, RecursionError):  # taken meanwhile, or no file of ours
                found[name] = known.get(name) or self._read(name)
        self._known = found
        return found

    def _read(self, name: str) -> Wait:
        return msgspec.json.decode(inside.read(self._runs, f"{FOLDER}/{name}", SMALL_BYTES), type=Wait)
