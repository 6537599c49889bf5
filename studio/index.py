"""What was read of runs that are at rest, kept in one file beside them: hundreds of long runs are listed at once.

It holds nothing that the run folders don't: whoever deletes it, or damages it, only makes the next listing slow.
"""

import contextlib
import threading
import zlib
from collections.abc import Collection
from pathlib import Path

import msgspec

from morph_core import durable, inside
from studio.histories import Stamp
from studio.lines import AT_REST, Summary
from studio.shelf.outcome import Outcome
from studio.versions import versions_of

FILE = ".index.json"
"""File of the index, in the folder of the runs."""
_LARGEST_FILE = 64 << 20


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """What was read of one run, as it was when its files had this stamp."""

    stamp: Stamp
    line: Summary | None = None
    """Line of the list, of a run at rest."""
    outcome: Outcome | None = None


class _Kept(msgspec.Struct, frozen=True, kw_only=True):
    """Content of the file."""

    made_by: str
    """Word that differs between versions that read other things of a run."""
    runs: dict[str, Entry]


class Index:
    """What was read of the runs of one folder. It is thread-safe, and may be shared by any number of processes."""

    def __init__(self, runs: Path) -> None:
        """Keep what was read of the folder `runs`; the file is read when it is first asked for."""
        self._runs = runs
        self._lock = threading.Lock()
        self._entries: dict[str, Entry] | None = None
        self._is_new = False

    def get(self, run_id: str, stamp: Stamp) -> Entry:
        """Return what is known of a run whose files have this stamp: perhaps nothing."""
        known = self._known().get(run_id)
        return known if known and known.stamp == stamp else Entry(stamp=stamp)

    def put(self, run_id: str, entry: Entry) -> None:
        """Keep what was read of a run."""
        self._known()[run_id] = entry
        self._is_new = self._is_new or entry.line is not None

    def forget(self, run_id: str) -> None:
        """Forget what was read of a run."""
        self._known().pop(run_id, None)

    def save(self, names: Collection[str]) -> None:
        """Write down what is new of the runs with these names, which are all there are, where that is possible."""
        with self._lock:
            if not self._is_new:
                return
            self._is_new = False  # where it can't be written, only what comes later is worth another try
            kept = {name: e for name, e in list(self._known().items()) if e.line is not None and name in names}
            with contextlib.suppress(OSError):  # a full disk, or a folder that others own
                durable.write_file(self._runs / FILE, msgspec.json.encode(_Kept(made_by=_made_by(), runs=kept)))

    def _known(self) -> dict[str, Entry]:
        if self._entries is None:
            self._entries = self._read()
        return self._entries

    def _read(self) -> dict[str, Entry]:
        """Return what the file holds; nothing where there is none, a damaged one, or one of another version."""
        try:
            kept = msgspec.json.decode(inside.read(self._runs, FILE, _LARGEST_FILE), type=_Kept)
        except (OSError, ValueError, RecursionError):
            return {}
        if kept.made_by != _made_by():
            return {}
        return {name: entry for name, entry in kept.runs.items() if _is_sound(name, entry)}


def _is_sound(name: str, entry: Entry) -> bool:
    """Tell whether an entry is one that is written: the line of a run at rest, of this name."""
    return entry.line is not None and entry.line.id == name and entry.line.status in AT_REST


def _made_by() -> str:
    """Return what differs between versions of the studio, and between sets of fields."""
    fields = msgspec.json.encode(msgspec.json.schema(Entry))
    return f"{versions_of('morph-studio').get('morph-studio', '')} {zlib.crc32(fields):08x}"
