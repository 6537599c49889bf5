"""The trash of a folder of runs: deleted runs, until they are restored or purged.

A deleted run lies in `.trash`, under the time of its deletion and its name. It is purged after `DAYS`; and of more than
`MOST` runs the oldest are, once they have lain there for `AT_LEAST`, so that any deletion can be undone. Until the
machine is started anew its age is measured by a clock that nobody sets: a wall clock may be put right by years.
"""

import functools
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from morph_core import durable, inside
from morph_core.run_folder import RunFolder, RunFolderError, hold

FOLDER = ".trash"
"""Folder of the trash, in that of the runs; no run can have this name."""
DAYS = 7
MOST = 200
AT_LEAST = 3600.0
"""Seconds that a deleted run lies in the trash, however many there are."""
_ENTRY = re.compile(r"(?P<deleted>\d{13})(~(?P<start>[0-9a-f]{8})~(?P<uptime>\d{1,15}))?\.(?P<id>.+)")
"""Pattern of the name of a deleted run: when it was deleted in ms and, since then, by which start of the machine, and
the ms of its uptime. No name of a run has a tilde."""


class Trashed(msgspec.Struct, frozen=True):
    """A deleted run; times are seconds since the epoch."""

    id: str
    deleted: float
    purged: float
    """When it is removed for good, at the latest: the trash is looked through at a start and at every deletion."""


def discard(folder: RunFolder, now: float | None = None) -> Trashed:
    """Move a run into the trash, in one step. Raise RunFolderError if a trainer holds it.

    A time that is given is believed, and no other clock is asked.
    """
    moment = round(time.time() if now is None else now, 3)
    start = _start_of_machine() if now is None else ""
    measured = f"~{start}~{round(_uptime() * 1000)}" if start else ""
    runs = folder.path.parent
    inside.folder(runs, FOLDER)
    with hold(folder):
        durable.move(folder.path, runs / FOLDER / f"{max(0, round(moment * 1000)):013d}{measured}.{folder.id}")
    return _trashed(folder.id, moment)


def restore(runs: Path, run_id: str) -> None:
    """Bring a run back, the one deleted last of that name. Raise RunFolderError if there is none, or its name is taken
    by another run."""
    entries = _entries(runs)
    found = next((path for path, trashed, _ in entries if trashed.id == run_id), None)
    if found is None:
        choices = ", ".join(trashed.id for _, trashed, _ in entries[:8])
        raise RunFolderError(f'no run "{run_id[:80]}" is in the trash; choose from: {choices or "none"}')
    try:
        durable.move(found, runs / run_id)
    except FileExistsError:
        raise ValueError(f"another run is called {run_id} by now: move its folder away first") from None


def trashed_runs(runs: Path) -> list[Trashed]:
    """Return the runs in the trash, the one deleted last first."""
    return [trashed for _, trashed, _ in _entries(runs)]


def purge(runs: Path, now: float | None = None) -> None:
    """Remove for good what has lain in the trash for too long."""
    moment = time.time() if now is None else now
    for i, (path, _, age_at) in enumerate(_entries(runs)):
        age = age_at(moment)
        if age >= DAYS * 86400 or (i >= MOST and age >= AT_LEAST):
            shutil.rmtree(path, ignore_errors=True)


def empty(runs: Path) -> int:
    """Remove all deleted runs for good; return how many there were."""
    entries = _entries(runs)
    for path, *_ in entries:
        shutil.rmtree(path, ignore_errors=True)
    return len(entries)


def _entries(runs: Path) -> list[tuple[Path, Trashed, Callable[[float], float]]]:
    """Return what is in the trash, the newest first, each with its age in seconds at a time; what is no deleted run is
    none of the studio's."""
    folder = runs / FOLDER
    if not folder.is_dir() or folder.is_symlink():
        return []
    matches = ((path, _ENTRY.fullmatch(path.name)) for path in folder.iterdir())
    found = [
        (path, _trashed(match["id"], int(match["deleted"]) / 1000), _age_of(match))
        for path, match in matches
        if match and not path.is_symlink()
    ]
    return sorted(found, key=lambda entry: entry[1].deleted, reverse=True)


def _age_of(match: re.Match[str]) -> Callable[[float], float]:
    """Return how long a run has lain in the trash at a time: by the uptime where the machine was not started anew."""
    if match["start"] and match["start"] == _start_of_machine():
        age = _uptime() - int(match["uptime"]) / 1000
        return lambda _: age
    return lambda moment: moment - int(match["deleted"]) / 1000


def _uptime() -> float:
    """Return the seconds since the machine was started, those in which it slept included where the system tells."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


@functools.cache
def _start_of_machine() -> str:
    """Return a word of eight hexadecimal digits that changes whenever the machine is started; empty if none is told."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")[:8]
    except (OSError, ValueError):
        return ""


def _trashed(run_id: str, deleted: float) -> Trashed:
    return Trashed(run_id, deleted, deleted + DAYS * 86400)
