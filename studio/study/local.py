"""The launcher `local`: a queue over the cores of this machine. Its locks live exactly as long as the trainers.

Any number of queues may work on one study, on this machine or on others that share its disk: a run is claimed by a
lock that its trainer inherits, and so is a slot. What is left to do is read from the folders alone, so a queue may die
or be started again at any time.
"""

import contextlib
import fcntl
import os
import platform
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import msgspec
import psutil

from morph_core import durable, inside
from morph_core.history import History
from morph_core.protocol import Progress
from morph_core.run_folder import LAUNCH, SMALL_BYTES, RunFolder, RunFolderError, process_alive
from studio import limits
from studio.inquest import Child, start_child
from studio.study.launcher import Launcher, Place, check_hands, launcher_of
from studio.study.standing import stopped_by_user
from studio.trainers import spawn_trainer

GIVE_UP = 3
"""Starts in a row that got no further, after which a run is given up."""
CLAIM = "claim.lock"
"""File in a run folder that is locked by the trainer that a queue has started."""
CANCELLED = "cancelled"
"""File in a run folder that keeps every queue from starting it."""
SLOTS = ".slots"
"""Folder of a study whose files are locked by the trainers that take up a slot."""
NICENESS = 5
"""Number that is added to the niceness of trainers, so that a machine full of them can still be used."""


class Process(msgspec.Struct, frozen=True):
    """A process of a machine, so that a reused pid is not taken for it."""

    host: str
    pid: int
    started: float

    @staticmethod
    def of(pid: int) -> "Process":
        """Return the process `pid` of this machine."""
        started = time.time()
        with contextlib.suppress(psutil.Error):
            started = psutil.Process(pid).create_time()
        return Process(platform.node(), pid, started)

    def is_here(self) -> bool:
        """Tell whether the process lives, on this machine."""
        return self.host == platform.node() and process_alive(self.pid, self.started)


class Launch(msgspec.Struct, frozen=True, kw_only=True):
    """Content of launch.json of a run that a queue has started."""

    launcher: str = "local"
    queue: Process
    """The queue that started the trainer."""
    trainer: Process
    slot: int
    starts: int
    """Starts in a row that got no further, this one included."""
    furthest: int
    """Last iteration that any trainer had reached before this start."""
    given_up: str = ""
    """Why no queue starts it any more."""


@dataclass
class Local(Launcher):
    """A queue over the cores of this machine."""

    slots: int = field(default_factory=lambda: len(limits.cores()))
    """Number of trainers at a time, by default as many as there are cores."""
    spawn: Callable[..., subprocess.Popen[bytes]] = spawn_trainer
    """Function that starts the trainer of a run folder, which inherits the file descriptors `held`."""

    name: ClassVar[str] = "local"
    stays: ClassVar[bool] = False

    _working: dict[int, Child] = field(default_factory=dict, init=False)
    """The trainers of this queue, by slot."""
    _causes: dict[str, str] = field(default_factory=dict, init=False)
    """Why trainers of this queue died without a word."""
    _waiting: dict[str, History] = field(default_factory=dict, init=False)
    """The runs that may have to be started, in order."""
    _leaving: bool = field(default=False, init=False)

    def check(self) -> None:
        limits.whole("slots", self.slots, 1, limits.MAX_TRAINERS)

    def submit(self, directory: Path, runs: Sequence[str]) -> None:
        check_hands(directory, runs, self.name)
        for run in runs:
            with contextlib.suppress(RunFolderError, OSError, ValueError):  # the standing of the run says why
                self._waiting.setdefault(run, History(RunFolder(directory / run)))

    def tend(self, directory: Path) -> None:
        for slot, child in list(self._working.items()):
            if child.process.poll() is not None:
                del self._working[slot]
                if child.spoken_end(History(child.folder)) is None:
                    self._causes[child.folder.id] = child.cause()
            elif (child.folder.path / CANCELLED).exists():
                child.process.terminate()
        for slot in range(self.slots):
            if not self._leaving and slot not in self._working:
                self._fill(directory, slot)

    def states(self, directory: Path, runs: Sequence[str]) -> Mapping[str, Place]:
        return {run: self._place(RunFolder(directory / run)) for run in runs}

    def cancel(self, directory: Path, runs: Sequence[str]) -> None:
        for run in runs:
            path = directory / run
            if path.is_dir():
                inside.touch(path, CANCELLED)
                launch = read_launch(path)
                if launch and launch.trainer.is_here():
                    os.kill(launch.trainer.pid, signal.SIGTERM)

    def requeue(self, directory: Path, runs: Sequence[str]) -> None:
        for run in runs:
            path = directory / run
            if launcher_of(path) not in ("", self.name) and not (path / CANCELLED).exists():
                continue  # in the hands of another launcher: `submit` says so
            (path / CANCELLED).unlink(missing_ok=True)
            if path.is_dir() and (claim := _claim(path / CLAIM)) is not None:  # no trainer of a queue has it
                with contextlib.closing(claim):
                    (path / LAUNCH).unlink(missing_ok=True)

    def leave(self, directory: Path, at_once: bool = False) -> str:
        """Stop the trainers of this queue, and of queues that are dead; `at_once` without a checkpoint."""
        self._leaving = True
        for child in self._working.values():
            child.process.kill() if at_once else child.process.terminate()
        orphans = 0
        for run in self._waiting:
            launch = read_launch(directory / run)
            if launch and launch.trainer.is_here() and not launch.queue.is_here():
                os.kill(launch.trainer.pid, signal.SIGKILL if at_once else signal.SIGTERM)
                orphans += 1
        count = len(self._working) + orphans
        trainers = f"{count} trainer{'s' * (count != 1)}"
        if at_once:
            return f"{trainers} ended at once; what came after the newest checkpoints will be done again"
        return f"{trainers} save a checkpoint after this iteration and stop; press Ctrl-C again to end them at once"

    def working(self, directory: Path) -> int:
        return len(self._working)

    # --- starting ---

    def _fill(self, directory: Path, slot: int) -> None:
        """Start a run in this slot, if the slot is free and a run is left."""
        place = _claim(directory / SLOTS / f"{platform.node()}-{slot}")
        if place is None:
            return
        with contextlib.closing(place):
            for run, history in list(self._waiting.items()):
                if not self._is_left(run, history) or (claim := _claim(history.folder.path / CLAIM)) is None:
                    continue
                with contextlib.closing(claim):
                    # Whoever had the claim before has perhaps finished it meanwhile.
                    if self._is_left(run, history) and self._start(history, slot, [claim.number, place.number]):
                        return

    def _is_left(self, run: str, history: History) -> bool:
        """Tell whether a trainer is to be started on the run; one that is done for good is looked at no more."""
        history.poll()
        if history.status == "finished":
            del self._waiting[run]
            return False
        launch = read_launch(history.folder.path)
        given_up = launch is not None and bool(launch.given_up)
        cancelled = (history.folder.path / CANCELLED).exists()
        return not (given_up or cancelled or stopped_by_user(history) or _is_held(history.folder))

    def _start(self, history: History, slot: int, held: Sequence[int]) -> bool:
        """Start a trainer that inherits the locks `held`; False where the run was given up instead."""
        folder, before = history.folder, read_launch(history.folder.path)
        furthest = max((e.iteration for e in history.events if isinstance(e, Progress)), default=0)
        barren = before.starts if before and furthest <= before.furthest else 0
        if before and barren >= GIVE_UP:
            cause = self._causes.get(folder.id) or history.message
            reason = f"given up after {barren} starts that got no further than iteration {furthest}: {cause}"
            _write_launch(folder, msgspec.structs.replace(before, given_up=reason))
            return False
        child = start_child(folder, lambda: self.spawn(folder, held=held))
        _settle(child.process.pid, slot)
        self._working[slot] = child
        trainer = Process.of(child.process.pid)
        _write_launch(
            folder,
            Launch(queue=Process.of(os.getpid()), trainer=trainer, slot=slot, starts=barren + 1, furthest=furthest),
        )
        return True

    def _place(self, folder: RunFolder) -> Place:
        launch = read_launch(folder.path)
        if (folder.path / CANCELLED).exists():
            return Place(why="cancelled", given_up=True)
        if launch and launch.given_up:
            return Place(why=launch.given_up, given_up=True)
        if launch and launch.trainer.is_here():
            return Place(where=f"slot {launch.slot} of {launch.trainer.host}")
        return Place()


def read_launch(path: Path) -> Launch | None:
    """Return what a queue has written down of a run; None where none has."""
    try:
        return msgspec.json.decode(inside.read(path, LAUNCH, SMALL_BYTES), type=Launch)
    except (OSError, ValueError, RecursionError):
        return None


def _write_launch(folder: RunFolder, launch: Launch) -> None:
    durable.write_file(folder.path / LAUNCH, msgspec.json.encode(launch))


def _settle(pid: int, slot: int) -> None:
    """Give a trainer one core of its own, and let others go first."""
    with contextlib.suppress(OSError):  # it has ended already
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(pid, {limits.cores()[slot % len(limits.cores())]})
        os.setpriority(os.PRIO_PROCESS, pid, os.getpriority(os.PRIO_PROCESS, 0) + NICENESS)


@dataclass(frozen=True)
class _Lock:
    """A lock that is held as long as a process has its file descriptor open."""

    number: int

    def close(self) -> None:
        os.close(self.number)


def _claim(path: Path) -> _Lock | None:
    """Take the lock of this file; None if it is taken."""
    path.parent.mkdir(exist_ok=True)
    try:
        number = inside.open_plain(path.parent, path.name, os.O_RDWR | os.O_CREAT)
    except inside.NotPlainError:
        return None
    try:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(number)
        return None
    return _Lock(number)


def _is_held(folder: RunFolder) -> bool:
    """Tell whether a trainer that somebody else started works on the run."""
    lock = _claim(folder.path / "trainer.lock")
    if lock is None:
        return True
    lock.close()
    return False
