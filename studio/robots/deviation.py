"""How far the prints of a robot are from the collision shapes with which it is simulated."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from studio.robots import geometry
from studio.robots.parts import MILLIMETRE, Part, body_of

CHUNK = 100
"""Number of points that are measured at once."""
TOGETHER = 16
"""Number of triangles, neighbours of each other, that share a box: those of far boxes are not looked at."""
ANGLES = 33
"""Number of angles of a joint at which its two shapes are tried."""
PROMISED = 1.0
"""mm: prints are no farther from the shapes, but for joints that have no room."""
NEAR = 0.5
"""mm: points that are nearer to their own link's print are not compared with its neighbours'."""
_ASKEW = np.array([0.8613, 0.3947, 0.3203])
"""Direction of a ray that meets no edge of what is drawn along the axes."""
TOUCHING = 1e-6
"""mm: points as far inside a shape are on its surface."""


@dataclass(frozen=True)
class Deviation:
    """Distances in mm between the outer surface of the prints and the collision shapes, in one posture.

    Holes count as filled, for pins, bolts, cables and servos fill them. Left out are the crotches of the joints: what
    of a shape is outside the ball of a joint and is reached by the neighbour's shape in another posture. Two shapes
    may be in one place, two prints may not. So is what a part covers that has no collision shape: the arm's foot.
    """

    outside_max: float
    """How far prints reach out of the shapes."""
    inside_max: float
    """How far the shapes' surface is from the prints, outside the crotches."""
    inside_95: float
    """The distance that 95 % of that surface keeps."""
    crotch_max: float
    """How far the shapes' surface is from the prints in the crotches."""
    crotch_share: float
    """What share of the shapes' surface that is (no unit)."""

    @property
    def words(self) -> str:
        """The distances as a paragraph."""
        thinner = " Joints of short links, and those under servos, are thinner than their shapes."
        return (
            f"The prints follow the collision shapes: they reach out of them by at most {self.outside_max:.2f} mm, "
            f"and the shapes' surface is at most {self.inside_max:.2f} mm from them, {self.inside_95:.2f} mm for 95 % "
            f"of it. Left out are the crotches of the joints, {self.crotch_share:.0%} of the surface and up to "
            f"{self.crotch_max:.1f} mm away: there two shapes are in one place when the joint folds, as two prints "
            "can't be. Holes count as filled by their pins, bolts and servos."
            f"{thinner if self.inside_max > PROMISED else ''}"
        )


@dataclass(frozen=True)
class _Shape:
    """A capsule, or a cylinder, along z of its frame; in mm."""

    round_ends: bool
    radius: float
    half: float
    rotation: np.ndarray  # (3, 3): from the shape's frame to its link's
    position: np.ndarray  # (3,)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Return how far points (N, 3) in the link's frame are out of the shape; negative inside."""
        x, y, z = ((points - self.position) @ self.rotation).T
        across = np.hypot(x, y)
        if self.round_ends:
            return np.hypot(across, np.maximum(np.abs(z) - self.half, 0)) - self.radius
        out = np.stack([across - self.radius, np.abs(z) - self.half])
        return np.hypot(*np.maximum(out, 0)) + np.minimum(out.max(0), 0)

    @property
    def area(self) -> float:
        ends = 4 if self.round_ends else 2
        return 4 * np.pi * self.radius * self.half + ends * np.pi * self.radius**2

    def sample(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return points (count, 3) of the surface in the link's frame, evenly spread."""
        side = rng.uniform(size=count) < 4 * np.pi * self.radius * self.half / self.area
        end = rng.choice([-1.0, 1.0], count)
        angle = rng.uniform(-np.pi, np.pi, count)
        # A hemisphere by its height, a disc by its radius: both are even in u.
        u = rng.uniform(size=count)
        across = np.where(side, 1.0, np.sqrt(1 - u**2) if self.round_ends else np.sqrt(u))
        beyond = u * self.radius if self.round_ends else 0.0
        along = np.where(side, self.half * rng.uniform(-1, 1, count), end * (self.half + beyond))
        local = np.stack([self.radius * across * np.cos(angle), self.radius * across * np.sin(angle), along], 1)
        return local @ self.rotation.T + self.position


class _Print:
    """A part with its holes filled, in its own frame."""

    def __init__(self, part: Part) -> None:
        if part.drilled is None:
            raise ValueError(f"{part.name} was not drawn for a printer")
        self._solid = part.drilled.body
        vertices, faces = geometry.mesh(self._solid)
        self._corners = vertices[faces]  # (F, 3, 3) mm
        self._boxes = np.stack([self._corners.min(1), self._corners.max(1)])  # (2, F, 3)
        self._groups = grouped(self._corners.mean(1), TOGETHER)  # (G, TOGETHER)
        low, high = self._boxes[:, self._groups]
        self._group_boxes = np.stack([low.min(1), high.max(1)])  # (2, G, 3)

    def sample(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return points (count, 3) of the surface, evenly spread."""
        a, b, c = np.moveaxis(self._corners, 1, 0)
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        on = rng.choice(len(areas), count, p=areas / areas.sum())
        u, v = rng.uniform(size=(2, count, 1))
        u, v = np.where(u + v > 1, [1 - u, 1 - v], [u, v])
        return a[on] + u * (b - a)[on] + v * (c - a)[on]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return how far points (N, 3) are from the surface."""
        found = [self._distance(points[i : i + CHUNK]) for i in range(0, len(points), CHUNK)]
        return np.concatenate([np.zeros(0), *found])

    def encloses(self, points: np.ndarray) -> np.ndarray:
        """Tell which points (N, 3) are inside: a ray from there leaves the surface once more often than it enters."""
        away = 2 * np.ptp(self._corners, axis=(0, 1)).sum() * _ASKEW
        return np.array([len(self._solid.ray_cast(tuple(point), tuple(point + away))) % 2 == 1 for point in points])

    def _distance(self, points: np.ndarray) -> np.ndarray:
        # No triangle is nearer than the box round it and its neighbours.
        at_least = _beside(points[:, None], self._group_boxes)  # (N, G)
        faces = self._groups[at_least.argmin(1)]
        apart = self._apart(points.repeat(TOGETHER, axis=0), faces.ravel()).reshape(-1, TOGETHER).min(1)
        of_point, group = np.nonzero(at_least < apart[:, None])
        of_point, faces = of_point.repeat(TOGETHER), self._groups[group].ravel()
        nearer = _beside(points[of_point], self._boxes[:, faces]) < apart[of_point]
        of_point, faces = of_point[nearer], faces[nearer]
        np.minimum.at(apart, of_point, self._apart(points[of_point], faces))
        return apart

    def _apart(self, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Return how far each point (N, 3) is from its face (N,)."""
        from trimesh.triangles import closest_point

        return np.linalg.norm(closest_point(self._corners[faces], points) - points, axis=1)


def grouped(places: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of places (N, 3) in groups (G, count) of neighbours; some stand in two of them."""
    doublings = max(0, int(np.ceil(np.log2(len(places) / count))))
    groups = np.resize(np.arange(len(places)), (1, count << doublings))
    for _ in range(doublings):
        inside = places[groups]
        longest = np.ptp(inside, axis=1).argmax(1)
        order = np.take_along_axis(inside, longest[:, None, None], 2)[..., 0].argsort(1)
        groups = np.take_along_axis(groups, order, 1).reshape(2 * len(groups), -1)
    return groups


def _beside(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return how far points (..., 3) are from boxes, whose corners are (2, ..., 3)."""
    return np.linalg.norm(np.maximum(np.maximum(boxes[0] - points, points - boxes[1]), 0), axis=-1)


@dataclass(frozen=True)
class _Pose:
    """Where a link is."""

    rotation: np.ndarray  # (3, 3)
    position: np.ndarray  # (3,) mm

    def to_world(self, points: np.ndarray) -> np.ndarray:
        return points @ self.rotation.T + self.position

    def to_link(self, points: np.ndarray) -> np.ndarray:
        return (points - self.position) @ self.rotation


def deviation(
    model: mujoco.MjModel, parts: Sequence[Part], qpos: np.ndarray | None = None, points: int = 400, seed: int = 0
) -> Deviation:
    """Return how far printed parts are from the collision shapes of their robot's model.

    Measured in posture `qpos` (nq,), or at the start, at `points` random points of every link.
    """
    rng = np.random.default_rng(seed)
    links = [(body_of(model, link), part) for part in parts for link in part.links]
    drawn = {part.name: _Print(part) for part in parts}
    prints = {body: drawn[part.name] for body, part in links}
    shapes = {body: _shapes(model, body) for body in prints}
    poses = _poses(model, _start(model) if qpos is None else qpos)
    outside, inside, crotch = [], [], []
    for body in sorted(body for body in prints if shapes[body]):
        near = [body, *(other for other in prints if _joint_between(model, body, other) is not None)]
        surface = poses[body].to_world(prints[body].sample(points, rng))
        outside.append(np.min([_depth(shapes[o], poses[o].to_link(surface)) for o in near], axis=0))
        local = _sample(shapes[body], points, rng)
        world = poses[body].to_world(local)
        others = [_depth(shapes[o], poses[o].to_link(world)) for o in shapes if o != body]
        seen = np.min(others, axis=0, initial=0.0) > -TOUCHING
        local, world = local[seen], world[seen]
        apart = prints[body].distance(local)
        for other in near[1:]:
            off = apart > NEAR  # a neighbour's print may be there instead
            apart[off] = np.minimum(apart[off], prints[other].distance(poses[other].to_link(world[off])))
        left_out = np.zeros(len(local), dtype=bool)
        for other in near[1:]:
            left_out |= _in_crotch(model, body, other, shapes[other], local)
            if not shapes[other]:
                left_out |= prints[other].encloses(poses[other].to_link(world))
        inside.append(apart[~left_out])
        crotch.append(apart[left_out])
    out, gap, left = np.maximum(np.concatenate(outside), 0), np.concatenate(inside), np.concatenate(crotch)
    return Deviation(
        float(out.max()), float(gap.max()), float(np.quantile(gap, 0.95)),
        float(left.max(initial=0.0)), len(left) / (len(left) + len(gap)),
    )  # fmt: skip


def _start(model: mujoco.MjModel) -> np.ndarray:
    return model.key_qpos[0] if model.nkey else model.qpos0


def _shapes(model: mujoco.MjModel, body: int) -> list[_Shape]:
    """Return the collision shapes of a body; ValueError for one that is neither a capsule nor a cylinder."""
    found: list[_Shape] = []
    for geom in range(int(model.body_geomadr[body]), int(model.body_geomadr[body] + model.body_geomnum[body])):
        if not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        kind = mujoco.mjtGeom(int(model.geom_type[geom]))
        if kind not in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
            raise ValueError(f"{model.geom(geom).name} is neither a capsule nor a cylinder")
        radius, half, _ = (float(size) / MILLIMETRE for size in model.geom_size[geom])
        position = model.geom_pos[geom] / MILLIMETRE
        round_ends = kind == mujoco.mjtGeom.mjGEOM_CAPSULE
        found.append(_Shape(round_ends, radius, half, _matrix(model.geom_quat[geom]), position))
    return found


def _depth(shapes: Sequence[_Shape], points: np.ndarray) -> np.ndarray:
    """Return how far points (N, 3) are out of the union of shapes, in their link's frame."""
    return np.min([np.full(len(points), np.inf), *(shape.depth(points) for shape in shapes)], axis=0)


def _sample(shapes: Sequence[_Shape], count: int, rng: np.random.Generator) -> np.ndarray:
    """Return points (count, 3) of the surfaces of a link's shapes, evenly spread."""
    areas = np.array([shape.area for shape in shapes])
    counts = rng.multinomial(count, areas / areas.sum())
    return np.concatenate([shape.sample(int(n), rng) for shape, n in zip(shapes, counts, strict=True)])


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    return flat.reshape(3, 3)


def _poses(model: mujoco.MjModel, qpos: np.ndarray) -> list[_Pose]:
    """Return where each body is in a posture."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return [_Pose(data.xmat[b].reshape(3, 3).copy(), data.xpos[b] / MILLIMETRE) for b in range(model.nbody)]


def _joint_between(model: mujoco.MjModel, one: int, other: int) -> int | None:
    """Return the body of the two that turns on the other; None where neither does."""
    if one == other:
        return None
    return next((c for c, p in ((one, other), (other, one)) if model.body_parentid[c] == p), None)


def _in_crotch(
    model: mujoco.MjModel, body: int, other: int, shapes: Sequence[_Shape], points: np.ndarray
) -> np.ndarray:
    """Tell which points (N, 3) in a body's frame are outside the ball of its joint with another, but reached by it."""
    child = _joint_between(model, body, other)
    assert child is not None
    joint = int(model.body_jntadr[child])
    low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-geometry.ARM.fold, geometry.ARM.fold)
    pin = model.body_pos[child] / MILLIMETRE
    ball = float(model.geom_size[model.body_geomadr[child], 0]) / MILLIMETRE
    reached = np.zeros(len(points), dtype=bool)
    spare = 2 * geometry.MARGIN
    for angle in np.linspace(low - spare, high + spare, ANGLES):
        turn = np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, model.jnt_axis[joint], angle)
        pose = _Pose(_matrix(model.body_quat[child]) @ _matrix(turn), pin)
        reached |= _depth(shapes, pose.to_link(points) if child == other else pose.to_world(points)) < 0
    centre = pin if child == other else np.zeros(3)
    return reached & (np.linalg.norm(points - centre, axis=1) > ball + TOUCHING)
