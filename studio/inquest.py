"""Why a trainer is dead: what its own log, its exit status and those who saw it alive say."""

import os
import platform
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass

from morph_core import inside
from morph_core.history import History
from morph_core.protocol import StateChanged, Status
from morph_core.run_folder import SAID_ENDED, SMALL_BYTES, RunFolder

_LOG_TAIL = 4096


@dataclass(frozen=True)
class Child:
    """A trainer that this process started."""

    folder: RunFolder
    process: subprocess.Popen[bytes]
    spawned: float  # s since the epoch
    log_start: int
    """The size of the log when the trainer was started: what stands before it was written by others."""

    def spoken_end(self, history: History) -> StateChanged | None:
        """Return how this trainer, and no earlier one, said that it ends; None if it did not."""
        state = history.state
        return state if state and state.time >= self.spawned and state.status in SAID_ENDED else None

    def cause(self) -> str:
        """Say why a trainer that has ended did so without a word."""
        return cause_of_death(self.folder, self.process.returncode, self.log_start)


def start_child(folder: RunFolder, spawn: Callable[[], subprocess.Popen[bytes]]) -> Child:
    """Start a trainer by `spawn` and remember what there was before it; OSError where it could write nothing."""
    _check_writable(folder)
    log_start = _log_size(folder)
    spawned = time.time()
    return Child(folder, spawn(), spawned, log_start)


def _check_writable(folder: RunFolder) -> None:
    """Raise PermissionError, with a sentence, where a trainer could not write what it learns."""
    open_to_us = os.access(folder.path, os.W_OK | os.X_OK)
    if not open_to_us or (folder.events.exists() and not os.access(folder.events, os.W_OK)):
        raise PermissionError(
            f"{folder.id} is read-only for the user of this process: copy its folder to where it can be written to"
        )


def cause_of_death(folder: RunFolder, code: int | None, log_start: int = 0) -> str:
    """Say why a trainer ended: the signal that killed it, or the last line of its log; `code` None is not known."""
    if code is not None and code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
        hint = " (perhaps out of memory)" if name == "SIGKILL" else ""
        return f"the trainer was killed by {name}{hint}; resume goes on from its newest checkpoint"
    last = _last_line(folder, log_start)
    if code is None:
        return "the trainer died" + (f": {last}" if last else "; resume goes on from its newest checkpoint")
    return last or f"the trainer ended with exit status {code} and without a word"


def _last_line(folder: RunFolder, start: int) -> str:
    try:
        begin = max(start, _log_size(folder) - _LOG_TAIL)
        lines = inside.read(folder.path, "trainer.log", SMALL_BYTES, begin)[-_LOG_TAIL:]
        lines = lines.decode("utf-8", "replace").split("\n")
    except OSError:
        return ""
    return next((line.strip()[:500] for line in reversed(lines) if line.strip()), "")


def _log_size(folder: RunFolder) -> int:
    try:
        return (folder.path / "trainer.log").lstat().st_size
    except OSError:
        return 0


@dataclass(frozen=True)
class _Verdict:
    """Why a trainer that logged no end is dead, as this process found it."""

    time: float
    reason: str


class Inquest:
    """Watches the trainers of many runs, its own children and others, and remembers why one died.

    Calls about one run must not overlap; those about different runs may.
    """

    def __init__(self) -> None:
        self._children: dict[str, Child] = {}
        self._seen_alive: dict[str, tuple[int, float]] = {}
        self._verdicts: dict[str, _Verdict] = {}

    @property
    def children(self) -> set[str]:
        """The runs whose trainer this process started and has not seen end."""
        return set(self._children)

    def concerns(self, run_id: str) -> bool:
        """Tell whether more is known of a run's trainer than its folder says."""
        return run_id in self._children or run_id in self._verdicts

    def begin(self, folder: RunFolder, spawn: Callable[[], subprocess.Popen[bytes]]) -> None:
        """Start a trainer; what was found about an earlier one counts no longer."""
        self._verdicts.pop(folder.id, None)
        self._seen_alive.pop(folder.id, None)
        self._children[folder.id] = start_child(folder, spawn)

    def look(self, history: History) -> None:
        """Reap a trainer that has ended, and find out whether it died without a word."""
        child = self._children.get(history.folder.id)
        if child is None:
            self._look_at_stranger(history)
        elif child.process.poll() is not None:
            del self._children[history.folder.id]
            history.poll()  # its last words
            # Refused because another trainer holds the folder: then it is not this one's death that counts.
            beat = history.heartbeat
            other = beat is not None and beat.pid != child.process.pid and history.pulse.is_alive
            if child.spoken_end(history) is None and not other:
                self._find(history, child.cause())

    def status(self, history: History) -> tuple[Status, str]:
        """Return what the run does and why, including what only a witness of its trainer's death can know."""
        verdict, child = self._verdict(history), self._children.get(history.folder.id)
        if verdict:
            return "failed", verdict.reason
        spoken = history.state.time if history.state else 0.0
        if child and (spoken < child.spawned or history.status == "lost"):  # no heartbeat of its own yet
            return "starting", "the trainer starts"
        return history.status, history.message

    def is_alive(self, history: History) -> bool:
        """Tell whether the run has a trainer."""
        child = self._children.get(history.folder.id)
        if child is not None and child.process.poll() is None:
            return True
        return self._verdict(history) is None and history.pulse.is_alive

    def _look_at_stranger(self, history: History) -> None:
        """Follow a trainer that was adopted, or started by someone else, as long as its process is on this machine."""
        run_id, beat = history.folder.id, history.heartbeat
        if beat is None or beat.host != platform.node() or history.status in SAID_ENDED:
            return
        process = (beat.pid, beat.process_started)
        if history.pulse.is_alive:
            self._seen_alive[run_id] = process
            self._verdicts.pop(run_id, None)
        elif self._seen_alive.get(run_id) == process:
            del self._seen_alive[run_id]
            self._find(history, cause_of_death(history.folder, None))

    def _find(self, history: History, reason: str) -> None:
        self._verdicts[history.folder.id] = _Verdict(time.time(), reason)

    def _verdict(self, history: History) -> _Verdict | None:
        """Return what was found, unless a trainer has spoken since."""
        verdict = self._verdicts.get(history.folder.id)
        return verdict if verdict and (history.state is None or history.state.time < verdict.time) else None
