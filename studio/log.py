"""What was done to a run: its commands in words, each with its iteration, its sender and what became of it."""

import contextlib
import getpass
import platform

import msgspec

from morph_core.design import DesignSpace
from morph_core.history import History
from morph_core.protocol import (
    Acknowledged,
    AnyCommand,
    Checkpoint,
    InjectDesign,
    Kill,
    Lock,
    Pause,
    Resume,
    SetAlpha,
    SetBound,
    SetProjection,
    StateChanged,
    StepIteration,
    Stop,
    Unlock,
)

_TOLD = {"starting": "trainer started", "stopped": "", "finished": "finished", "failed": "failed"}
"""Statuses that stand in the log, each with the words before its message."""


class LogEntry(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the log of a run: a command with its answer, or that a trainer started or ended."""

    iteration: int
    """Iteration after which it happened."""
    time: float
    """Seconds since the epoch."""
    words: str
    command: AnyCommand | None = None
    """The command, where this is one."""
    accepted: bool = True
    undone: bool = False
    """Whether the trainer went on from a checkpoint before it, so that the run is as if it had not been sent."""
    sender: str = ""
    """Words on who sent the command and by which way; empty where that is not known."""


def log_of(history: History) -> list[LogEntry]:
    """Return the log of a run, oldest first."""
    space, kept = history.design_space, {event.seq for event in history.commands()}
    entries = []
    for event in history.events:
        if isinstance(event, Acknowledged):
            undone = event.accepted and event.seq not in kept
            entries.append(
                LogEntry(
                    iteration=event.iteration, time=event.time, words=acknowledgement(event, space),
                    command=event.command, accepted=event.accepted, undone=undone, sender=event.sender,
                )
            )  # fmt: skip
        elif isinstance(event, StateChanged) and event.status in _TOLD:
            words = ": ".join(part for part in (_TOLD[event.status], event.message) if part)
            entries.append(LogEntry(iteration=event.iteration, time=event.time, words=words or event.status))
    return entries


def sender_here(way: str) -> str:
    """Return words on a sender at this machine, such as "command line, ada@workshop"."""
    name = platform.node()
    with contextlib.suppress(OSError, KeyError, ImportError):  # an account without a name
        name = f"{getpass.getuser()}@{name}"
    return f"{way}, {name}"


def phi_in_words(phi: list[float], space: DesignSpace) -> str:
    """Return the values of phi in words, such as "link_1 3 m, link_2 1.5 m"."""
    return ", ".join(f"{p.name} {value:.4g} {p.unit}" for p, value in zip(space.parameters, phi, strict=False))


def describe(command: AnyCommand, space: DesignSpace) -> str:
    """Return what a command does, as a clause in the past tense."""
    units = {p.name: p.unit for p in space.parameters}
    match command:
        case SetBound(name=name, lo=lo, hi=hi):
            return f"bound of {name} set to [{lo:.4g}, {hi:.4g}] {units.get(name, '')}".rstrip()
        case Lock(name=name, value=None):
            return f"{name} locked at its present value"
        case Lock(name=name, value=value):
            return f"{name} locked at {value:.4g} {units.get(name, '')}".rstrip()
        case Unlock(name=name):
            return f"{name} unlocked"
        case SetAlpha(alpha=alpha):
            return f"α set to {alpha:g}"
        case SetProjection(projection=projection):
            return f"projection set to {projection}"
        case InjectDesign(phi=phi):
            return f"design set to {phi_in_words(phi, space)}"
        case Pause():
            return "paused"
        case Resume():
            return "resumed"
        case StepIteration():
            return "one step"
        case Stop():
            return "stopped"
        case Kill():
            return "ended at once"
        case Checkpoint():
            return "checkpoint saved"


def acknowledgement(event: Acknowledged, space: DesignSpace) -> str:
    """Return the sentence that tells what became of a command."""
    what = describe(event.command, space)
    if not event.accepted:
        return f"refused: {event.message or 'no reason given'} ({what})"
    if isinstance(event.command, Pause | Stop | Checkpoint):
        return f"{what} after iteration {event.iteration}"
    if isinstance(event.command, Resume):
        return f"{what} at iteration {event.iteration}"
    return f"{what}, in force from iteration {event.iteration + 1}"
