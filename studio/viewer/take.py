"""What is to be seen in the scene, and everything that drawing it needs, worked out once."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from morph_core.run_folder import RunFolder, read_rollout
from morph_core.task import Task
from morph_core.tasks import make_task
from studio.viewer.figure import Figure, smooth
from studio.viewer.scene import GOAL_LIT, WALL_LIT

FRAMES_PER_SECOND = 30
_LINGER = 0.3
"""Seconds for which a contact stays lit."""
_GHOST_THICKNESS = 0.85


@dataclass(frozen=True)
class Shot:
    """What is to be seen; two equal ones need no second build."""

    task: str
    task_options: tuple[tuple[str, object], ...]
    phi: tuple[float, ...]
    """The design in front."""
    rollout: tuple[RunFolder, int] | None = None
    """The episode it plays; without one it stands in the start posture."""
    ghost: tuple[float, ...] | None = None
    """The design that stands pale behind it."""
    trail: tuple[tuple[float, ...], ...] = ()
    """Earlier designs, paler still."""


@dataclass(frozen=True)
class Take:
    """A shot worked out: arrays over F frames, 1 / FRAMES_PER_SECOND seconds of the task's time apart."""

    shot: Shot
    robot: Figure
    """All that moves."""
    scenery: Figure
    """Obstacles and goal."""
    ghost: Figure | None
    trail: Figure | None
    goal_touched: np.ndarray
    """(F,) bool."""
    contact: np.ndarray
    """(F, 3) m, NaN where nothing is touched."""
    touched: np.ndarray
    """(F,) int: the part of the scenery that is touched, -1 for none."""
    box: tuple[np.ndarray, np.ndarray]
    """m: corners (3,) of what the camera should frame."""

    @property
    def frames(self) -> int:
        return self.robot.instants

    @property
    def duration(self) -> float:
        """Seconds."""
        return (self.frames - 1) / FRAMES_PER_SECOND

    def scenery_colours(self, frame: int) -> np.ndarray:
        """Return the scenery's colours (n, 3) uint8 with what is touched lit up."""
        colours = self.scenery.colours.copy()
        if self.goal_touched[frame]:
            colours[[name.startswith("goal") for name in self.scenery.names]] = GOAL_LIT
        if self.touched[frame] >= 0:
            colours[self.touched[frame]] = WALL_LIT
        return colours


def make_take(shot: Shot) -> Take:
    """Build the designs, read the episode, place every part. Raise ValueError if task or episode is no good."""
    task = make_task(shot.task, dict(shot.task_options))
    phi = np.array(shot.phi)
    model = task.scene(phi).compile()
    start = _start(task, phi)
    qpos, success, contact = start, np.zeros(1, bool), np.full((1, 3), np.nan)
    if shot.rollout:
        episode = read_rollout(*shot.rollout)
        qpos, success, contact = _episode(episode, model.nq)
        phi = np.asarray(episode.get("phi", phi), float)
        model = task.scene(phi).compile()
    factor = max(1, round(task.control_dt * FRAMES_PER_SECOND))
    frames = smooth(model, _fill(model, qpos), factor)
    whole = Figure.from_model(model, frames)
    fixed = [name.startswith(("goal", "wall")) for name in whole.names]
    scenery = whole.take([i for i, is_fixed in enumerate(fixed) if is_fixed])
    robot = whole.take([i for i, is_fixed in enumerate(fixed) if not is_fixed])
    ghost = _standing(task, shot.ghost) if shot.ghost else None
    trail = [_standing(task, earlier) for earlier in shot.trail]
    points, touched = _contacts(scenery, contact, factor, len(frames))
    return Take(
        shot=shot,
        robot=robot,
        scenery=scenery,
        ghost=ghost.thinned(_GHOST_THICKNESS) if ghost else None,
        trail=_joined(trail).thinned(_GHOST_THICKNESS / 2) if trail else None,
        goal_touched=_touched_from(success, factor, len(frames)),
        contact=points,
        touched=touched,
        box=_box(task, scenery),
    )


def _episode(episode: dict[str, np.ndarray], nq: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return qpos (T+1, nq), success (T,) and contact (T, 3) of a recorded episode, whatever else its file holds."""
    qpos = np.atleast_2d(np.asarray(episode.get("qpos", np.zeros((0, nq))), float))
    steps = len(qpos) - 1
    if steps < 0 or not np.isfinite(qpos).all():
        raise ValueError("the recorded episode holds no finite postures")
    success = np.asarray(episode.get("success", np.zeros(steps, bool)), bool).reshape(-1)[:steps]
    contact = np.asarray(episode.get("contact", np.full((steps, 3), np.nan)), float).reshape(-1, 3)[:steps]
    if len(success) != steps or len(contact) != steps:
        raise ValueError("the recorded episode's success and contact don't fit its postures")
    return qpos, success, contact


def _start(task: Task, phi: np.ndarray) -> np.ndarray:
    """Return qpos (1, nq) of a start posture."""
    return task.qpos(task.reset(task.hw_phy(phi), 1, np.random.default_rng(0)))


def _standing(task: Task, phi: tuple[float, ...]) -> Figure:
    """Return the robot alone with design phi, in the start posture."""
    model = task.spec(np.array(phi)).compile()
    return Figure.from_model(model, _fill(model, _start(task, np.array(phi))))


def _fill(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return qpos (T, nq) for a model with more (objects) or fewer joints (the robot alone) than were recorded."""
    filled = np.tile(model.qpos0, (len(qpos), 1))
    known = min(model.nq, qpos.shape[1])
    filled[:, :known] = qpos[:, :known]
    return filled


def _joined(figures: list[Figure]) -> Figure:
    return Figure(
        names=tuple(name for f in figures for name in f.names),
        kinds=tuple(kind for f in figures for kind in f.kinds),
        sizes=np.concatenate([f.sizes for f in figures]),
        colours=np.concatenate([f.colours for f in figures]),
        meshes=tuple(mesh for f in figures for mesh in f.meshes),
        positions=np.concatenate([f.positions for f in figures], 1),
        wxyz=np.concatenate([f.wxyz for f in figures], 1),
    )


def _touched_from(success: np.ndarray, factor: int, frames: int) -> np.ndarray:
    """Return (F,) bool: what step t reaches is seen from its end on."""
    touched = np.zeros(frames, bool)
    for t in np.flatnonzero(success):
        touched[(t + 1) * factor :] = True
    return touched


def _contacts(scenery: Figure, contact: np.ndarray, factor: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where (F, 3) and which part of the scenery (F,) is touched, held for a moment after each contact."""
    points, touched = np.full((frames, 3), np.nan), np.full(frames, -1)
    walls = [i for i, name in enumerate(scenery.names) if name.startswith("wall")]
    obstacles = scenery.take(walls)
    for t in np.flatnonzero(np.isfinite(contact).all(1)):
        shown = slice((t + 1) * factor, (t + 1) * factor + 1 + math.ceil(_LINGER * FRAMES_PER_SECOND))
        points[shown] = contact[t]
        if walls:
            touched[shown] = walls[obstacles.nearest(contact[t])]
    return points, touched


def _box(task: Task, scenery: Figure) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of what is always in sight: the scenery, and the initial design in its start posture."""
    initial = _standing(task, tuple(task.design_space.initial)).extent()
    if not len(scenery):
        return initial
    around = scenery.extent()
    return np.minimum(initial[0], around[0]), np.maximum(initial[1], around[1])
