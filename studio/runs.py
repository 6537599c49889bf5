"""The runs of one folder: start, adopt and watch their trainers, and pass on commands."""

import contextlib
import platform
import shutil
import subprocess
import threading
from collections.abc import Callable, Collection
from pathlib import Path

import msgspec

from morph_core import inside
from morph_core.catalogue import make_task
from morph_core.design import DesignSpace
from morph_core.edits import AnyEdit
from morph_core.history import History
from morph_core.inside import NotPlainError
from morph_core.protocol import (
    AnyCommand,
    AnyEvent,
    Evaluation,
    Kill,
    Parent,
    Resume,
    RunRecord,
    StateChanged,
    Status,
    Stop,
)
from morph_core.pulse import Pulse, at_work
from morph_core.run_folder import SAID_ENDED, RunFolder, RunFolderError, find_run, list_runs, passed_over
from studio import limits
from studio.commands import check_command
from studio.cost import cost_of
from studio.inquest import Inquest
from studio.new_run import StartRun, prepare_run
from studio.overdue import forget_stops, kill_is_offered, stop_waits
from studio.shelf import trash
from studio.shelf.marks import FILE, Marks, MarksChange, changed, read_marks, with_star, write_marks
from studio.shelf.outcome import Outcome, evaluations_of, landmarks, outcome_of
from studio.shelf.trash import Trashed
from studio.study.local import CANCELLED, launcher_of
from studio.study.slurm import Slurm, slurm_launch
from studio.study.slurm_queue import SlurmError
from studio.trainers import spawn_trainer
from studio.waiting import Wait, Waiting

WATCHED = 20
"""Number of the newest runs that browsers are offered, beside those that run and those they show."""
KEPT = 40
"""Largest number of runs that are kept in memory."""
LONGEST_REASON = 500
"""Largest number of characters of the reason why a run can't be read."""
_EVENTS_TAIL = 65536
_HAS_TRAINER: tuple[Status, ...] = ("starting", "running", "pausing", "paused")
_AT_REST: tuple[Status, ...] = (*SAID_ENDED, "lost", "unreadable")
"""States of a run that no trainer is at work on, and none is to be."""
_TOLD_BY_SLURM: tuple[Status, ...] = ("queued", "stopped", "failed", "lost")
"""States of a run's folder of which Slurm may know more: the run may wait, or be at work where it is not seen."""


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the list of runs."""

    id: str
    status: Status
    reason: str = ""
    """Words on why the run is in this state."""
    current: bool = False
    """Whether a browser that has chosen no run opens this one."""
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
    parent: Parent | None = None
    """The run and iteration that this one was branched from."""
    marks: Marks = Marks()


class Row(Summary, frozen=True, kw_only=True):
    """One line of the table of runs: what the list says of a run, and what it has come to."""

    outcome: Outcome = Outcome()


class Runs:
    """Runs of one folder with their trainers. It is thread-safe, and every reading is fresh from the folder."""

    def __init__(
        self,
        folder: Path,
        spawn: Callable[..., subprocess.Popen[bytes]] = spawn_trainer,
        launcher: Slurm | None = None,
        trainers: int | None = None,
    ) -> None:
        """Take the runs of `folder`. New ones are started by `launcher`, by default as processes of this machine.

        While `trainers` are at work on this machine, whoever has started them, further runs wait; None lets none wait.
        """
        self.folder = folder
        self.shown: str | None = None
        """The run that a browser opens which has chosen none; None for the start panel."""
        self._asked: tuple[str, int | None] | None = None
        self._spawn = spawn
        self._launcher = launcher
        self._slurm = launcher or Slurm()
        self._lock = threading.Lock()  # of the tables here: nothing is read while it is held
        self._turns: dict[str, threading.RLock] = {}
        self._pulses: dict[str, Pulse] = {}
        self._histories: dict[str, History] = {}  # least recently used first
        self._unreadable: dict[str, tuple[tuple[int, ...], str]] = {}
        self._ended: dict[str, tuple[int, Summary]] = {}
        self._parents: dict[str, Parent | None] = {}
        self._outcomes: dict[str, tuple[int, Outcome]] = {}
        self._marks: dict[str, tuple[int, Marks]] = {}
        self._inquest = Inquest()
        self._trainers = trainers
        self._waiting = Waiting(folder)
        self._costs: dict[str, str] = {}
        """What an iteration of the runs that were started here takes, in words."""
        self._starting = threading.Lock()  # so that no two take the last place

    # --- reading ---

    def get(self, run_id: str) -> History:
        """Return the run as it is now; raise RunFolderError if it is unknown or unreadable."""
        folder = find_run(self.folder, run_id)
        with self._turn(run_id):
            history = self._tail(folder)
            self._inquest.look(history)
            return history

    def _turn(self, run_id: str) -> threading.RLock:
        """Return the lock under which one run is read, so that a slow or strange one keeps no other waiting."""
        return self._turns.setdefault(run_id, threading.RLock())

    def status(self, history: History) -> tuple[Status, str]:
        """Return what the run does and why, including what only a witness of its trainer's death can know."""
        with self._turn(history.folder.id):
            status, reason = self._in_queue(history.folder, *self._inquest.status(history))
        if status == "starting" and history.folder.id in self._costs:
            reason = f"{reason}; an iteration takes {self._costs[history.folder.id]}"
        if status in _HAS_TRAINER and kill_is_offered(history.folder):
            reason = (
                f"asked to stop {stop_waits(history.folder):.0f} s ago and still in iteration {history.iteration + 1}; "
                f"to end it at once: Kill, or morph-studio stop {history.folder.id} --kill "
                "(what came after its newest checkpoint is then done again)"
            )
        return status, reason

    def ask_slurm(self) -> None:
        """Find out where the runs in Slurm's queue are, and wait for the answer; else it is found out meanwhile."""
        self._slurm.states(self.folder, self.ids())

    def summary(self, run_id: str) -> Summary:
        """Return one line about a run, whatever its state; raise RunFolderError only if there is no such run."""
        folder = find_run(self.folder, run_id)
        try:
            line = self._ended_summary(folder)
            if line is None:
                line = self._summarise(self.get(run_id))
            else:
                status, reason = self._in_queue(folder, line.status, line.reason)
                line = msgspec.structs.replace(line, status=status, reason=reason)
        except Exception as error:  # whatever is wrong with one run, the others are listed
            reason = str(error) if isinstance(error, RunFolderError) else f"{run_id} can't be read: {error!r}"
            line = Summary(id=run_id, status="unreadable", reason=reason[:LONGEST_REASON])
        return msgspec.structs.replace(line, marks=self.marks(folder))

    def summaries(self, names: Collection[str] | None = None) -> list[Summary]:
        """Return all runs, newest first, and at the end the folders that are none but seem to be meant as such.

        With `names`, return only those of them that have these names.
        """
        lines = []
        for run_id in self.ids():
            if names is not None and run_id not in names:
                continue
            with contextlib.suppress(RunFolderError):  # removed this very moment
                lines.append(msgspec.structs.replace(self.summary(run_id), current=run_id == self.shown))
        refused = sorted(
            (name, why) for name, why in passed_over(self.folder).items() if names is None or name in names
        )
        return lines + [Summary(id=name, status="unreadable", reason=why) for name, why in refused]

    def of_task(self, task: str) -> dict[str, str]:
        """Return what people call each run of a task that can be read, or "", by the run's own name, newest first."""
        return {s.id: s.marks.name for s in self.summaries() if s.task == task and s.status != "unreadable"}

    def rows(self, names: Collection[str] | None = None) -> list[Row]:
        """Return all runs with what they have come to, newest first; or, of those with these names, all there are."""
        return [self._row(line) for line in self.summaries(names)]

    def row(self, run_id: str) -> Row:
        """Return one run with what it has come to; raise RunFolderError if there is no such run."""
        return self._row(self.summary(run_id))

    def outcome(self, run_id: str) -> Outcome:
        """Return what a run has come to, nothing where its log is not there; RunFolderError if there is no such run."""
        return self._outcome(find_run(self.folder, run_id))

    def design(self, run_id: str, which: str) -> tuple[RunRecord, list[float]]:
        """Return a run's record and phi of "best", "latest" or an iteration; raise RunFolderError if there is none."""
        if which == "best" and (best := self.outcome(run_id).best):  # known without reading the whole run
            return find_run(self.folder, run_id).record(), best.phi
        history = self.get(run_id)
        return history.record, history.design(which)[1].tolist()

    def evaluations(self, run_id: str) -> tuple[RunRecord, list[Evaluation]]:
        """Return a run's record and its evaluations; raise RunFolderError if there is no such run."""
        folder = find_run(self.folder, run_id)
        with self._turn(run_id):
            return folder.record(), evaluations_of(self._landmarks(folder))

    def marks(self, folder: RunFolder) -> Marks:
        """Return what people have noted about a run."""
        try:
            changed_at = (folder.path / FILE).lstat().st_mtime_ns
        except OSError:
            return Marks()
        known = self._marks.get(folder.id)
        if known is None or known[0] != changed_at:
            known = self._marks[folder.id] = changed_at, read_marks(folder.path)
        return known[1]

    def ids(self) -> list[str]:
        """Return the names of all runs, newest first."""
        return list_runs(self.folder)[::-1]

    def parents(self) -> dict[str, Parent | None]:
        """Return the parent of each run, or None, newest run first; a run that can't be read has none."""
        names = self.ids()
        for name in names:
            if name not in self._parents:  # run.json is written once
                with contextlib.suppress(RunFolderError):
                    self._parents[name] = RunFolder(self.folder / name).record().parent
        return {name: self._parents.get(name) for name in names}

    def watched(self, selected: Collection[str] = ()) -> dict[str, History]:
        """Return the runs that browsers may show, newest first: recent, running, current, and what they `selected`."""
        names = self.ids()
        wanted = {*names[:WATCHED], *self._inquest.children, self.shown, *selected}
        histories = {}
        for name in names:
            if name in wanted:
                with contextlib.suppress(RunFolderError):
                    histories[name] = self.get(name)
        return histories

    def show(self, run_id: str, iteration: int | None = None) -> None:
        """Let every browser show this run, and the design of an iteration; RunFolderError if there is no such one."""
        history = self.get(run_id)
        if iteration is not None:
            history.design(str(iteration))
        self.shown, self._asked = run_id, (run_id, iteration)

    def take_request(self) -> tuple[str, int | None] | None:
        """Return, once, the run and iteration that every browser is to show; None if they stay where they are."""
        asked, self._asked = self._asked, None
        return asked

    def show_newest(self) -> None:
        """Let browsers that have chosen no run open the newest one that can be read, if there is one."""
        for run_id in self.ids():
            with contextlib.suppress(RunFolderError):
                self.shown = self.get(run_id).folder.id
                return

    # --- keeping in order ---

    def mark(self, run_id: str, change: MarksChange) -> Marks:
        """Change what is noted about a run. Raise ValueError, nothing changed, if it is too long or unreadable."""
        folder = find_run(self.folder, run_id)
        with self._turn(run_id):
            marks = changed(read_marks(folder.path), change)
            write_marks(folder.path, marks)
        return marks

    def star(self, run_id: str, design: str, starred: bool) -> Marks:
        """Star a design of a run, or take its star away; RunFolderError if there is no such design.

        Raise ValueError, nothing changed, if too many are starred.
        """
        iteration, _ = self.get(run_id).design(design)
        folder = find_run(self.folder, run_id)
        with self._lock:
            marks = with_star(read_marks(folder.path), iteration, starred)
            write_marks(folder.path, marks)
        return marks

    def discard(self, run_id: str) -> Trashed:
        """Move a run into the trash. Raise ValueError if a trainer is at work on it, or it waits for one."""
        folder = find_run(self.folder, run_id)
        with self._turn(run_id):
            status = self.summary(run_id).status
            if status not in _AT_REST:
                raise ValueError(f"{run_id} is {status}: stop it, then delete it")
            try:
                trashed = trash.discard(folder)
            except RunFolderError as error:
                raise ValueError(f"{run_id} can't be deleted: {error}") from error
            for kept in (self._histories, self._unreadable, self._ended, self._parents, self._outcomes, self._marks):
                kept.pop(run_id, None)
            if self.shown == run_id:
                self.shown = None
        trash.purge(self.folder)
        return trashed

    def restore(self, run_id: str) -> None:
        """Bring a run back from the trash; raise RunFolderError if it is not there, ValueError if its name is taken."""
        trash.restore(self.folder, run_id)

    # --- acting ---

    def start(self, wish: StartRun) -> str:
        """Create a run as `prepare_run` does, start its trainer or queue it, and show it; return its id.

        Raise ValueError if it is not allowed, or the cluster refuses it; then there is no such run.
        """
        folder = prepare_run(self.folder, wish)
        self._costs[folder.id] = cost_of(folder.record())
        if self._launcher:
            try:
                self._launcher.submit(self.folder, [folder.id])
            except SlurmError:
                shutil.rmtree(folder.path)
                raise
        else:
            with self._starting:
                self._begin(folder)
        self.shown = folder.id
        return folder.id

    def tend(self) -> None:
        """Start what waits for a trainer, in order, as far as there is room."""
        if not self._waiting.all():
            return
        with self._starting:
            while (waiting := self._waiting.all()) and self._has_room():
                first = waiting[0]
                if not self._waiting.take(first.run):
                    continue
                with contextlib.suppress(RunFolderError):  # removed while it waited
                    folder = find_run(self.folder, first.run)
                    with self._turn(folder.id):
                        if not self._inquest.is_alive(self.get(folder.id)):  # else somebody was faster
                            self._launch_or_wait(folder, first)

    def resume(self, run_id: str, further: int | None = None, from_start: bool = False) -> None:
        """Start a trainer that goes on from the newest checkpoint; ValueError if one is at work or nothing is left.

        Where no checkpoint can be read any more it ends with a sentence, unless it may begin anew `from_start`.
        A run that came from Slurm's queue goes back into it: no trainer of it starts on this machine.
        """
        if further is not None:
            further = limits.iterations(further, "further")
        folder = find_run(self.folder, run_id)
        watched = not self.get(run_id).pulse.is_alive and at_work(folder.heartbeat)  # before it is anybody's turn
        with self._starting, self._turn(run_id):
            history = self.get(run_id)
            status, _ = self.status(history)
            if watched or self._inquest.is_alive(history):
                raise ValueError(f"{run_id} has a trainer already and is {status}; send it the command resume instead")
            if status == "queued" and slurm_launch(history.folder):
                raise ValueError(f"{run_id} is in Slurm's queue already: {self.status(history)[1]}")
            if self._waiting.place(run_id):
                raise ValueError(f"{run_id} waits already: {self.status(history)[1]}")
            if status == "finished" and further is None:
                raise ValueError(f"{run_id} has finished: say how many iterations it shall do further")
            queued = slurm_launch(history.folder)
            if queued and from_start:
                raise ValueError(f"{run_id} came from Slurm's queue, from which none begins anew: start a new run")
            if not queued:
                self._begin(history.folder, further, from_start)
        if queued:
            until = history.iteration + further if further is not None else None
            self._slurm.resume(self.folder, run_id, until=until)
        if history.paused_by_user:  # else its trainer would come back paused
            history.folder.send(Resume(), "studio")
        self.shown = run_id

    def send(self, run_id: str, command: AnyCommand, sender: str = "") -> int:
        """Put a command into the run's inbox and return its id; ValueError, the run unchanged, if it is no good.

        `sender` says in words who sends it and by which way, for the log.
        Kill ends its trainer, and Stop takes a run that waits out of the queue; that no trainer acknowledges: the id
        is 0. What a run that has failed is to hold instead waits until it is resumed, and is obeyed before it goes on.
        """
        history = self.get(run_id)
        if isinstance(command, Kill | Stop) and self._waiting.take(run_id):
            inside.touch(history.folder.path, CANCELLED)
            return 0
        if isinstance(command, Kill):
            with self._turn(run_id):
                self._inquest.kill(history)
                forget_stops(history.folder)
            return 0
        task = make_task(history.record.task, history.record.task_options)
        command = check_command(command, history.in_force, task)
        with self._turn(run_id):
            alive, (status, _) = self._inquest.is_alive(history), self.status(history)
        if not alive and not (status == "failed" and isinstance(command, AnyEdit)):  # obeyed when it is resumed
            if status != "queued":
                raise ValueError(f"{run_id} is {status}: resume it, then send commands")
            if not isinstance(command, Stop) or not slurm_launch(history.folder):
                raise ValueError(f"{run_id} waits in the queue: send commands once it has begun")
            self._slurm.cancel(self.folder, [run_id])
            return 0
        return history.folder.send(command, sender)

    def _begin(self, folder: RunFolder, further: int | None = None, from_start: bool = False) -> None:
        """Start a trainer, or let the run wait where as many are at work as may be, or others wait.

        Whoever calls this is the only one that starts any.
        """
        if not launcher_of(folder.path):
            (folder.path / CANCELLED).unlink(missing_ok=True)
        if self._waiting.all() or not self._has_room(folder.id):
            self._waiting.add(Wait(folder.id, further, from_start))
            return
        with self._turn(folder.id):
            self._launch(folder, further, from_start)

    def _has_room(self, besides: str = "") -> bool:
        """Tell whether one more trainer may be started on this machine; the run `besides` has none yet."""
        return (
            self._trainers is None
            or sum(self._is_at_work(run) for run in self.ids() if run != besides) < self._trainers
        )

    def _is_at_work(self, run_id: str) -> bool:
        """Tell whether a run has a trainer on this machine."""
        try:
            if self.summary(run_id).status not in _HAS_TRAINER:
                return False
            beat = self.get(run_id).heartbeat
        except RunFolderError:
            return False
        return beat is None or beat.host == platform.node()

    def _launch(self, folder: RunFolder, further: int | None = None, from_start: bool = False) -> None:
        self._inquest.begin(folder, lambda: self._spawn(folder, further=further, from_start=from_start))

    def _launch_or_wait(self, folder: RunFolder, wait: Wait) -> None:
        """Start a trainer; where the system has no room for another process, the run waits on."""
        try:
            self._launch(folder, wait.further, wait.from_start)
        except OSError:
            self._waiting.add(wait)
            raise

    def _in_queue(self, folder: RunFolder, status: Status, reason: str) -> tuple[Status, str]:
        """Return what a run does and why, with what the queue, or Slurm, says of it where its folder can't tell."""
        if status not in ("running", "pausing", "paused") and (place := self._waiting.place(folder.id)):
            full = "one trainer is" if self._trainers == 1 else f"{self._trainers or 'enough'} trainers are"
            return "queued", f"number {place} in the queue: {full} at work already"
        if status == "lost" and (folder.path / CANCELLED).exists() and not folder.read_events()[0]:
            return "stopped", "taken out of the queue before it had begun; Resume starts it"
        launch = slurm_launch(folder) if status in _TOLD_BY_SLURM else None
        if launch is None:
            return status, reason
        place = self._slurm.states(self.folder, [folder.id], patient=False).get(folder.id)
        if place is None:
            waiting = f"in Slurm's queue as job {launch.job}; {self._slurm.trouble or 'Slurm has not been asked yet'}"
            return status, waiting if status == "queued" else reason
        if place.where:
            if status == "lost":
                return "running", f"it runs on {place.where}, but its heartbeat does not reach this machine"
            return ("starting", f"on {place.where}") if status == "queued" else (status, reason)
        if not place.given_up:
            return "queued", place.why
        if status == "queued":
            return ("stopped" if (folder.path / CANCELLED).exists() else "failed"), place.why
        return status, f"{reason} ({place.why})" if status == "lost" and place.why else reason

    # --- opening ---

    def _row(self, line: Summary) -> Row:
        return Row(**msgspec.structs.asdict(line), outcome=self._outcome(RunFolder(self.folder / line.id)))

    def _outcome(self, folder: RunFolder) -> Outcome:
        """Return what a run has come to; its log is read again only when it has grown."""
        try:
            size = folder.events.lstat().st_size
        except OSError:
            return Outcome()
        with self._turn(folder.id):
            known = self._outcomes.get(folder.id)
            if known is None or known[0] != size:
                known = self._outcomes[folder.id] = size, outcome_of(self._landmarks(folder))
            return known[1]

    def _landmarks(self, folder: RunFolder) -> list[AnyEvent]:
        history = self._histories.get(folder.id)
        if history is None:
            return landmarks(folder.path)
        with contextlib.suppress(RunFolderError):  # its line says why
            history.poll()
        return history.events

    def _tail(self, folder: RunFolder) -> History:
        """Return the run's history, polled; an unreadable run is not read again until one of its files changes."""
        changed = tuple(_changed(folder.path / name) for name in ("run.json", "events.jsonl", "heartbeat.json"))
        known = self._unreadable.get(folder.id)
        if known and known[0] == changed:
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
                self._unreadable[folder.id] = changed, reason
            raise RunFolderError(reason) from error
        with self._lock:
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
            parent=record.parent,
        )

    def _ended_summary(self, folder: RunFolder) -> Summary | None:
        """Return the line of a run that has ended from the end of its log alone: hundreds stay quick to list."""
        if self._inquest.concerns(folder.id) or folder.id in self._histories:
            return None
        try:
            size = folder.events.lstat().st_size
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
            parent=record.parent,
        )
        self._ended[folder.id] = size, line
        return line


def _changed(path: Path) -> int:
    """Return when a file was last changed, in nanoseconds; 0 where there is none."""
    try:
        return path.lstat().st_mtime_ns
    except OSError:
        return 0


def _may_pass(error: BaseException) -> bool:
    """Tell whether what kept a run from being read may be over the next time: too many open files, a slow disk."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return isinstance(cause, OSError) and not isinstance(cause, NotPlainError)
