"""Parts as triangles with smooth sides: what a figure looks like at one of its instants."""

import functools
from dataclasses import dataclass

import numpy as np

from morph_core import shapes
from studio.viewer.figure import Figure, rotations

_CREASE = np.cos(np.radians(38))
"""Cosine of the angle between two faces up to which the edge between them looks round."""
_KEY, _FILL = np.array([-0.45, -0.6, 0.85]), np.array([0.9, -0.35, 0.3])
"""From what is lit to the main lamp, and to the one that lightens the shade."""
LAMP = _KEY / np.linalg.norm(_KEY)
_AMBIENT, _MAIN, _SECOND = 0.52, 0.5, 0.14
"""Shares of light that comes from everywhere, from the main lamp, and from the other one."""

Surface = tuple[np.ndarray, np.ndarray]
"""Corners of triangles (F, 3, 3) in m, and the normals (F, 3, 3) of the round or flat surface at each."""


@dataclass(frozen=True)
class Solid:
    """All parts of a figure as triangles, each in the frame of its part."""

    figure: Figure
    corners: np.ndarray  # (F, 3, 3) m
    normals: np.ndarray  # (F, 3, 3)
    part: np.ndarray  # (F,) which part each triangle is of

    @classmethod
    def of(cls, figure: Figure) -> "Solid":
        """Return the parts of a figure as triangles."""
        surfaces = [_surface(figure, i) for i in range(len(figure))]
        none = np.zeros((0, 3, 3))
        return cls(
            figure,
            np.concatenate([none, *(corners for corners, _ in surfaces)]),
            np.concatenate([none, *(normals for _, normals in surfaces)]),
            np.repeat(np.arange(len(figure)), [len(corners) for corners, _ in surfaces]),
        )

    def at(self, instant: int) -> Surface:
        """Return corners and normals (F, 3, 3) in the world at an instant; -1 is the last one."""
        place = min(instant, self.figure.instants - 1) if instant >= 0 else instant
        turns = rotations(self.figure.wxyz[place].astype(float))[self.part]  # (F, 3, 3)
        corners = np.einsum("fij,fcj->fci", turns, self.corners)
        places = self.figure.positions[place][self.part][:, None]
        return corners + places, np.einsum("fij,fcj->fci", turns, self.normals)


def brightness(normals: np.ndarray) -> np.ndarray:
    """Return how bright (...) a surface with these normals (..., 3) is; 1 shows its colour as it is."""
    fill = _FILL / np.linalg.norm(_FILL)
    return _AMBIENT + _MAIN * np.maximum(normals @ LAMP, 0) + _SECOND * np.maximum(normals @ fill, 0)


def fallen(corners: np.ndarray, level: float) -> np.ndarray:
    """Return the shadow in m that points (..., 3) throw on level ground."""
    height = np.maximum(corners[..., 2:] - level, 0)
    fallen = corners - height / LAMP[2] * LAMP
    fallen[..., 2] = level
    return fallen


def _surface(figure: Figure, i: int) -> Surface:
    mesh, kind, size = figure.meshes[i], figure.kinds[i], figure.sizes[i]
    if mesh is not None:
        return rounded(mesh.vertices[mesh.faces].astype(float) * size)
    if kind == "capsule":
        vertices, faces = shapes.capsule(float(size[2] / size[0]))
        return rounded(vertices[faces].astype(float) * size[0])
    vertices, faces = _unit(kind)
    return rounded(vertices[faces].astype(float) * size)


@functools.cache
def _unit(kind: str) -> shapes.Shape:
    return {"box": shapes.box, "cylinder": shapes.cylinder, "sphere": shapes.sphere}[kind]()


def rounded(corners: np.ndarray) -> Surface:
    """Return triangles (F, 3, 3) with the normals at their corners: between faces that meet in a small angle, one."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1)
    kept = length > 0
    corners, across, length = corners[kept], across[kept], length[kept]
    flat = across / length[:, None]
    step = 1e-6 * max(float(np.ptp(corners)), 1e-9) if len(corners) else 1.0
    one, other = _pairs(_vertices(np.round(corners.reshape(-1, 3) / step).astype(np.int64)))
    alike = (flat[one // 3] * flat[other // 3]).sum(1) >= _CREASE
    one, other = one[alike], other[alike]
    weights = _angles(corners).reshape(-1)[other]
    normals = np.zeros((len(corners) * 3, 3))
    for axis in range(3):
        normals[:, axis] = np.bincount(one, weights * flat[other // 3, axis], len(normals))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return corners, normals.reshape(-1, 3, 3)


def _vertices(places: np.ndarray) -> np.ndarray:
    """Return for each of some places (n, 3), in whole numbers up to a few millions, which distinct one it is."""
    if not len(places):
        return np.zeros(0, int)
    x, y, z = (places - places.min(0)).T
    one = (x * (y.max() + 1) + y) * (z.max() + 1) + z  # sorting numbers is faster than sorting rows
    return np.unique(one, return_inverse=True)[1]


def _angles(corners: np.ndarray) -> np.ndarray:
    """Return the angle (F, 3) in radians at each corner of triangles (F, 3, 3): the share that a face has in it."""
    ahead, back = (np.roll(corners, shift, 1) - corners for shift in (-1, 1))
    lengths = np.linalg.norm(ahead, axis=2) * np.linalg.norm(back, axis=2)
    return np.arccos(np.clip((ahead * back).sum(2) / np.maximum(lengths, 1e-300), -1, 1))


def _pairs(vertex: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return every pair of corners (n,) that are at one vertex, each with itself too."""
    order = np.argsort(vertex, kind="stable")
    counts = np.bincount(vertex)
    ends = np.cumsum(counts)
    per_corner = counts[vertex[order]]  # how many corners share each one's vertex
    one = np.repeat(order, per_corner)
    begins = np.repeat((ends - counts)[vertex[order]], per_corner)
    within = np.arange(len(one)) - np.repeat(np.cumsum(per_corner) - per_corner, per_corner)
    return one, order[begins + within]
