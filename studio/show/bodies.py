"""The bodies of a run's designs and its recorded episodes, as arrays that a page draws from.

Whatever is seen is one of the run's parts; a design says how large each is and where it stands.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from morph_core.history import History
from morph_core.protocol import Evaluation
from morph_core.run_folder import RunFolderError, foreign, read_episode
from morph_core.task import Task
from studio.show.pack import Pack
from studio.show.prints import Prints, Shape, angles_of, is_printed
from studio.show.thin import thinned
from studio.viewer.episode import episode_in
from studio.viewer.figure import Figure, Mesh
from studio.viewer.ghosts import filled, start_posture
from studio.viewer.split import names_of, split

MESH_BYTES = 1 << 20
"""Bytes of a run's meshes; those beyond it are drawn as the boxes round them."""
_GROUPS = ("robot", "object", "scenery")
_UNITS = 32767
"""Steps in which a place in an episode is told, from its middle to the farthest place."""


@dataclass(frozen=True)
class Body:
    """One design in its start posture, or an episode with it: T postures."""

    figures: tuple[Figure, Figure, Figure]
    """The robot, what else moves, and what never moves."""
    angles: tuple[float, ...] = ()
    """rad: where the fingers of a hand whose prints are drawn stand on its palm."""

    @property
    def corners(self) -> list[np.ndarray]:
        """Return the corners (3,) of boxes round robot, objects and scenery, but for a table."""
        seen = [f.take([i for i, name in enumerate(f.names) if not name.startswith("table")]) for f in self.figures]
        return [corner for figure in seen if len(figure) for corner in figure.extent()]


def body_of(task: Task, phi: np.ndarray) -> Body:
    """Return a design phi (d,) in its start posture; ValueError with the reason where it can't be built."""
    model = _model(task, phi)
    return _placed(task, phi, model, filled(model, start_posture(task, phi)))


def _model(task: Task, phi: np.ndarray) -> mujoco.MjModel:
    task.check_buildable(phi)
    return task.scene(phi).compile()


def _placed(task: Task, phi: np.ndarray, model: mujoco.MjModel, qpos: np.ndarray) -> Body:
    figures = split(Figure.from_model(model, qpos), names_of(task.spec(phi)))
    return Body(figures, angles_of(task, phi) if is_printed(task) else ())


@dataclass
class Cast:
    """All parts that are seen in a run, in the order in which they came."""

    prints: Prints | None = None
    """What a hand is drawn with in place of its collision shapes."""
    parts: list[dict[str, object]] = field(default_factory=list)
    meshes: list[Mesh] = field(default_factory=list)
    boxed: bool = False
    """Whether a mesh was too large, so that a box stands for it."""
    _known: dict[tuple[object, ...], int] = field(default_factory=dict)
    _mesh_bytes: int = 0

    def rows(self, body: Body) -> tuple[list[int], np.ndarray, np.ndarray]:
        """Return the parts of a body: which they are (n,), their half-extents (n, 3) m, and where they are at each
        instant, (T, n, 7): position in m and orientation w, x, y, z."""
        numbers, sizes, poses = [], [], []
        for group, figure in zip(_GROUPS, body.figures, strict=True):
            for i in range(len(figure)):
                colour = tuple(int(c) for c in figure.colours[i])
                for shape in self._shapes(body, figure, i):
                    kind, place, size = self._drawn(shape, figure.sizes[i])
                    numbers.append(self._number(group, shape.name, kind, place, colour, set(numbers)))
                    sizes.append(size)
                    poses.append(shape.pose)
        return numbers, np.array(sizes).reshape(-1, 3), np.stack(poses, 1)

    def _shapes(self, body: Body, figure: Figure, i: int) -> list[Shape]:
        """Return what a part of a body is drawn as."""
        pose = np.concatenate([figure.positions[:, i], figure.wxyz[:, i]], 1)
        printed = self.prints.shapes(figure.names[i], pose, body.angles) if self.prints and body.angles else []
        return printed or [Shape(figure.names[i], figure.kinds[i], figure.meshes[i], pose)]

    def _drawn(self, shape: Shape, size: np.ndarray) -> tuple[str, int, np.ndarray]:
        """Return the kind of a shape, the place of its mesh or -1, and its half-extents (3,) m.

        A box stands for a mesh that is too large.
        """
        if shape.mesh is None:
            return shape.kind, -1, size
        place = self._place(shape.mesh)
        return ("box", -1, np.abs(shape.mesh.vertices).max(0)) if place < 0 else (shape.kind, place, size)

    def _place(self, mesh: Mesh) -> int:
        """Return the place of a mesh among the meshes, -1 where there is no more room for it."""
        for place, other in enumerate(self.meshes):
            if np.array_equal(mesh.vertices, other.vertices) and np.array_equal(mesh.faces, other.faces):
                return place
        size = mesh.vertices.nbytes + mesh.faces.nbytes
        if self._mesh_bytes + size > MESH_BYTES:
            self.boxed = True
            return -1
        self._mesh_bytes += size
        self.meshes.append(mesh)
        return len(self.meshes) - 1

    def _number(self, group: str, name: str, kind: str, mesh: int, colour: tuple[int, ...], taken: set[int]) -> int:
        """Return the number of a part, a new one if the run has none like it that is not `taken` in this body."""
        for copy in range(len(taken) + 1):
            key = (group, name, kind, mesh, colour, copy)
            if key not in self._known:
                self._known[key] = len(self.parts)
                self.parts.append({"group": group, "name": name, "kind": kind, "mesh": mesh, "colour": list(colour)})
            if self._known[key] not in taken:
                return self._known[key]
        raise AssertionError("a body has more parts than parts")

    def packed(self, pack: Pack) -> dict[str, object]:
        """Return the parts and their meshes as a page reads them."""
        meshes = [
            {"vertices": pack.array(mesh.vertices, "f4"), "faces": pack.array(mesh.faces, "i4")} for mesh in self.meshes
        ]
        return {"parts": self.parts, "meshes": meshes, "printed": self.prints is not None}


def packed_designs(bodies: Sequence[Body | str], cast: Cast, pack: Pack) -> dict[str, object]:
    """Return designs as a page reads them: for each part the course of its half-extents and its place, (P, 10, N).

    They are 0 where a design has no such part. Of a design that can't be built there is the reason.
    """
    rows = [None if isinstance(body, str) else cast.rows(body) for body in bodies]
    course = np.zeros((len(cast.parts), 10, len(bodies)), np.float32)
    for n, found in enumerate(rows):
        if found is not None:
            numbers, sizes, poses = found
            course[numbers, :3, n], course[numbers, 3:, n] = sizes, poses[0]
    reasons = [body if isinstance(body, str) else "" for body in bodies]
    return {"course": pack.array(course, "f4"), "reasons": reasons}


@dataclass(frozen=True)
class Played:
    """A recorded episode, worked out."""

    iteration: int
    body: Body
    success: np.ndarray  # (T,) bool
    pressed: np.ndarray  # (T,) bool
    contact: np.ndarray  # (T, C, 3) m

    def packed(self, cast: Cast, pack: Pack) -> dict[str, object]:
        """Return the episode as a page reads it: places as steps from one instant to the next, which repeat much."""
        numbers, sizes, poses = cast.rows(self.body)
        moving = [i for i, number in enumerate(numbers) if cast.parts[number]["group"] != "scenery"]
        places = poses[:, moving].astype(float)
        places[..., 3:] = _one_sided(places[..., 3:])
        reach = float(max(np.abs(places[..., :3]).max(initial=0), np.nanmax(np.abs(self.contact), initial=0), 1e-3))
        places[..., :3] /= reach
        steps = np.round(places * _UNITS).astype(np.int32).transpose(1, 2, 0)  # (n, 7, T + 1)
        contact = np.where(np.isfinite(self.contact), np.round(self.contact / reach * _UNITS), -_UNITS - 1)
        return {
            "iteration": self.iteration, "reach": reach, "instants": len(places),
            "parts": pack.array(np.array([numbers[i] for i in moving]), "i4"),
            "sizes": pack.array(sizes[moving], "f4"),
            "steps": pack.array(np.diff(steps, axis=2, prepend=0).astype(np.int16), "i2"),
            "contact": pack.array(contact, "i2"),
            "success": pack.array(self.success, "u1"), "pressed": pack.array(self.pressed, "u1"),
        }  # fmt: skip


def _one_sided(wxyz: np.ndarray) -> np.ndarray:
    """Return quaternions (T, n, 4) that never jump to the other one of the same orientation."""
    turned = (wxyz[1:] * wxyz[:-1]).sum(-1) < 0
    signs = np.cumprod(np.where(turned, -1, 1), axis=0)
    return np.concatenate([wxyz[:1], wxyz[1:] * signs[..., None]])


def play(history: History, task: Task, evaluation: Evaluation) -> Played:
    """Return the median episode that an evaluation recorded. RunFolderError or ValueError says why there is none."""
    recorded = read_episode(history.folder, evaluation.iteration)
    with foreign(f"episode {evaluation.iteration} of {history.folder.id}"):
        phi = np.asarray(recorded.get("phi", evaluation.phi), float)
        model = _model(task, phi)
        episode = episode_in(recorded, model.nq)
        body = _placed(task, phi, model, filled(model, episode.qpos))
    pressed = episode.milestones.get("pressed", np.zeros(len(episode.success), bool))
    return Played(evaluation.iteration, body, episode.success, pressed, episode.contact)


def episodes_within(history: History, task: Task, budget: int, prints: Prints | None = None) -> list[Played]:
    """Return recorded episodes that take no more than `budget` bytes once they are compressed; those that can't be read
    are left out.

    First and last are kept, and that of the best evaluation; of the others so many that they lie evenly.
    """
    recorded = [e for e in history.evaluations if e.episode]
    if not recorded:
        return []
    best = history.best
    marked = [i for i, e in enumerate(recorded) if best and e.iteration == best.iteration]
    size = _compressed_size(history, task, recorded[-1], Cast(prints))
    most = max(2, budget // size) if size else len(recorded)
    found = []
    for i in thinned(len(recorded), most, marked):
        try:
            found.append(play(history, task, recorded[i]))
        except (RunFolderError, ValueError):
            continue
    return found


def _compressed_size(history: History, task: Task, evaluation: Evaluation, cast: Cast) -> int:
    """Return how many bytes an episode takes in a page; 0 where it can't be read."""
    pack = Pack()
    try:
        document = play(history, task, evaluation).packed(cast, pack)
    except (RunFolderError, ValueError):
        return 0
    return len(zlib.compress(pack.content(document), 6))
