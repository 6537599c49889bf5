"""The histories of the runs of one folder: the newest ones are kept in memory, each read by one thread at a time."""

import contextlib
import threading
from pathlib import Path

from morph_core.history import History
from morph_core.inside import NotPlainError
from morph_core.protocol import AnyEvent
from morph_core.pulse import Pulse
from morph_core.run_folder import RunFolder, RunFolderError, find_run
from studio.inquest import Inquest
from studio.recordings import Recordings
from studio.shelf.outcome import landmarks

KEPT = 40
"""Largest number of runs that are kept in memory."""
Stamp = tuple[int, ...]
"""When files of a run were last changed, in nanoseconds, and how large each is; zeros where there is none."""
_FILES = ("run.json", "events.jsonl", "heartbeat.json")
"""The files from which a run's line in the list is read."""


class Histories:
    """The histories of the runs of one folder. It is thread-safe, and every reading is fresh from the folder."""

    def __init__(self, runs: Path, inquest: Inquest, recordings: Recordings) -> None:
        """Read the runs of the folder `runs` and the recorded ones, and let `inquest` look at the trainer of each that
        is read."""
        self._runs = runs
        self._recordings = recordings
        self._inquest = inquest
        self._lock = threading.Lock()  # of the tables here: nothing is read while it is held
        self._turns: dict[str, threading.RLock] = {}
        self._pulses: dict[str, Pulse] = {}
        self._histories: dict[str, History] = {}  # least recently used first
        self._unreadable: dict[str, tuple[Stamp, str]] = {}

    def __len__(self) -> int:
        """Return the number of runs that are in memory."""
        return len(self._histories)

    def turn(self, run_id: str) -> threading.RLock:
        """Return the lock under which one run is read, so that a slow or strange one keeps no other waiting."""
        return self._turns.setdefault(run_id, threading.RLock())

    def find(self, run_id: str) -> RunFolder:
        """Return a run of the folder, or a recorded one; raise RunFolderError if there is no such run."""
        if run_id in self._recordings and not (self._runs / run_id).exists():
            return self._recordings.get(run_id).history.folder
        return find_run(self._runs, run_id)

    def get(self, run_id: str) -> History:
        """Return the run as it is now; raise RunFolderError if it is unknown or unreadable."""
        folder = self.find(run_id)
        with self.turn(run_id):
            history = self._tail(folder)
            self._inquest.look(history)
            return history

    def landmarks(self, folder: RunFolder) -> list[AnyEvent]:
        """Return the events of a run, without most of its iterations where they are not in memory already."""
        history = self._histories.get(folder.id)
        if history is None:
            return landmarks(folder.path)
        with contextlib.suppress(RunFolderError):  # its line says why
            history.poll()
        return history.events

    def forget(self, run_id: str) -> None:
        """Forget what was read of a run."""
        self._histories.pop(run_id, None)
        self._unreadable.pop(run_id, None)

    def _tail(self, folder: RunFolder) -> History:
        """Return the run's history, polled; an unreadable run is not read again until one of its files changes."""
        stamp = stamp_of(folder)
        known = self._unreadable.get(folder.id)
        if known and known[0] == stamp:
            raise RunFolderError(known[1])
        with self._lock:
            history = self._histories.pop(folder.id, None)
        try:
            if history is None:
                history = History(folder, self._pulses.setdefault(folder.id, Pulse()))
            else:
                history.poll()
        except Exception as error:  # foreign parameters, a directory where a file belongs, no permission
            reason = str(error) if isinstance(error, RunFolderError) else f"{folder.id} can't be read: {error!r}"
            if not _may_pass(error):
                self._unreadable[folder.id] = stamp, reason
            raise RunFolderError(reason) from error
        with self._lock:
            self._histories[folder.id] = history
            if len(self._histories) > KEPT:
                del self._histories[next(iter(self._histories))]
        return history


def stamp_of(folder: RunFolder) -> Stamp:
    """Return what changes whenever a file changes from which a run's line in the list is read."""
    return tuple(number for name in _FILES for number in _stamp(folder.path / name))


def _stamp(path: Path) -> tuple[int, int]:
    try:
        found = path.lstat()
    except OSError:
        return 0, 0
    return found.st_mtime_ns, found.st_size


def _may_pass(error: BaseException) -> bool:
    """Tell whether what kept a run from being read may be over the next time: too many open files, a slow disk."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return isinstance(cause, OSError) and not isinstance(cause, NotPlainError)
