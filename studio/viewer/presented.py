"""What one browser shows, in words and curves for those who only look."""

import functools
import json

import msgspec
import numpy as np

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.protocol import Evaluation, Status
from studio.viewer.legend import meanings
from studio.viewer.parts import Quantity, quantities_of
from studio.viewer.player import Player

_MOST_POINTS = 200
"""Largest number of points of a curve."""


class Swatch(msgspec.Struct, frozen=True):
    """One line of the legend: a colour as in CSS, and what it means."""

    colour: str
    words: str


class Presented(msgspec.Struct, frozen=True, kw_only=True):
    """What one browser shows at one moment."""

    title: str = ""
    """Words for the task; empty while nothing is shown."""
    doing: str = ""
    """Words on what the body in the scene does."""
    run: str | None = None
    method: str = ""
    status: Status | None = None
    iteration: int = 0
    latest: int = 0
    planned: int | None = None
    success: float | None = None
    """Share of episodes in which the sampled policy reached the goal on Hw-Phy, at the last evaluation up to the shown
    iteration."""
    time: float = 0.0
    """Time in the episode, in seconds."""
    duration: float = 0.0
    playing: bool = False
    legend: tuple[Swatch, ...] = ()


class PhiCurve(msgspec.Struct, frozen=True):
    """One entry of phi over the evaluations, in the unit in which it is shown."""

    name: str
    colour: str
    values: list[float]


class PhiCurves(msgspec.Struct, frozen=True):
    """The entries of phi that mean the same of one part each."""

    name: str
    unit: str
    curves: list[PhiCurve]


class Curves(msgspec.Struct, frozen=True):
    """How success and phi of a run have gone, at its evaluations on Hw-Phy."""

    run: str
    iteration: list[int]
    success: list[float]
    phi: list[PhiCurves]


def presented(history: History, shown: int, status: Status, doing: str, player: Player) -> Presented:
    """Return what is shown of a run at iteration `shown`."""
    take = player.take
    evaluated = [e for e in history.evaluations if e.iteration <= shown]
    return Presented(
        title=title_of(history.record.task, json.dumps(history.record.task_options, sort_keys=True)),
        doing=doing,
        run=history.folder.id,
        method=history.record.method,
        status=status,
        iteration=shown,
        latest=history.iteration,
        planned=history.planned_iterations,
        success=evaluated[-1].sampled_success if evaluated else None,
        time=round(player.time, 1),
        duration=round(take.duration, 1) if take else 0.0,
        playing=player.playing,
        legend=tuple(Swatch("rgb({}, {}, {})".format(*colour), words) for colour, words in meanings(take))
        if take
        else (),
    )


def curves_of(history: History) -> Curves:
    """Return the curves of a run; of many evaluations some are left out, never the first or the last."""
    rows = _thinned([e for e in history.evaluations if len(e.phi) == len(history.design_space)])
    phi = np.array([e.phi for e in rows], float).reshape(len(rows), len(history.design_space))
    return Curves(
        run=history.folder.id,
        iteration=[e.iteration for e in rows],
        success=[e.sampled_success for e in rows],
        phi=[_phi_curves(quantity, phi) for quantity in quantities_of(history)] if rows else [],
    )


def _phi_curves(quantity: Quantity, phi: np.ndarray) -> PhiCurves:
    """Return the curves of one quantity, of designs phi (n, d); numbered parts of one kind go by their numbers."""
    name = quantity.name.replace("_", " ")
    parts = [entry.part.rpartition(" ") for entry in quantity.entries]
    numbered = len({kind for kind, _, _ in parts}) == 1 and all(kind and number.isdigit() for kind, _, number in parts)
    return PhiCurves(
        name=name + (f" by {parts[0][0]}" if numbered and parts[0][0] != name else ""),
        unit=quantity.unit.name,
        curves=[
            PhiCurve(
                name=number if numbered else entry.part,
                colour=entry.colour,
                values=np.round(phi[:, entry.index] * quantity.unit.factor, 4).tolist(),
            )
            for entry, (_, _, number) in zip(quantity.entries, parts, strict=True)
        ],
    )


def _thinned(rows: list[Evaluation]) -> list[Evaluation]:
    kept = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _MOST_POINTS)).round().astype(int))
    return [rows[i] for i in kept]


@functools.lru_cache(maxsize=64)
def title_of(task: str, options: str) -> str:
    """Return a task's title; its name where it is a task of another version. The options are JSON."""
    try:
        return make_task(task, json.loads(options)).title
    except (ValueError, TypeError):
        return task
