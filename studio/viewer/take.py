"""What is to be seen in the scene, and everything that drawing it needs, worked out once."""

import contextlib
import dataclasses
import functools
import json
import math
from dataclasses import dataclass

import mujoco
import numpy as np

from morph_core.catalogue import make_task
from morph_core.forces import contact_forces
from morph_core.protocol import Which
from morph_core.run_folder import RunFolder, episode_arrays, read_episode
from morph_core.task import Task
from studio.robots.chooser import robot_of
from studio.robots.parts import dress, stl_files
from studio.viewer.episode import Episode, episode_in
from studio.viewer.figure import Figure, smooth
from studio.viewer.ghosts import Beside, filled, standing, start_posture
from studio.viewer.scene import CONTACT_COLOUR, is_flat, round_up
from studio.viewer.split import names_of, split
from studio.viewer.tint import Tint, painted

Corners = tuple[np.ndarray, np.ndarray]
"""Lowest (3,) and highest corner (3,) of a box, in m."""

FRAMES_PER_SECOND = 60
GOAL_LIT = (20, 200, 90)
WALL_LIT = (235, 90, 50)
LIT_BY = {"button": ("pressed", (255, 214, 40))}
"""Milestone that lights up a geom, and its colour then, by the geom's name."""
_LINGER = 0.3
"""Seconds for which a contact stays lit."""
_TABLE_MARGIN = 0.15
"""Width of the table in sight beside what stands on it, as a share of what stands on it."""
_LONG_ARROW = 0.25
"""Length of the arrow of a large contact force, at most, as a share of the scene's longest side: of ten contacts of an
episode one has a longer one, as an impact would leave all others too short to be seen."""
SECOND_COLOUR = (150, 60, 220)
_TINT = 0.6
"""Share of its colours that the second of two overlaid designs loses to `SECOND_COLOUR`."""
_GAP = 0.15
"""Gap between two designs side by side, as a share of the scene's width there."""
_GHOST_THICKNESS = 0.85
_MARKER_RADIUS, _ARROW_RADIUS = 0.012, 0.006
"""Radii of a contact marker and of a force's arrow, as shares of the scene's longest side."""
_OUT_OF_SIGHT = -1e4
"""Height in m of the markers of contacts that are none now: browsers move markers at once, and are slow to make new
ones."""


@dataclass(frozen=True)
class Shot:
    """Description of what is to be seen; two equal ones need no second build."""

    task: str
    task_options: tuple[tuple[str, object], ...]
    phi: tuple[float, ...]
    """The design in front."""
    episode: tuple[RunFolder, int] | None = None
    """The run and iteration whose recorded episode is played; without one the robot stands in the start posture."""
    which: Which | None = None
    """The recorded episode that is played: by its name among those of its evaluation, or None for the only one."""
    played: bytes | None = None
    """An episode that no run has recorded, as the bytes of an npz file; it goes before a recorded one."""
    ghost: tuple[float, ...] | None = None
    """The design that stands pale behind the one in front."""
    ghost_name: str = "initial"
    """Word that says which design that is."""
    printed: bool = False
    """Whether the design in front shows its printed parts, or the collision shapes inside which they are."""
    tint: Tint | None = None
    """Colours of the robot's parts; without them it has its own."""
    beside: Beside = Beside()
    """The designs that stand beside it; a take holds none of them, for they take long to build."""
    forces: bool = False
    """Whether to show the contact forces as arrows."""
    second: "Shot | None" = None
    """Another shot that is played at the same time: two designs to be compared."""
    overlaid: bool = False
    """Whether the second design stands where the first one does, or beside it."""

    @property
    def options(self) -> str:
        """Return the options of the task as JSON."""
        return json.dumps(dict(self.task_options), sort_keys=True)


@dataclass(frozen=True)
class ForceArrows:
    """The contact forces of an episode as arrows, at each of its T + 1 postures; NaN for none."""

    starts: np.ndarray
    """Starts of the arrows, (T + 1, C, 3) m."""
    ends: np.ndarray
    """Ends of the arrows, (T + 1, C, 3) m."""
    newtons_per_cm: float
    factor: int
    """Frames from one posture to the next."""

    def at(self, frame: int) -> np.ndarray:
        """Return start and end (n, 2, 3) of the arrows of a frame."""
        t = min(frame // self.factor, len(self.starts) - 1)
        arrows = np.stack([self.starts[t], self.ends[t]], 1)
        return arrows[np.isfinite(arrows).all((1, 2))]


@dataclass(frozen=True)
class Second:
    """The second of two designs, as it stands in the scene."""

    robot: Figure
    objects: Figure
    scenery: Figure | None
    """Obstacles, table and goal; None where they are those of the first design."""
    away: np.ndarray
    """How far from the first design it stands, (3,) m."""
    letters: np.ndarray
    """Where the letters A and B stand above both designs, (2, 3) m."""

    @property
    def frames(self) -> int:
        """Number of frames of its episode."""
        return self.robot.instants


@dataclass(frozen=True)
class Take:
    """A shot worked out: arrays over F frames, 1 / FRAMES_PER_SECOND seconds of the task's time apart."""

    shot: Shot
    robot: Figure
    objects: Figure
    """All that moves beside the robot."""
    scenery: Figure
    """Obstacles, table and goal."""
    ghost: Figure | None
    goal_touched: np.ndarray
    """Frames in which the goal is touched, (F,) bool."""
    milestones: dict[str, np.ndarray]
    """Frames in which each milestone is reached, by its name: (F,) bool each."""
    contact: np.ndarray
    """Points (F, C, 3) in m where something is touched; NaN for nothing."""
    markers: Figure | None
    """Markers of the contacts, one for each of C; None where nothing is ever touched."""
    touched: np.ndarray
    """Parts of the scenery that are touched, (F, n) bool."""
    box: Corners
    """Box that the camera should frame."""
    floor: Corners
    """The level rectangle on which lengths are written."""
    reward_terms: dict[str, np.ndarray]
    """Terms of the reward at each of T control steps, by their names: (T,) each."""
    control_dt: float
    """Seconds of a control step."""
    has_forces: bool
    """Whether contact forces can be worked out for the episode."""
    forces: ForceArrows | None
    second: Second | None

    @property
    def frames(self) -> int:
        """Number of frames of the design in front, F."""
        return self.robot.instants

    @property
    def last_frame(self) -> int:
        """Frame with which the longer of both episodes ends."""
        return max(self.frames, self.second.frames if self.second else 0) - 1

    @property
    def duration(self) -> float:
        """Length of the longer episode in seconds of the task's time; 0 without an episode."""
        return self.last_frame / FRAMES_PER_SECOND

    @functools.cached_property
    def arrow_radius(self) -> float:
        """Radius of the shafts of the forces' arrows, in m."""
        return _ARROW_RADIUS * _longest_side(self.box)

    def scenery_colours(self, frame: int) -> np.ndarray:
        """Return the scenery's colours (n, 3) uint8 with what is touched lit up."""
        if not (self.goal_touched[frame] or self.touched[frame].any()):
            return self.scenery.colours
        colours = self.scenery.colours.copy()
        if self.goal_touched[frame]:
            colours[[name.startswith("goal") for name in self.scenery.names]] = GOAL_LIT
        colours[self.touched[frame]] = WALL_LIT
        return colours

    def object_colours(self, frame: int) -> np.ndarray:
        """Return the objects' colours (n, 3) uint8, lit up by the milestones that are reached."""
        if not any(reached[frame] for reached in self.milestones.values()):
            return self.objects.colours
        colours = self.objects.colours.copy()
        for i, name in enumerate(self.objects.names):
            milestone, light = LIT_BY.get(name, ("", GOAL_LIT))
            if milestone in self.milestones and self.milestones[milestone][frame]:
                colours[i] = light
        return colours


def make_take(shot: Shot) -> Take:
    """Build the designs, read the episode, place every part. Raise ValueError if task or episode is no good."""
    task = make_task(shot.task, dict(shot.task_options))
    recorded = _recorded(shot)
    phi = np.asarray(recorded.get("phi", shot.phi), float)
    model, of_robot = _models(task, phi, shot.printed)
    if recorded:
        episode = episode_in(recorded, model.nq)
    else:
        episode = Episode(start_posture(task, phi), np.zeros(0, bool), {}, np.zeros((0, 1, 3)))
    factor = max(1, round(task.control_dt * FRAMES_PER_SECOND))
    frames = smooth(model, filled(model, episode.qpos), factor)
    robot, objects, scenery = split(Figure.from_model(model, frames), of_robot)
    if shot.tint:
        robot = dataclasses.replace(robot, colours=painted(robot, shot.tint))
    contact = _moving_contacts(episode.contact, factor, len(frames))
    box, floor = _frame(shot.task, shot.options)
    second = _second(shot, robot, box) if shot.second else None
    if second:
        box, floor = _both(box, second.away), _both(floor, second.away)
    arrows = _arrows(task, phi, recorded, _longest_side(box), factor) if shot.forces and "qvel" in recorded else None
    return Take(
        shot=shot,
        robot=robot,
        objects=objects,
        scenery=scenery,
        ghost=standing(shot.task, shot.options, shot.ghost).thinned(_GHOST_THICKNESS) if shot.ghost else None,
        goal_touched=_from_their_end(episode.success, factor, len(frames)),
        milestones={name: _from_their_end(m, factor, len(frames)) for name, m in episode.milestones.items()},
        contact=contact,
        markers=_markers(contact, _MARKER_RADIUS * _longest_side(box)),
        touched=_touched(scenery, contact),
        box=box,
        floor=floor,
        reward_terms=_reward_terms(recorded),
        control_dt=task.control_dt,
        has_forces="qvel" in recorded,
        forces=arrows,
        second=second,
    )


def _second(shot: Shot, robot: Figure, box: Corners) -> Second:
    """Return the second design of a shot beside the first `robot`, where the scene of the first one fills the box."""
    assert shot.second is not None
    take = make_take(shot.second)
    if shot.overlaid:
        robot, objects = (figure.tinted(SECOND_COLOUR, _TINT) for figure in (take.robot, take.objects))
        return Second(robot, objects, None, np.zeros(3), np.zeros((2, 3)))
    away, (low, high) = _aside(box), box
    letter = np.array([(low[0] + high[0]) / 2, high[1] if is_flat(*box) else (low[1] + high[1]) / 2, high[2]])
    letters = np.stack([letter, letter + away])
    if not is_flat(*box):  # a design that has grown would hide them
        tops = [figure.extent()[1][2] for figure in (robot, take.robot)]
        letters[:, 2] = np.maximum(letters[:, 2], tops)
    return Second(take.robot.moved(away), take.objects.moved(away), take.scenery.moved(away), away, letters)


def _aside(box: Corners) -> np.ndarray:
    """Return how far (3,) m beside a scene its like stands: along the shorter side of a flat one, which is seen from
    above, and else along x."""
    size = box[1] - box[0]
    axis = 1 if is_flat(*box) and size[1] < size[0] else 0
    away = np.zeros(3)
    away[axis] = (1 + _GAP) * size[axis] * (-1 if axis else 1)
    return away


def _both(box: Corners, away: np.ndarray) -> Corners:
    """Return the box round two boxes, one of them `away` (3,) from the other."""
    return np.minimum(box[0], box[0] + away), np.maximum(box[1], box[1] + away)


def _longest_side(box: Corners) -> float:
    return float(np.max(box[1] - box[0]))


def _arrows(
    task: Task, phi: np.ndarray, recorded: dict[str, np.ndarray], longest_side: float, factor: int
) -> ForceArrows:
    """Return the contact forces of an episode as arrows, as long as suits a scene with this longest side in m."""
    found = contact_forces(task, phi, recorded)
    sizes = np.linalg.norm(found.forces, axis=2)
    large = float(np.nanquantile(sizes, 0.9)) if np.isfinite(sizes).any() else 1.0
    newtons_per_cm = round_up(large / (100 * _LONG_ARROW * longest_side))
    return ForceArrows(found.points, found.points + found.forces / newtons_per_cm / 100, newtons_per_cm, factor)


def _reward_terms(recorded: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the finite terms (T,) of the reward that an episode holds."""
    prefix, steps = "reward_terms/", len(np.atleast_2d(recorded["qpos"])) - 1 if "qpos" in recorded else 0
    found = {
        name.removeprefix(prefix): np.asarray(term, float).reshape(-1)
        for name, term in recorded.items()
        if name.startswith(prefix)
    }
    return {name: term for name, term in found.items() if len(term) == steps and np.isfinite(term).all()}


def _recorded(shot: Shot) -> dict[str, np.ndarray]:
    """Return the arrays of the episode that is to be played, or none."""
    if shot.played is not None:
        return episode_arrays(shot.played)
    return read_episode(*shot.episode, shot.which) if shot.episode else {}


def _models(task: Task, phi: np.ndarray, printed: bool) -> tuple[mujoco.MjModel, set[str]]:
    """Return the scene, and the names of the robot's bodies and geoms in it; a robot that can't be assembled shows its
    collision shapes."""
    specs, robot = [task.scene(phi), task.spec(phi)], robot_of(task)
    if printed and robot.printed:
        with contextlib.suppress(ValueError):
            parts = robot.parts(phi)
            files = stl_files(parts)
            specs = [dress(spec, parts, files) for spec in specs]
    scene, alone = specs
    return scene.compile(), names_of(alone)


def _from_their_end(reached: np.ndarray, factor: int, frames: int) -> np.ndarray:
    """Return (F,) bool of steps (T,): what step t reaches is seen from its end on, until the next step ends."""
    seen = np.zeros(frames, bool)
    for t in np.flatnonzero(reached):
        seen[(t + 1) * factor : (t + 2) * factor] = True
    return seen


def _moving_contacts(contact: np.ndarray, factor: int, frames: int) -> np.ndarray:
    """Return where (F, C, 3) is touched: moved along while a contact (T, C, 3) goes on, held for a moment after it."""
    points = np.full((frames, *contact.shape[1:]), np.nan)
    for t, c in np.argwhere(np.isfinite(contact).all(2)):
        begin = (t + 1) * factor
        points[begin : begin + 1 + math.ceil(_LINGER * FRAMES_PER_SECOND), c] = contact[t, c]
        if t + 1 < len(contact) and np.isfinite(contact[t + 1, c]).all():
            share = np.arange(factor)[:, None] / factor
            points[begin : begin + factor, c] = (1 - share) * contact[t, c] + share * contact[t + 1, c]
    return points


def _markers(contact: np.ndarray, radius: float) -> Figure | None:
    """Return markers of this radius in m where (F, C, 3) is touched."""
    touched = np.asarray(np.isfinite(contact).all(2))
    if not touched.any():
        return None
    places = np.where(touched[..., None], contact, [0.0, 0.0, _OUT_OF_SIGHT])
    return Figure.balls(places[:, touched.any(0)], radius, "contact", CONTACT_COLOUR)


def _touched(scenery: Figure, contact: np.ndarray) -> np.ndarray:
    """Return (F, n) bool: which walls are nearest to the contacts (F, C, 3)."""
    touched = np.zeros((len(contact), len(scenery)), bool)
    walls = [i for i, name in enumerate(scenery.names) if name.startswith("wall")]
    obstacles = scenery.take(walls)
    for frame, c in np.argwhere(np.isfinite(contact).all(2)) if walls else ():
        touched[frame, walls[obstacles.nearest(contact[frame, c])]] = True
    return touched


@functools.lru_cache(maxsize=16)
def _frame(name: str, options: str) -> tuple[Corners, Corners]:
    """Return what is always in sight of a task with `options`, which are JSON, and the floor below it.

    In sight are obstacles, goal and the initial design where it starts; where objects are carried to the goal, also
    the room that the design needs there.
    """
    task = make_task(name, json.loads(options))
    phi = task.design_space.initial
    model = task.scene(phi).compile()
    whole = Figure.from_model(model, filled(model, start_posture(task, phi)))
    robot, objects, scenery = split(whole, names_of(task.spec(phi)))
    tables = [i for i, name in enumerate(scenery.names) if name.startswith("table")]
    table, around = scenery.take(tables), scenery.take([i for i in range(len(scenery)) if i not in tables])
    boxes = [figure.extent() for figure in (robot, objects, around) if len(figure)]
    low, high = np.min([box[0] for box in boxes], 0), np.max([box[1] for box in boxes], 0)
    if len(objects) and len(around):
        high[2] = max(high[2], around.extent()[1][2] + robot.extent()[1][2] - objects.extent()[1][2])
    if not len(table):
        return (low, high), (low, np.array([*high[:2], low[2]]))
    edge_low, edge_high = table.extent()
    margin = _TABLE_MARGIN * (high - low)[:2]
    low[:2], high[:2] = np.maximum(low[:2] - margin, edge_low[:2]), np.minimum(high[:2] + margin, edge_high[:2])
    level = edge_high[2:]
    return (low, high), (np.concatenate([low[:2], level]), np.concatenate([high[:2], level]))
