"""Designs that stand pale beside the one in front, in their start postures: earlier ones, and those that were tried.

They are many, so that building them takes longer than a person likes to wait for the body itself.
"""

import functools
import json
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from morph_core.catalogue import make_task
from morph_core.run_folder import RunFolder, read_episode
from morph_core.task import Task
from studio.cancellation import Cancellation
from studio.viewer.figure import Figure

MOST_GHOSTS = 64
"""Largest number of designs that one layer shows."""
_KEPT = 512
"""Number of designs that stay built, so that scrubbing to and fro builds few."""
_TRAIL_THICKNESS, _TRIED_THICKNESS = 0.42, 0.2


@dataclass(frozen=True)
class Beside:
    """Description of the designs that stand beside the one in front."""

    trail: tuple[tuple[float, ...], ...] = ()
    """Earlier designs."""
    tried_in: tuple[RunFolder, int] | None = None
    """Recorded episode that tells which designs were tried up to its iteration."""
    explored: bool = False
    """Whether to show the designs that the episodes of that iteration were run with."""
    generation: bool = False
    """Whether to show the designs that the last generation of CMA-ES tried."""


@dataclass(frozen=True)
class Crowd:
    """The designs beside the one in front, worked out; None for none."""

    trail: Figure | None = None
    explored: Figure | None = None
    generation: Figure | None = None


def make_crowd(task: str, options: str, beside: Beside, cancellation: Cancellation) -> Crowd:
    """Build the designs that stand beside the one in front; `options` of the task are JSON.

    Raise CancelledError once it is cancelled, and ValueError if one can't be built.
    """

    def figure(designs: Sequence[Sequence[float]] | np.ndarray, thickness: float) -> Figure | None:
        figures = []
        for phi in designs[:MOST_GHOSTS]:
            cancellation.check()
            figures.append(standing(task, options, tuple(float(value) for value in phi)))
        return Figure.joined(figures).thinned(thickness) if figures else None

    tried = beside.tried_in and (beside.explored or beside.generation)
    recorded = read_episode(*beside.tried_in) if beside.tried_in and tried else {}
    return Crowd(
        trail=figure(beside.trail, _TRAIL_THICKNESS),
        explored=figure(_designs(recorded, "population") if beside.explored else (), _TRIED_THICKNESS),
        generation=figure(_designs(recorded, "generation") if beside.generation else (), _TRIED_THICKNESS),
    )


def _designs(recorded: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Return the designs (M, d) that a recorded episode has under a name, whatever else its file holds."""
    designs = np.asarray(recorded.get(name, np.zeros((0, 1))), float)
    designs = designs if designs.ndim == 2 else np.zeros((0, 1))
    return designs[np.isfinite(designs).all(1)]


@functools.lru_cache(maxsize=_KEPT)
def standing(task: str, options: str, phi: tuple[float, ...]) -> Figure:
    """Return the robot alone with a design, in its start posture; `options` of the task are JSON.

    Raise ValueError if it can't be built.
    """
    made, design = make_task(task, json.loads(options)), np.array(phi)
    model = made.spec(design).compile()
    return Figure.from_model(model, filled(model, start_posture(made, design)))


def start_posture(task: Task, phi: np.ndarray) -> np.ndarray:
    """Return qpos (1, nq) of a start posture."""
    return task.qpos(task.reset(task.hw_phy(phi), 1, np.random.default_rng(0)))


def filled(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return qpos (T, nq) for a model with more (objects) or fewer joints (the robot alone) than were recorded."""
    whole = np.tile(model.qpos0, (len(qpos), 1))
    known = min(model.nq, qpos.shape[1])
    whole[:, :known] = qpos[:, :known]
    return whole
