"""The runs of one folder: start, adopt and watch their trainers, and pass on commands."""

import contextlib
import subprocess
import threading
import typing
from collections.abc import Callable
from pathlib import Path

import msgspec

from morph_core.catalogue import make_task
from morph_core.design import DesignSpace
from morph_core.history import History
from morph_core.protocol import AnyCommand, Evaluation, StateChanged, Status
from morph_core.run_folder import SAID_ENDED, RunFolder, RunFolderError, find_run, list_runs
from studio import limits
from studio.commands import check_command
from studio.inquest import Inquest
from studio.new_run import prepare_run
from studio.trainers import spawn_trainer

WATCHED = 20
"""Number of the newest runs that the viewer is offered, beside those that run and the one it shows."""
KEPT = 40
"""Largest number of runs that are kept in memory."""
_EVENTS_TAIL = 65536


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the list of runs."""

    id: str
    status: Status
    reason: str = ""
    """Words on why the run is in this state."""
    current: bool = False
    """Whether the viewer shows this run."""
    task: str | None = None
    method: str | None = None
    seed: int | None = None
    created: float | None = None
    iteration: int = 0
    iterations: int | None = None
    stage: str = ""
    eta_seconds: float | None = None
    success: float | None = None
    """Share of episodes in which the sampled policy reached the goal on Hw-Phy, at the last evaluation."""


class Runs:
    """Runs of one folder with their trainers. It is thread-safe, and every reading is fresh from the folder."""

    def __init__(self, folder: Path, spawn: Callable[..., subprocess.Popen[bytes]] = spawn_trainer) -> None:
        self.folder = folder
        self.shown: str | None = None
        """The run on screen; None while the start panel is."""
        self._spawn = spawn
        self._lock = threading.RLock()
        self._histories: dict[str, History] = {}  # least recently used first
        self._unreadable: dict[str, tuple[float, str]] = {}
        self._ended: dict[str, tuple[int, Summary]] = {}
        self._inquest = Inquest()

    # --- reading ---

    def get(self, run_id: str) -> History:
        """Return the run as it is now; raise RunFolderError if it is unknown or unreadable."""
        folder = find_run(self.folder, run_id)
        with self._lock:
            history = self._tail(folder)
            self._inquest.look(history)
            return history

    def status(self, history: History) -> tuple[Status, str]:
        """Return what the run does and why, including what only a witness of its trainer's death can know."""
        with self._lock:
            return self._inquest.status(history)

    def summary(self, run_id: str) -> Summary:
        """Return one line about a run, whatever its state; raise RunFolderError only if there is no such run."""
        folder = find_run(self.folder, run_id)
        try:
            return self._ended_summary(folder) or self._summarise(self.get(run_id))
        except RunFolderError as error:
            return Summary(id=run_id, status="unreadable", reason=str(error))

    def summaries(self) -> list[Summary]:
        """Return all runs, newest first."""
        lines = []
        for run_id in self.ids():
            with contextlib.suppress(RunFolderError):  # removed this very moment
                lines.append(msgspec.structs.replace(self.summary(run_id), current=run_id == self.shown))
        return lines

    def ids(self) -> list[str]:
        """Return the names of all runs, newest first."""
        return list_runs(self.folder)[::-1]

    def watched(self) -> dict[str, History]:
        """Return the runs the viewer may show, newest first: recent, running, and the current one."""
        names = self.ids()
        with self._lock:
            wanted = {*names[:WATCHED], *self._inquest.children, self.shown}
        histories = {}
        for name in names:
            if name in wanted:
                with contextlib.suppress(RunFolderError):
                    histories[name] = self.get(name)
        return histories

    def show(self, run_id: str) -> None:
        """Let the viewer show this run."""
        self.get(run_id)
        self.shown = run_id

    def show_newest(self) -> None:
        """Let the viewer show the newest run that can be read, if there is one."""
        for run_id in self.ids():
            with contextlib.suppress(RunFolderError):
                return self.show(run_id)
        return None

    # --- acting ---

    def start(self, **wishes: typing.Any) -> str:
        """Create a run as `prepare_run` does, start its trainer and show it; return its id."""
        folder = prepare_run(self.folder, **wishes)
        with self._lock:
            self._launch(folder)
        self.shown = folder.id
        return folder.id

    def resume(self, run_id: str, further: int | None = None) -> None:
        """Start a trainer that goes on from the newest checkpoint; ValueError if one is at work or nothing is left."""
        if further is not None:
            further = limits.iterations(further, "further")
        with self._lock:
            history = self.get(run_id)
            status, _ = self.status(history)
            if self._inquest.is_alive(history):
                raise ValueError(f"{run_id} has a trainer already and is {status}; send it the command resume instead")
            if status == "finished" and further is None:
                raise ValueError(f"{run_id} has finished: say how many iterations it shall do further")
            self._launch(history.folder, further)
        self.shown = run_id

    def send(self, run_id: str, command: AnyCommand) -> int:
        """Put a command into the run's inbox and return its id; ValueError, the run unchanged, if it is no good."""
        history = self.get(run_id)
        task = make_task(history.record.task, history.record.task_options)
        command = check_command(command, history.in_force, task)
        with self._lock:
            if not self._inquest.is_alive(history):
                raise ValueError(f"{run_id} is {self.status(history)[0]}: resume it, then send commands")
        return history.folder.send(command)

    def _launch(self, folder: RunFolder, further: int | None = None) -> None:
        self._inquest.begin(folder, lambda: self._spawn(folder, further=further))

    # --- opening ---

    def _tail(self, folder: RunFolder) -> History:
        """Return the run's history, polled; an unreadable run is not read again until its run.json changes."""
        try:
            changed = (folder.path / "run.json").stat().st_mtime
        except OSError:
            changed = 0.0
        known = self._unreadable.get(folder.id)
        if known and known[0] == changed:
            raise RunFolderError(known[1])
        history = self._histories.pop(folder.id, None)
        try:
            if history is None:
                history = History(folder)
            else:
                history.poll()
        except (ValueError, OSError) as error:  # foreign parameters, a directory where a file belongs, no permission
            reason = str(error) if isinstance(error, RunFolderError) else f"{folder.id} can't be read: {error}"
            self._unreadable[folder.id] = changed, reason
            raise RunFolderError(reason) from error
        self._histories[folder.id] = history
        if len(self._histories) > KEPT:
            del self._histories[next(iter(self._histories))]
        return history

    def _summarise(self, history: History) -> Summary:
        status, reason = self.status(history)
        record, beat = history.record, history.heartbeat
        at_work = beat if beat and status not in (*SAID_ENDED, "lost", "starting") else None
        return Summary(
            id=history.folder.id,
            status=status,
            reason=reason,
            task=record.task,
            method=record.method,
            seed=record.seed,
            created=record.created,
            iteration=history.iteration,
            iterations=history.planned_iterations,
            stage=at_work.stage if at_work else "",
            eta_seconds=at_work.eta_seconds if at_work else None,
            success=history.evaluations[-1].sampled_success if history.evaluations else None,
        )

    def _ended_summary(self, folder: RunFolder) -> Summary | None:
        """Return the line of a run that has ended from the end of its log alone: hundreds stay quick to list."""
        with self._lock:
            if self._inquest.concerns(folder.id) or folder.id in self._histories:
                return None
        try:
            size = folder.events.stat().st_size
        except OSError:
            return None
        known = self._ended.get(folder.id)
        if known and known[0] == size:
            return known[1]
        events, _ = folder.read_events(max(0, size - _EVENTS_TAIL))
        states = [event for event in events if isinstance(event, StateChanged)]
        if not states or states[-1].status not in SAID_ENDED:
            return None
        record, beat = folder.record(), folder.heartbeat()
        budgeted = record.env_steps is not None
        try:
            DesignSpace(tuple(record.parameters))
        except ValueError:
            return None  # unreadable: `get` says why
        line = Summary(
            id=folder.id,
            status=states[-1].status,
            reason=states[-1].message,
            task=record.task,
            method=record.method,
            seed=record.seed,
            created=record.created,
            iteration=states[-1].iteration,
            iterations=max(beat.iterations if beat else 0, states[-1].iteration if budgeted else record.iterations),
            success=next((e.sampled_success for e in reversed(events) if isinstance(e, Evaluation)), None),
        )
        self._ended[folder.id] = size, line
        return line
