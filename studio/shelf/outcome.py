"""What a run has come to, from the few events that tell it: a log of thousands of iterations is not read in full."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import msgspec

from morph_core import inside
from morph_core.protocol import AnyEvent, Evaluation, Measure, Progress, Rate, StateChanged, Whole, decode_event
from morph_core.run_folder import EVENTS_BYTES

_ITERATION, _EVALUATION = b'{"kind":"progress"', b'{"kind":"evaluation"'
"""How a line begins that tells of an iteration or an evaluation; one that is written otherwise is read like any
other."""


class Score(msgspec.Struct, frozen=True):
    """Success and return of a design on Hw-Phy, over the episodes of one evaluation with the sampled policy."""

    iteration: Whole
    success: Rate
    episode_return: float
    phi: list[Measure]
    milestones: dict[str, Rate] = {}
    """Shares of the episodes that reached each milestone before the goal."""


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """What a run has come to so far."""

    env_steps: Whole | None = None
    """Environment steps of the trajectories."""
    seconds: float | None = None
    """Time that trainers were at work, pauses included, in seconds."""
    last: Score | None = None
    best: Score | None = None
    """The evaluation with the most success, then the highest return."""


def outcome_of(events: Sequence[AnyEvent]) -> Outcome:
    """Return what these events have come to. Of the iterations, the last one before any other event is enough."""
    evaluations = evaluations_of(events)
    best = max(evaluations, key=lambda e: (e.sampled_success, e.sampled_return), default=None)
    return Outcome(
        env_steps=_steps(events, evaluations),
        seconds=_seconds(events),
        last=score_of(evaluations[-1]) if evaluations else None,
        best=score_of(best) if best else None,
    )


def _steps(events: Sequence[AnyEvent], evaluations: Sequence[Evaluation]) -> int | None:
    for event in reversed(events):
        match event:
            case Progress() | Evaluation():
                return event.env_steps
            case StateChanged(status="starting"):
                return evaluations[-1].env_steps if evaluations else None
    return None


def _seconds(events: Sequence[AnyEvent]) -> float | None:
    """Return how long all trainers together were at work: each from its start to the last that it said."""
    starts = [i for i, event in enumerate(events) if isinstance(event, StateChanged) and event.status == "starting"]
    if not starts:
        return None
    ends = [*(i - 1 for i in starts[1:]), len(events) - 1]
    return sum(events[end].time - events[start].time for start, end in zip(starts, ends, strict=True))


def evaluations_of(events: Iterable[AnyEvent]) -> list[Evaluation]:
    """Return the evaluations among events, without those that a resume has voided."""
    evaluations: list[Evaluation] = []
    for event in events:
        match event:
            case StateChanged(status="starting"):
                evaluations = _kept(evaluations, event)
            case Evaluation():
                evaluations.append(event)
    return evaluations


def landmarks(folder: Path) -> list[AnyEvent]:
    """Return the events of a run without iterations that another one or an evaluation follows; whole lines alone count.

    What stays tells what the whole log does: an evaluation says itself how many steps there were before it.
    """
    events: list[AnyEvent | None] = []
    try:
        for text in inside.whole_lines(folder, "events.jsonl", 0, EVENTS_BYTES):
            for line, before in _telling(text):
                events.append(_event(line) or (_event(before) if before else None))
    except OSError:
        return []
    return [event for event in events if event]


def _telling(text: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield those of some whole lines that tell something; with an evaluation the iteration before it, which is left
    out, else nothing.

    The text is cut where iterations begin: most pieces are one line, which is found without looking at its words.
    """
    others, *pieces = (b"\n" + text).split(b"\n" + _ITERATION)
    yield from ((line, b"") for line in others.splitlines() if line)
    for number, piece in enumerate(pieces, 1):
        rest, _, others = piece.partition(b"\n")
        lines = others.splitlines()
        if not lines and number < len(pieces):  # another iteration follows
            continue
        if lines and lines[0].startswith(_EVALUATION):
            yield lines.pop(0), _ITERATION + rest
        else:
            yield _ITERATION + rest, b""
        yield from ((line, b"") for line in lines)


def _event(line: bytes) -> AnyEvent | None:
    try:
        return decode_event(line)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def score_of(evaluation: Evaluation) -> Score:
    """Return what an evaluation says of the sampled policy."""
    return Score(
        evaluation.iteration, evaluation.sampled_success, evaluation.sampled_return, evaluation.phi,
        evaluation.milestones,
    )  # fmt: skip


def _kept(evaluations: list[Evaluation], start: StateChanged) -> list[Evaluation]:
    """Return the evaluations that a trainer goes on from: a resume voids what came after its checkpoint."""
    return [e for e in evaluations if e.iteration <= start.iteration]
