"""A line of the list of runs, and how it is read: from a run's history, or from the end of its log alone."""

import msgspec

from morph_core.design import DesignSpace
from morph_core.history import History
from morph_core.protocol import Evaluation, Parent, Rate, StateChanged, Status, Whole
from morph_core.run_folder import SAID_ENDED, RunFolder
from studio.shelf.marks import Marks
from studio.shelf.outcome import Outcome

HAS_TRAINER: tuple[Status, ...] = ("starting", "running", "pausing", "paused")
"""States of a run that a trainer is at work on."""
AT_REST: tuple[Status, ...] = (*SAID_ENDED, "lost", "unreadable")
"""States of a run that no trainer is at work on, and none is to be."""
_TAIL = 65536
"""Bytes at the end of a log in which a trainer says how it ended, and an evaluation stands before that."""


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
    seed: Whole | None = None
    created: float | None = None
    iteration: Whole = 0
    iterations: Whole | None = None
    stage: str = ""
    eta_seconds: float | None = None
    success: Rate | None = None
    """Share of episodes in which the sampled policy reached the goal on Hw-Phy, at the last evaluation."""
    parent: Parent | None = None
    """The run and iteration that this one was branched from."""
    marks: Marks = Marks()


class Row(Summary, frozen=True, kw_only=True):
    """One line of the table of runs: what the list says of a run, and what it has come to."""

    outcome: Outcome = Outcome()


def line_of(history: History, status: Status, reason: str) -> Summary:
    """Return the line of a run that has been read in full, and does this for that reason."""
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


def ended_line(folder: RunFolder) -> Summary | None:
    """Return the line of a run that says itself that it has ended, from the end of its log alone; None for another.

    Raise RunFolderError or OSError where a file of it can't be read.
    """
    size = folder.events.lstat().st_size
    events, _ = folder.read_events(max(0, size - _TAIL))
    states = [event for event in events if isinstance(event, StateChanged)]
    if not states or states[-1].status not in SAID_ENDED:
        return None
    record, beat = folder.record(), folder.heartbeat()
    budgeted = record.env_steps is not None
    try:
        DesignSpace(tuple(record.parameters))
    except ValueError:
        return None  # unreadable: its history says why
    return Summary(
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
