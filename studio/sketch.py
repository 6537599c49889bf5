"""A scene as flat shapes in a painter's order, for pictures that need neither a browser nor a display."""

import dataclasses
from dataclasses import dataclass

import mujoco
import numpy as np

from studio.viewer import shapes
from studio.viewer.figure import Figure
from studio.viewer.scene import OBLIQUE, is_flat, screen_axes
from studio.viewer.take import Take

_TABLE = 1.2
"""Extent of the table that is drawn, as a multiple of what stands on it."""
_LIGHT = np.array([-0.35, -0.5, 0.8]) / np.linalg.norm([-0.35, -0.5, 0.8])
_AMBIENT = 0.62
"""The share of its colour that a face keeps in the shade."""


@dataclass(frozen=True)
class Rod:
    """A line with round ends."""

    ends: np.ndarray  # (2, 2) m
    radius: float  # m
    colour: np.ndarray  # (3,) up to 255


@dataclass(frozen=True)
class Disc:
    """A filled circle."""

    centre: np.ndarray  # (2,) m
    radius: float  # m
    colour: np.ndarray  # (3,) up to 255


@dataclass(frozen=True)
class Faces:
    """Triangles, the farthest first."""

    corners: np.ndarray  # (f, 3, 2) m
    colours: np.ndarray  # (f, 3) up to 255
    seam: float
    """Width in m of the line round each face in its own colour, which hides the gaps between faces."""


Shape = Rod | Disc | Faces


@dataclass(frozen=True)
class Sketch:
    """Shapes in the order in which they are painted, and the rectangle that holds them."""

    shapes: tuple[Shape, ...]
    low: np.ndarray  # (2,) m
    high: np.ndarray  # (2,) m


def sketch_of(take: Take, frame: int = 0) -> Sketch:
    """Return a frame of a take, flat tasks as seen from above, others from the side."""
    direction = np.array([0.0, 0.0, 1.0]) if is_flat(*take.box) else OBLIQUE
    axes = np.stack([*screen_axes(direction), direction])  # rows: right, up and towards the eye
    scenery = dataclasses.replace(_cut(take.scenery, take.box), colours=take.scenery_colours(frame))
    objects = dataclasses.replace(take.objects, colours=take.object_colours(frame))
    drawn = []
    for figure, instant in ((scenery, 0), (objects, frame), (take.robot, frame)):
        drawn += [_drawing(figure, i, instant, axes) for i in range(len(figure))]
    drawn.sort(key=lambda drawing: drawing[0])  # the farthest is painted first
    points = np.concatenate([corners for _, corners, _ in drawn])
    return Sketch(tuple(shape for *_, shape in drawn), points.min(0), points.max(0))


def _cut(scenery: Figure, box: tuple[np.ndarray, np.ndarray]) -> Figure:
    """Return the scenery with its table cut to a little more than the box; a whole table would make the rest small."""
    reach = _TABLE * np.abs(np.stack(box))[:, :2].max()
    table = np.array([name.startswith("table") for name in scenery.names], bool)
    sizes = scenery.sizes.copy()
    sizes[table, :2] = np.minimum(sizes[table, :2], reach)
    return dataclasses.replace(scenery, sizes=sizes)


def _drawing(figure: Figure, i: int, instant: int, axes: np.ndarray) -> tuple[tuple[bool, float], np.ndarray, Shape]:
    """Return a part's place in the painter's order, corners (n, 2) m of its extent, and its shape."""
    place = min(instant, figure.instants - 1) if instant >= 0 else instant
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, figure.wxyz[place, i].astype(float))
    seen = axes @ turn.reshape(3, 3)  # the part's own axes as the eye has them
    centre, kind, size = axes @ figure.positions[place, i].astype(float), figure.kinds[i], figure.sizes[i]
    order, colour = (not figure.names[i].startswith("table"), float(centre[2])), figure.colours[i]
    if kind == "capsule":
        ends = centre[:2] + np.outer([-1, 1], size[2] * seen[:2, 2])
        lit = _shade(colour, axes.T @ _towards_the_eye(seen[:, 2]))
        return order, _around(ends, size[0]), Rod(ends, float(size[0]), lit)
    if kind == "sphere" and np.ptp(size) < 1e-9:
        disc = Disc(centre[:2], float(size[0]), _shade(colour, _LIGHT))
        return order, _around(centre[None, :2], size[0]), disc
    mesh = figure.meshes[i]
    unit = {"box": shapes.box, "cylinder": shapes.cylinder, "sphere": shapes.sphere}
    vertices, faces = (mesh.vertices, mesh.faces) if mesh else unit[kind]()
    placed = centre + (vertices * size) @ seen.T
    return order, placed[:, :2], _faces(placed[faces], axes, colour)


def _faces(corners: np.ndarray, axes: np.ndarray, colour: np.ndarray) -> Faces:
    """Return the faces (f, 3, 3), as the eye has them, that are turned to the eye, the farthest first."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    order = [f for f in np.argsort(corners[..., 2].mean(1)) if normals[f, 2] > 1e-6]
    colours = np.array([_shade(colour, axes.T @ normals[f]) for f in order]).reshape(-1, 3)
    return Faces(corners[order][..., :2], colours, 0.012 * float(np.ptp(corners[..., :2])))


def _towards_the_eye(along: np.ndarray) -> np.ndarray:
    """Return the normal (3,) of a rod's side that is turned to the eye; `along` (3,) is its axis as the eye has it."""
    normal = np.array([0.0, 0.0, 1.0]) - along[2] * along
    length = float(np.linalg.norm(normal))
    return normal / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])


def _shade(colour: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return a colour (3,) uint8 by how much light a face with this normal (3,) in the world gets."""
    light = _AMBIENT + (1 - _AMBIENT) * max(0.0, float(normal @ _LIGHT))
    return np.round(colour * light).astype(int)


def _around(points: np.ndarray, radius: float) -> np.ndarray:
    return np.concatenate([points - radius, points + radius])
