"""The course of a run as a page shows it: its iterations, its traces with names and units, its marks, and phi."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from morph_core.history import History
from morph_core.protocol import DesignSpaceChanged, Evaluation, Progress
from morph_core.task import Task
from studio.moments import Mark, marks_of
from studio.shelf.marks import read_marks
from studio.show.pack import Pack
from studio.show.thin import thinned
from studio.viewer.parts import Entry, Quantity, quantities_of

MOST_ROWS = 2000
"""Iterations whose numbers a page holds; of a longer run some are left out."""


@dataclass(frozen=True)
class Course:
    """The iterations of a run that a page holds; the first is the initial design, before any."""

    history: History
    progress: Sequence[Progress | None]
    """What each of them recorded; None for the initial design."""
    marks: Sequence[Mark]
    total: int
    """Number of iterations of the run, the initial design among them."""

    @property
    def iterations(self) -> np.ndarray:
        """The numbers of the iterations (n,)."""
        return np.array([self.history.begins_at if p is None else p.iteration for p in self.progress])

    @property
    def env_steps(self) -> np.ndarray:
        """Environment steps (n,) after each of them; a branch that counts on begins where its first iteration does."""
        first = next((p.env_steps for p in self.progress if p), 0) if self.history.begins_at else 0
        return np.array([first if p is None else p.env_steps for p in self.progress], float)

    @property
    def phi(self) -> np.ndarray:
        """Designs (n, d)."""
        return np.array([self.history.initial_phi if p is None else p.phi for p in self.progress], float)

    @property
    def important(self) -> list[int]:
        """The iterations that are kept before others: that of the best evaluation, then the marks without episodes."""
        first = ("best", "starred", "command", "freeze", "restart", "resume")
        ranked = sorted((m for m in self.marks if m.kind in first), key=lambda mark: first.index(mark.kind))
        return [mark.iteration for mark in ranked]


def course_of(history: History) -> Course:
    """Return the course of a run; of more than `MOST_ROWS` iterations some are left out, none that is marked."""
    marks = marks_of(history, read_marks(history.folder.path).starred_designs)
    every: list[Progress | None] = [None, *history.progress]
    whole = Course(history, every, marks, len(every))
    recorded = [e.iteration for e in history.evaluations]
    kept = thinned(len(every), MOST_ROWS, _places(whole, [*whole.important, *recorded]))
    return dataclasses.replace(whole, progress=[every[i] for i in kept])


def _places(course: Course, iterations: Iterable[int]) -> list[int]:
    at = {int(iteration): i for i, iteration in enumerate(course.iterations)}
    return [at[iteration] for iteration in iterations if iteration in at]


@dataclass(frozen=True)
class Designs:
    """The designs whose bodies are shown, and which of them is nearest to each iteration."""

    phi: np.ndarray
    """The design parameters (N, d) of each."""
    iterations: np.ndarray
    """The iteration (N,) that each comes from."""
    of_row: np.ndarray
    """The design (n,) of each iteration of the course, or the last one that is kept before it."""
    total: int
    """Number of different designs in the course."""


def designs_of(course: Course, most: int) -> Designs:
    """Return the different designs of a course, no more than `most`: first, last, best and marked ones are kept."""
    phi = course.phi
    new = np.concatenate([[True], (phi[1:] != phi[:-1]).any(1)])
    starts, run = np.flatnonzero(new), np.cumsum(new) - 1  # (N,), (n,)
    best = [course.history.best.iteration] if course.history.best else []
    marked = [int(run[i]) for i in _places(course, [*best, *course.important])]
    kept = np.array(thinned(len(starts), most, marked))
    of_run = np.searchsorted(kept, np.arange(len(starts)), side="right") - 1
    return Designs(phi[starts[kept]], course.iterations[starts[kept]], of_run[run], len(starts))


def packed_course(course: Course, designs: Designs, task: Task | None, pack: Pack) -> dict[str, object]:
    """Return iterations, evaluations, traces, marks and phi as a page reads them."""
    history, phi = course.history, course.phi
    quantities = quantities_of(history)
    lo, hi = _bounds(course)
    evaluations = history.evaluations
    return {
        "iterations": pack.array(course.iterations, "i4"),
        "env_steps": pack.array(course.env_steps, "f8"),
        "design": pack.array(designs.of_row, "i4"),
        "exact": pack.array((designs.phi[designs.of_row] == phi).all(1), "u1"),
        "design_iterations": designs.iterations.tolist(),
        "phi": pack.array(phi.T, "f4"), "lo": pack.array(lo.T, "f4"), "hi": pack.array(hi.T, "f4"),
        "initial": history.initial_phi.tolist(),
        "parameters": _parameters(history, quantities),
        "evaluations": {
            "iterations": pack.array(np.array([e.iteration for e in evaluations]), "i4"),
            "env_steps": pack.array(np.array([e.env_steps for e in evaluations]), "f8"),
            "sampled": pack.array(np.array([e.sampled_success for e in evaluations]), "f4"),
            "deterministic": pack.array(np.array([e.deterministic_success for e in evaluations]), "f4"),
            "returns": pack.array(np.array([e.sampled_return for e in evaluations]), "f4"),
        },
        "best": history.best.iteration if history.best else None,
        "marks": [{"iteration": m.iteration, "kind": m.kind, "words": m.words} for m in course.marks],
        "charts": _charts(course, quantities, task, pack),
    }  # fmt: skip


def _bounds(course: Course) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds (n, d) and (n, d) that were in force in each iteration."""
    history = course.history
    if not any(isinstance(event, DesignSpaceChanged) for event in history.events):
        space = history.at().space
        return np.tile(space.lo, (len(course.progress), 1)), np.tile(space.hi, (len(course.progress), 1))
    spaces = [history.at(int(iteration)).space for iteration in course.iterations]
    return np.array([space.lo for space in spaces]), np.array([space.hi for space in spaces])


def _parameters(history: History, quantities: Sequence[Quantity]) -> list[dict[str, object]]:
    """Return name, unit and colour of each entry of phi, in its order."""
    entries: dict[int, tuple[Quantity, Entry]] = {e.index: (q, e) for q in quantities for e in q.entries}
    found = []
    for i, p in enumerate(history.record.parameters):
        quantity, entry = entries[i]
        same = quantity.name.replace("_", " ") == entry.part
        unit = quantity.unit
        found.append(
            {
                "name": p.name, "label": entry.part if same else f"{quantity.name.replace('_', ' ')} {entry.part}",
                "unit": unit.name, "factor": unit.factor, "digits": unit.digits, "colour": entry.colour,
                "hard_lo": p.hard_lo, "hard_hi": p.hard_hi,
            }
        )  # fmt: skip
    return found


# --- traces -----------------------------------------------------------------------------------------------------------


def _charts(course: Course, quantities: Sequence[Quantity], task: Task | None, pack: Pack) -> list[dict[str, object]]:
    """Return the charts of a run; those of which nothing was measured are left out."""
    charts = [_evaluated(course, "success", pack), _evaluated(course, "return", pack)] if _evaluations(course) else []
    charts += [_of_phi(course, quantity, pack) for quantity in quantities]
    agreement, apart = _lines(course, {"cosine": "cosine"}, pack), _lines(course, _APART, pack, positive=True)
    if agreement:
        charts.append(_chart("Agreement of g_task and g_hw", "cosine", agreement, bounds=[-1, 1]))
    if apart:
        unit = f"[{task.z_unit}²]" if task and task.z_unit else "[typical step²]"
        charts.append(_chart("Proxy against Hw-Phy: mean squared distance", unit, apart, logarithmic=True))
    return charts


_APART = {"divergence of the proxy": "divergence", "search cost": "search_cost"}
"""Names of the lines of a chart, and the fields of an iteration that they draw."""
_OF_EVALUATION = {"success": ("Success on Hw-Phy", "episodes [%]", 100.0, [0, 100]),
                  "return": ("Return on Hw-Phy", "return of an episode", 1.0, None)}  # fmt: skip
"""What an evaluation measures: title and axis of its chart, by what it is multiplied, and the ends of its axis."""


def _chart(
    title: str, axis: str, lines: list[dict[str, object]], *, bounds: list[float] | None = None,
    logarithmic: bool = False, design: bool = False,
) -> dict[str, object]:  # fmt: skip
    return {
        "title": title, "axis": axis, "lines": lines, "bounds": bounds, "logarithmic": logarithmic, "design": design,
    }  # fmt: skip


def _line(label: str, values: np.ndarray, pack: Pack, *, at: str = "rows", colour: str = "") -> dict[str, object]:
    """Return a line over the iterations of the course, or over its evaluations."""
    return {"label": label, "at": at, "colour": colour, "values": pack.array(values, "f4")}


def _evaluated(course: Course, measured: Literal["success", "return"], pack: Pack) -> dict[str, object]:
    title, axis, factor, bounds = _OF_EVALUATION[measured]
    lines = [
        _line(label, factor * _column(_evaluations(course), f"{kind}_{measured}"), pack, at="evaluations")
        for label, kind in (("sampled policy", "sampled"), ("mean of the policy", "deterministic"))
    ]
    return _chart(title, axis, lines, bounds=bounds)


def _of_phi(course: Course, quantity: Quantity, pack: Pack) -> dict[str, object]:
    lines = [
        _line(e.part, course.phi[:, e.index] * quantity.unit.factor, pack, colour=e.colour) for e in quantity.entries
    ]
    name = quantity.name.replace("_", " ")
    return _chart(f"Design φ: {name}", f"{name} [{quantity.unit.name or '1'}]", lines, design=True)


def _lines(course: Course, names: dict[str, str], pack: Pack, *, positive: bool = False) -> list[dict[str, object]]:
    """Return lines of the fields of an iteration that were measured at all; a logarithmic axis shows positive values
    alone."""
    columns = {label: _column(course.progress, name) for label, name in names.items()}
    shown = {label: np.where(values > 0, values, np.nan) if positive else values for label, values in columns.items()}
    return [_line(label, values, pack) for label, values in shown.items() if np.isfinite(values).any()]


def _column(rows: Sequence[object], name: str) -> np.ndarray:
    """Return a field of the rows; NaN where a row has none, or where it was not measured."""
    values = [getattr(row, name, None) for row in rows]
    return np.array([np.nan if value is None else value for value in values], float)


def _evaluations(course: Course) -> Sequence[Evaluation]:
    return course.history.evaluations
