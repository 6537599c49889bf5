"""Moments of a run: what was in force at an iteration, and the iterations at which something happened."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec

from morph_core.config import Projection
from morph_core.history import History
from morph_core.protocol import Evaluation, Parameter, Progress, StateChanged
from studio.log import LogEntry, acknowledgement, log_of

Kind = Literal["command", "freeze", "restart", "resume", "best", "starred", "episode"]
MEANINGS: dict[Kind, str] = {
    "command": "command",
    "freeze": "φ frozen",
    "restart": "policy from scratch",
    "resume": "trainer started again",
    "best": "best evaluation",
    "starred": "starred",
    "episode": "recorded episode",
}


class Moment(msgspec.Struct, frozen=True, kw_only=True):
    """A run at one of its iterations."""

    iteration: int
    phi: list[float]
    alpha: float | None
    """The weight alpha in force; None for a method without a proxy."""
    projection: Projection | None
    """Projection rule in force; None for a method without a proxy."""
    parameters: list[Parameter]
    """Design parameters with the bounds and locks in force."""
    progress: Progress | None
    """What the iteration recorded; None for the initial design."""
    evaluation: Evaluation | None
    """Evaluation in this iteration, or the last one before it."""
    commands: list[LogEntry]
    """Commands that took effect before this iteration and are not undone, oldest first."""


@dataclass(frozen=True)
class Mark:
    """One iteration at which something happened, with a sentence on it."""

    iteration: int
    kind: Kind
    words: str


def moment_of(history: History, which: str) -> Moment:
    """Return a run at "best", "latest" or an iteration. Raise RunFolderError if it has none such."""
    iteration, phi = history.design(which)
    in_force, steered = history.at(iteration), _is_steered(history)
    return Moment(
        iteration=iteration,
        phi=phi.tolist(),
        alpha=in_force.alpha if steered else None,
        projection=in_force.projection if steered else None,
        parameters=list(in_force.space.parameters),
        progress=next((p for p in history.progress if p.iteration == iteration), None),
        evaluation=next((e for e in reversed(history.evaluations) if e.iteration <= iteration), None),
        commands=[e for e in log_of(history) if e.command and e.accepted and not e.undone and e.iteration < iteration],
    )


def in_force_words(history: History, iteration: int) -> list[str]:
    """Return clauses on what commands can change, as it was in force at an iteration."""
    in_force, before = history.at(iteration), history.record.parameters
    clauses = [f"α {in_force.alpha:g}", f"projection {in_force.projection}"] if _is_steered(history) else []
    pairs = list(zip(in_force.space.parameters, before, strict=True))
    bounds = [f"{p.name} [{p.lo:.4g}, {p.hi:.4g}] {p.unit}" for p, q in pairs if (p.lo, p.hi) != (q.lo, q.hi)]
    locks = [f"{p.name} at {p.locked_at:.4g} {p.unit}" for p, _ in pairs if p.locked_at is not None]
    clauses.append(f"bounds: {', '.join(bounds)}, the others as at the start" if bounds else "bounds as at the start")
    clauses.append(f"locked: {', '.join(locks)}" if locks else "nothing locked")
    return clauses


def marks_of(history: History, starred: Sequence[int] = ()) -> list[Mark]:
    """Return the marks of a run's timeline, by iteration; `starred` are the iterations of starred designs."""
    marks = [*_commands(history), *_changes(history.progress), *_resumes(history), *_evaluations(history)]
    last = history.iteration
    marks += [Mark(i, "starred", f"the design of iteration {i} is starred") for i in starred if i <= last]
    return sorted(marks, key=lambda mark: mark.iteration)


def _is_steered(history: History) -> bool:
    """Tell whether alpha and projection mean something in a run's method."""
    return "alpha" in history.record.config


def _commands(history: History) -> Iterator[Mark]:
    for event in history.commands():
        yield Mark(event.iteration, "command", f"{acknowledgement(event, history.design_space)}")


def _changes(progress: Sequence[Progress]) -> Iterator[Mark]:
    """Yield where phi was frozen or let go, and where policy and critic started afresh."""
    frozen, start = False, progress[0].control_start if progress else 0
    for p in progress:
        if p.frozen != frozen:
            said = "φ is frozen from here on: episodes succeed often enough" if p.frozen else "φ moves again"
            yield Mark(p.iteration, "freeze", f"iteration {p.iteration}: {said}")
        if p.control_start != start:
            yield Mark(p.iteration, "restart", f"iteration {p.iteration}: policy and critic start from scratch")
        frozen, start = p.frozen, p.control_start


def _resumes(history: History) -> Iterator[Mark]:
    """Yield where a trainer went on from a checkpoint, of those whose iterations stand."""
    starts = [e for e in history.events if isinstance(e, StateChanged) and e.status == "starting"]
    for i, event in enumerate(starts[1:], 1):
        if all(later.iteration >= event.iteration for later in starts[i:]):
            yield Mark(event.iteration, "resume", f"iteration {event.iteration}: a trainer went on from its checkpoint")


def _evaluations(history: History) -> Iterator[Mark]:
    def said(e: Evaluation, what: str) -> str:
        return f"iteration {e.iteration}: {what}, success {100 * e.sampled_success:.0f} %"

    for e in history.evaluations:
        if e.episode:
            yield Mark(e.iteration, "episode", said(e, "recorded"))
    if best := history.best:
        yield Mark(best.iteration, "best", said(best, "best evaluation"))
