"""What has happened in a run so far, read from its folder: the one view that studio, command line and export share."""

import bisect
import dataclasses
import math
import time
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from morph_core.config import Projection
from morph_core.curves import Curves, draw_run
from morph_core.design import DesignSpace
from morph_core.hypertext import table
from morph_core.protocol import (
    Acknowledged,
    AnyEvent,
    DesignSpaceChanged,
    Evaluation,
    Heartbeat,
    InjectDesign,
    Pause,
    Progress,
    Resume,
    RunRecord,
    SetAlpha,
    SetProjection,
    StateChanged,
    Status,
    StepIteration,
    Stop,
)
from morph_core.pulse import Pulse
from morph_core.run_folder import ITERATION, SAID_ENDED, RunFolder, RunFolderError

STARTS_WITHIN = 10.0
"""Seconds after its creation in which a run has a heartbeat, unless it is queued."""
_HOLDS = Pause | StepIteration
"""The commands after which a run holds."""


@dataclass(frozen=True, eq=False)
class InForce:
    """All that commands can change in a run, as it is when an iteration begins."""

    space: DesignSpace
    phi: np.ndarray  # (d,)
    alpha: float
    projection: Projection


class _Steered(msgspec.Struct, frozen=True):
    """The settings of a run that commands can change; a method without a proxy may record none."""

    alpha: float = 0.0
    projection: Projection = "none"


class History:
    """A tail of one run folder. `poll` takes in what is new; everything else answers from memory."""

    def __init__(self, folder: RunFolder, pulse: Pulse | None = None) -> None:
        """Read run.json; raise RunFolderError if the folder has no readable one.

        `pulse` is what has been seen of its heartbeats so far, by a reader who has opened it before.
        """
        self.folder = folder
        self.pulse = Pulse() if pulse is None else pulse
        self.record: RunRecord = folder.record()
        self.events: list[AnyEvent] = []
        self.progress: list[Progress] = []
        self.evaluations: list[Evaluation] = []
        self.acknowledged: list[Acknowledged] = []
        self.state: StateChanged | None = None
        self.heartbeat: Heartbeat | None = None
        self.other_processor = ""
        """Warning that the run was started again on another kind of processor, in words; empty where it was not."""
        self._processor = ""
        self._changes: list[Acknowledged | DesignSpaceChanged] = []
        self._offset = 0
        self.in_force = self.at()
        self.poll()

    def poll(self) -> list[AnyEvent]:
        """Take in what was written since the last call and return the new events.

        Raise RunFolderError where it is no plain files, or an event does not fit the run.
        """
        self.heartbeat = self.folder.heartbeat()
        self.pulse.see(self.heartbeat)
        events, self._offset = self.folder.read_events(self._offset)
        for event in events:
            self._refuse_foreign(event)
            match event:
                # A resume voids what came after its checkpoint.
                case StateChanged(status="starting", iteration=iteration):
                    self.progress = [p for p in self.progress if p.iteration <= iteration]
                    self.evaluations = [e for e in self.evaluations if e.iteration <= iteration]
                    self._changes = [e for e in self._changes if e.iteration <= iteration]
                case Progress():
                    self.progress.append(event)
                case Evaluation():
                    self.evaluations.append(event)
                case Acknowledged():
                    self.acknowledged.append(event)
                    if event.accepted:
                        self._changes.append(event)
                case DesignSpaceChanged():
                    self._changes.append(event)
            if isinstance(event, StateChanged):
                self.state = event
                self._compare_processors(event)
        self.events.extend(events)
        if events:
            self.in_force = self.at()
        return events

    def _refuse_foreign(self, event: AnyEvent) -> None:
        """Raise RunFolderError where an event has another number of design parameters than the run, or no count."""
        match event:
            case Progress(phi=values) | Evaluation(phi=values) | DesignSpaceChanged(parameters=values):
                given = len(values)
            case Acknowledged(accepted=True, command=InjectDesign(phi=values)):
                given = len(values)
            case _:
                given = len(self.record.parameters)
        if given != len(self.record.parameters):
            raise RunFolderError(
                f"event {event.seq} of {self.folder.id} can't be read: it has {given} design parameters, and the run "
                f"{len(self.record.parameters)}"
            )

    def _compare_processors(self, event: StateChanged) -> None:
        if not event.processor:
            return
        now = f"{event.processor}, {event.instruction_set}"
        if self._processor and now != self._processor:
            self.other_processor = (
                f"begun on {self._processor}, went on from iteration {event.iteration} on {now}: "
                "an uninterrupted run may differ in its last bits, and so in its course"
            )
        self._processor = now

    def at(self, iteration: float = math.inf) -> InForce:
        """Return what was in force when `iteration` began, by default what is now. What a resume voided never was."""
        number = bisect.bisect_left(self.progress, iteration, key=lambda p: p.iteration)
        before = [*self.progress[max(0, number - 1) : number], *(e for e in self._changes if e.iteration < iteration)]
        found = self._begun_with()
        for event in sorted(before, key=lambda e: e.seq):
            found = _after(event, found)
        return found

    def commands(self, iteration: float = math.inf) -> list[Acknowledged]:
        """Return the commands that were obeyed before `iteration`, and not undone by a resume from before them."""
        return [e for e in self._changes if isinstance(e, Acknowledged) and e.iteration < iteration]

    @property
    def paused_by_user(self) -> bool:
        """Whether a user has paused the run, and no later command lets it go on or stops it."""
        said = [e.command for e in self.acknowledged if e.accepted and isinstance(e.command, _HOLDS | Resume | Stop)]
        return bool(said) and isinstance(said[-1], _HOLDS)

    def _begun_with(self) -> InForce:
        space = DesignSpace(tuple(self.record.parameters))
        try:
            steered = msgspec.convert(self.record.config, _Steered)
        except msgspec.ValidationError:  # a folder from elsewhere: what can't be read is shown as the default
            steered = _Steered()
        return InForce(space, space.initial, steered.alpha, steered.projection)

    @property
    def design_space(self) -> DesignSpace:
        """The bounds and locks now in force."""
        return self.in_force.space

    @property
    def status(self) -> Status:
        """What the trainer last said, unless it is gone: then `lost` (no word of an end, no process, no heartbeat).

        A run that no trainer has taken up yet is `queued` as long as something sees to it that it is started.
        """
        status: Status = self.state.status if self.state else "starting"
        if status in SAID_ENDED:
            return status
        beat = self.heartbeat
        if beat is None:
            if self.state is None and self.folder.is_launched():
                return "queued"
            return status if abs(time.time() - self.record.created) < STARTS_WITHIN else "lost"
        if not self.pulse.is_alive:
            return beat.status if beat.status in SAID_ENDED else "lost"
        return beat.status if beat.status != "starting" else status

    @property
    def message(self) -> str:
        """Why the run is in this state, in words."""
        if self.status == "queued":
            return "no trainer has taken it up yet"
        if self.status == "lost":
            return (
                "the trainer died without a word (killed, or the machine went down); "
                "resume goes on from its newest checkpoint"
            )
        if self.heartbeat and self.heartbeat.message and self.status not in SAID_ENDED:
            return self.heartbeat.message
        return self.state.message if self.state else ""

    @property
    def begins_at(self) -> int:
        """Iteration from which the run counts on; 0 but for a branch that goes on where its parent was."""
        return self.record.begins_at

    @property
    def iteration(self) -> int:
        """Last iteration that was recorded; before the first, that from which the run counts on."""
        return self.progress[-1].iteration if self.progress else self.begins_at

    @property
    def planned_iterations(self) -> int | None:
        """Iterations after which the run ends; where a budget ends it, the trainer's estimate, None before it began."""
        beat = self.heartbeat
        if self.record.env_steps is not None:
            return max(beat.iterations, self.iteration) if beat else None
        return max(beat.iterations, self.record.iterations) if beat else self.record.iterations

    @property
    def phi(self) -> np.ndarray:
        """Design phi (d,) now in force."""
        return np.array(self.progress[-1].phi) if self.progress else self.initial_phi

    @property
    def initial_phi(self) -> np.ndarray:
        """Design phi (d,) with which the run began."""
        return DesignSpace(tuple(self.record.parameters)).initial

    @property
    def best(self) -> Evaluation | None:
        """The evaluation with the most sampled success, then the highest return."""
        return max(self.evaluations, key=merit, default=None)

    @property
    def last_evaluation(self) -> Evaluation | None:
        """The evaluation at the end of the budget, or the last one before it."""
        return max(self.evaluations, key=lambda e: (e.final, e.iteration), default=None)

    def first_evaluation(self, kind: Literal["sampled", "deterministic"], level: float) -> Evaluation | None:
        """Return the first evaluation in which the success of this policy was at least `level`."""
        return next((e for e in self.evaluations if getattr(e, f"{kind}_success") >= level), None)

    @property
    def cpu_seconds(self) -> float:
        """CPU time until the last word of an iteration or an evaluation."""
        return max((e.cpu_seconds for e in (*self.progress[-1:], *self.evaluations[-1:])), default=0.0)

    def design(self, which: str) -> tuple[int, np.ndarray]:
        """Return iteration and phi (d,) of "best", "latest", or an iteration; 0 is the initial design, of a branch too.

        Raise RunFolderError that says what is allowed.
        """
        if which == "latest":
            return self.iteration, self.phi
        if which == "best":
            best = self.best
            return (best.iteration, np.array(best.phi)) if best else (self.iteration, self.phi)
        if which in ("0", str(self.begins_at)):
            return self.begins_at, self.initial_phi
        if not ITERATION.fullmatch(which):
            raise RunFolderError(f'no design "{which[:40]}"; choose best, latest or an iteration (0: the initial one)')
        number = bisect.bisect_left(self.progress, int(which), key=lambda p: p.iteration)
        if number < len(self.progress) and self.progress[number].iteration == int(which):
            return self.progress[number].iteration, np.array(self.progress[number].phi)
        allowed = f"choose best, latest or {self.begins_at} to {self.iteration}"
        raise RunFolderError(f"{self.folder.id} has no iteration {which}; {allowed}")

    # --- in a notebook ------------------------------------------------------------------------------------------------

    def plot(self) -> Curves:
        """Return the curves of the run: success, return, cosine, divergence and phi over environment steps.

        Raise ImportError that names the extra where matplotlib is missing.
        """
        title = f"{self.folder.id}: {self.record.task}, {self.record.method}"
        return draw_run(title, self.progress, self.evaluations, self.record.parameters)

    def _repr_html_(self) -> str:
        """Return what the run has come to as HTML tables; `poll` takes in what has happened since."""
        planned = self.planned_iterations
        rows = [
            ("task", self.record.task),
            ("method", f"{self.record.method}, seed {self.record.seed}"),
            ("state", f"{self.status}: {self.message}" if self.message else self.status),
            ("iterations", f"{self.iteration} of {planned}" if planned else str(self.iteration)),
            ("environment steps", f"{self.progress[-1].env_steps if self.progress else 0:,}"),
            ("CPU time", f"{self.cpu_seconds:.0f} s"),
            ("best evaluation", _in_words(self.best)),
        ]
        designs = {"initial": self.initial_phi, "best": self.design("best")[1], "latest": self.phi}
        return table((), rows, f"Run {self.folder.id}") + self.design_space.table(designs, "Its designs")


def _in_words(best: Evaluation | None) -> str:
    if best is None:
        return "none yet"
    return (
        f"iteration {best.iteration}: success {best.sampled_success:.0%} sampled, {best.deterministic_success:.0%} "
        "mean action"
    )


def merit(evaluation: Evaluation) -> tuple[float, float]:
    """Return what makes one evaluation better than another: sampled success, then the return."""
    return evaluation.sampled_success, evaluation.sampled_return


def _after(event: Progress | Acknowledged | DesignSpaceChanged, before: InForce) -> InForce:
    """Return what is in force after an event: an iteration records what it ran with, a command changes it."""
    match event:
        case Progress(phi=phi, alpha=alpha, projection=rule):
            alpha = before.alpha if alpha is None else alpha
            return InForce(before.space, np.array(phi), alpha, rule or before.projection)
        case DesignSpaceChanged(parameters=parameters):
            space = DesignSpace(tuple(parameters))
            return dataclasses.replace(before, space=space, phi=space.clip(before.phi))
        case Acknowledged(command=SetAlpha(alpha=alpha)):
            return dataclasses.replace(before, alpha=alpha)
        case Acknowledged(command=SetProjection(projection=rule)):
            return dataclasses.replace(before, projection=rule)
        case Acknowledged(command=InjectDesign(phi=phi)):
            return dataclasses.replace(before, phi=before.space.clip(np.array(phi)))
    return before
