"""The runs of one folder: listed, followed, started and steered."""

import shutil
import subprocess
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import msgspec

from morph_core import inside
from morph_core.catalogue import make_task
from morph_core.edits import TAKES_LATER_EDITS, AnyEdit
from morph_core.history import History
from morph_core.protocol import AnyCommand, Evaluation, Kill, Parent, Resume, RunRecord, Status, Stop
from morph_core.pulse import at_work
from morph_core.run_folder import RunFolder, RunFolderError
from studio import limits
from studio.commands import check_command
from studio.cost import cost_of
from studio.crew import Crew
from studio.histories import Histories
from studio.inquest import Inquest
from studio.lines import AT_REST, HAS_TRAINER, Row, Summary
from studio.listing import Listing
from studio.new_run import StartRun, prepare_run
from studio.overdue import forget_stops
from studio.recordings import Recordings
from studio.shelf import trash
from studio.shelf.marks import Marks, MarksChange, changed, marks_to_change, with_star, write_marks
from studio.shelf.outcome import Outcome
from studio.shelf.trash import Trashed
from studio.statuses import Statuses
from studio.study.local import CANCELLED
from studio.study.slurm import Slurm, slurm_launch
from studio.study.slurm_queue import SlurmError
from studio.trainers import spawn_trainer
from studio.waiting import Waiting

L = TypeVar("L", bound=Summary)
WATCHED = 20
"""Number of the newest runs that browsers are offered, beside those that run and those they show."""


class Runs:
    """Runs of one folder with their trainers. It is thread-safe, and every reading is fresh from the folder."""

    def __init__(
        self,
        folder: Path,
        spawn: Callable[..., subprocess.Popen[bytes]] = spawn_trainer,
        launcher: Slurm | None = None,
        trainers: int | None = None,
        recordings: Recordings | None = None,
    ) -> None:
        """Take the runs of `folder`. New ones are started by `launcher`, by default as processes of this machine.

        While `trainers` are at work on this machine, whoever has started them, further runs wait; None lets none wait.
        The `recordings`, by default those that come with the studio, are opened like runs, but never listed as such.
        """
        self.folder = folder
        self.recordings = recordings or Recordings()
        self.shown: str | None = None
        """The run that a browser opens which has chosen none; None for the start panel."""
        self._asked: tuple[str, int | None] | None = None
        self._launcher = launcher
        self._slurm = launcher or Slurm()
        self._waiting = Waiting(folder)
        self._inquest = Inquest()
        self._histories = Histories(folder, self._inquest, self.recordings)
        self._statuses = Statuses(folder, self._histories, self._inquest, self._waiting, self._slurm, trainers)
        self._listing = Listing(folder, self._histories, self._statuses, self._inquest)
        self._crew = Crew(folder, self._histories, self._inquest, self._waiting, self._has_trainer, spawn, trainers)

    # --- reading ---

    def get(self, run_id: str) -> History:
        """Return the run as it is now; raise RunFolderError if it is unknown or unreadable."""
        return self._histories.get(run_id)

    def status(self, history: History) -> tuple[Status, str]:
        """Return what the run does and why, including what only a witness of its trainer's death can know."""
        return self._statuses.of(history)

    def ask_slurm(self) -> None:
        """Find out where the runs in Slurm's queue are, and wait for the answer; else it is found out meanwhile."""
        self._slurm.states(self.folder, self.ids())

    def summary(self, run_id: str) -> Summary:
        """Return one line about a run, whatever its state; raise RunFolderError only if there is no such run."""
        return self._listing.line(self._histories.find(run_id))

    def summaries(self, names: Collection[str] | None = None) -> list[Summary]:
        """Return all runs, newest first, and at the end the folders that are none but seem to be meant as such.

        With `names`, return only those of them that have these names.
        """
        return self._with_current(self._listing.lines(names))

    def of_task(self, task: str) -> dict[str, str]:
        """Return what people call each run of a task that can be read, or "", by the run's own name, newest first."""
        return {s.id: s.marks.name for s in self.summaries() if s.task == task and s.status != "unreadable"}

    def rows(self, names: Collection[str] | None = None) -> list[Row]:
        """Return all runs with what they have come to, newest first; or, of those with these names, all there are."""
        return self._with_current(self._listing.rows(names))

    def row(self, run_id: str) -> Row:
        """Return one run with what it has come to; raise RunFolderError if there is no such run."""
        return Row(**msgspec.structs.asdict(self.summary(run_id)), outcome=self.outcome(run_id))

    def outcome(self, run_id: str) -> Outcome:
        """Return what a run has come to, nothing where its log is not there; RunFolderError if there is no such run."""
        return self._listing.outcome(self._histories.find(run_id))

    def design(self, run_id: str, which: str) -> tuple[RunRecord, list[float]]:
        """Return a run's record and phi of "best", "latest" or an iteration; raise RunFolderError if there is none."""
        if which == "best" and (best := self.outcome(run_id).best):  # known without reading the whole run
            return self._histories.find(run_id).record(), best.phi
        history = self.get(run_id)
        return history.record, history.design(which)[1].tolist()

    def evaluations(self, run_id: str) -> tuple[RunRecord, list[Evaluation]]:
        """Return a run's record and its evaluations; raise RunFolderError if there is no such run."""
        folder = self._histories.find(run_id)
        return folder.record(), self._listing.evaluations(folder)

    def marks(self, folder: RunFolder) -> Marks:
        """Return what people have noted about a run."""
        return self._listing.marks(folder)

    def ids(self) -> list[str]:
        """Return the names of all runs, newest first."""
        return self._listing.ids()

    def parents(self) -> dict[str, Parent | None]:
        """Return the parent of each run, or None, newest run first; a run that can't be read has none."""
        return self._listing.parents()

    def watched(self, selected: Collection[str] = ()) -> dict[str, History]:
        """Return the runs that browsers may show, newest first: recent, running, current, and what they `selected`."""
        names = self.ids()
        wanted = {*names[:WATCHED], *self._inquest.children, self.shown, *selected}
        histories = {}
        recorded = [name for name in wanted.difference(names) if name in self.recordings]
        for name in (*names, *recorded):
            if name in wanted:
                with suppress(RunFolderError):
                    histories[name] = self.get(name)
        return histories

    def statuses(
        self, histories: Mapping[str, History], selected: Collection[str] = ()
    ) -> dict[str, tuple[Status, str]]:
        """Return what runs do and why; of those that were `selected` and can't be read, why not."""
        said = {name: self.status(history) for name, history in histories.items()}
        for name in set(selected).difference(histories):
            with suppress(RunFolderError):
                line = self.summary(name)
                said[name] = line.status, line.reason
        return said

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
            with suppress(RunFolderError):
                self.shown = self.get(run_id).folder.id
                return

    # --- keeping in order ---

    def mark(self, run_id: str, change: MarksChange) -> Marks:
        """Change what is noted about a run. Raise ValueError, nothing changed, if it is too long, or if what
        was noted before can't be read."""
        folder = self._own(run_id, "marked")
        with self._histories.turn(run_id):
            marks = changed(marks_to_change(folder.path), change)
            write_marks(folder.path, marks)
        return marks

    def star(self, run_id: str, design: str, starred: bool) -> Marks:
        """Star a design of a run, or take its star away; RunFolderError if there is no such design.

        Raise ValueError, nothing changed, if too many are starred, or what was noted before can't be read.
        """
        folder = self._own(run_id, "marked")
        iteration, _ = self.get(run_id).design(design)
        with self._histories.turn(run_id):
            marks = with_star(marks_to_change(folder.path), iteration, starred)
            write_marks(folder.path, marks)
        return marks

    def discard(self, run_id: str) -> Trashed:
        """Move a run into the trash. Raise ValueError if a trainer is at work on it, or it waits for one."""
        folder = self._own(run_id, "deleted")
        with self._histories.turn(run_id):
            status = self.summary(run_id).status
            if status not in AT_REST:
                raise ValueError(f"{run_id} is {status}: stop it, then delete it")
            try:
                trashed = trash.discard(folder)
            except RunFolderError as error:
                raise ValueError(f"{run_id} can't be deleted: {error}") from error
            self._histories.forget(run_id)
            self._listing.forget(run_id)
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
        if wish.branch:
            self._own(wish.branch.run, "branched from")
        folder = prepare_run(self.folder, wish)
        self._statuses.costs[folder.id] = cost_of(folder.record())
        if self._launcher:
            try:
                self._launcher.submit(self.folder, [folder.id])
            except SlurmError:
                shutil.rmtree(folder.path)
                raise
        else:
            self._crew.begin(folder)
        self.shown = folder.id
        return folder.id

    def tend(self) -> None:
        """Start what waits for a trainer, in order, as far as there is room."""
        self._crew.tend()

    def resume(self, run_id: str, further: int | None = None, from_start: bool = False) -> None:
        """Start a trainer that goes on from the newest checkpoint; ValueError if one is at work or nothing is left.

        Where no checkpoint can be read any more it ends with a sentence, unless it may begin anew `from_start`.
        A run that came from Slurm's queue goes back into it: no trainer of it starts on this machine.
        """
        if further is not None:
            further = limits.iterations(further, "further")
        folder = self._own(run_id, "resumed")
        watched = not self.get(run_id).pulse.is_alive and at_work(folder.heartbeat)  # before it is anybody's turn
        with self._crew.starting, self._histories.turn(run_id):
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
                self._crew.begin(history.folder, further, from_start)
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
        is 0. An edit of a run that has failed or was lost waits until it is resumed, and is obeyed before it goes on.
        """
        self._own(run_id, "steered")
        history = self.get(run_id)
        if isinstance(command, Kill | Stop) and self._waiting.take(run_id):
            inside.touch(history.folder.path, CANCELLED)
            return 0
        if isinstance(command, Kill):
            with self._histories.turn(run_id):
                self._inquest.kill(history)
                forget_stops(history.folder)
            return 0
        task = make_task(history.record.task, history.record.task_options)
        command = check_command(command, history.in_force, task)
        with self._histories.turn(run_id):
            alive, (status, _) = self._inquest.is_alive(history), self.status(history)
        if not alive and not (status in TAKES_LATER_EDITS and isinstance(command, AnyEdit)):  # obeyed at its resume
            if status != "queued" and isinstance(command, Stop):
                raise ValueError(f"{run_id} is {status}: no trainer is at work on it that could be stopped")
            if status != "queued":
                raise ValueError(f"{run_id} is {status}: resume it, then send commands")
            if not isinstance(command, Stop) or not slurm_launch(history.folder):
                raise ValueError(f"{run_id} waits in the queue: send commands once it has begun")
            self._slurm.cancel(self.folder, [run_id])
            return 0
        return history.folder.send(command, sender)

    def _own(self, run_id: str, what: str) -> RunFolder:
        """Return a run of the folder; ValueError for a recorded one, which can't be asked for `what`."""
        folder = self._histories.find(run_id)
        if folder.path.parent != self.folder:
            self.recordings.refuse(run_id, what)
        return folder

    def _with_current(self, lines: Sequence[L]) -> list[L]:
        """Return lines of which one says that browsers open it which have chosen no run."""
        return [msgspec.structs.replace(line, current=True) if line.id == self.shown else line for line in lines]

    def _has_trainer(self, run_id: str) -> bool:
        """Tell whether a trainer is at work on a run, on whatever machine."""
        return self.summary(run_id).status in HAS_TRAINER
