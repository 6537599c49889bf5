"""Unit meshes: every primitive in the scene is a scaled instance of one of them."""

import numpy as np

Shape = tuple[np.ndarray, np.ndarray]
"""A mesh: vertices (V, 3) float32 and faces (F, 3) uint32."""

_SIDES = 20
_RINGS = 6
_CAPSULE_OCTAVES = (-4, 14)
"""Lowest and highest bucket of a capsule's aspect: log2(half-length / radius), counted in half octaves."""


def box() -> Shape:
    """Return a box with half-extents of one. Its faces share no corners, so that its edges are sharp."""
    vertices, faces = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            corners = [sign * np.eye(3)[axis] + a * u + b * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            order = [(0, 1, 2), (0, 2, 3)] if sign > 0 else [(0, 2, 1), (0, 3, 2)]
            faces += [[len(vertices) + i for i in triangle] for triangle in order]
            vertices += corners
    return np.array(vertices, np.float32), np.array(faces, np.uint32)


def cylinder() -> Shape:
    """Return a cylinder along z with a radius and a half-length of one."""
    return _lathe([(0, -1), (1, -1)], [(1, -1), (1, 1)], [(1, 1), (0, 1)])


def sphere() -> Shape:
    """Return a sphere with a radius of one."""
    return _lathe([(float(np.cos(a)), float(np.sin(a))) for a in np.linspace(-np.pi / 2, np.pi / 2, 2 * _RINGS + 1)])


def capsule_bucket(radius: float, half_length: float) -> int:
    """Return the bucket whose capsule, scaled to this one's radius and length, keeps its ends round within 19 %."""
    lowest, highest = _CAPSULE_OCTAVES
    return int(np.clip(round(2 * np.log2(max(half_length, 1e-9) / max(radius, 1e-9))), lowest, highest))


def capsule_half_length(bucket: int) -> float:
    """Return the half-length of the bucket's cylinder in units of its radius."""
    return 2.0 ** (bucket / 2)


def capsule(bucket: int) -> Shape:
    """Return a capsule along z with a radius of one and the half-length of its bucket."""
    quarter = np.linspace(0, np.pi / 2, _RINGS + 1)
    top = [(float(np.cos(a)), capsule_half_length(bucket) + float(np.sin(a))) for a in quarter]
    return _lathe([(x, -z) for x, z in reversed(top)] + top)


def _lathe(*strips: list[tuple[float, float]]) -> Shape:
    """Turn profiles of (radius, z), from low to high, about z. Strips share no corners, so that edges between them are
    sharp."""
    angles = 2 * np.pi * np.arange(_SIDES) / _SIDES
    vertices, faces = [], []
    for strip in strips:
        start = len(vertices)
        vertices += [(r * np.cos(a), r * np.sin(a), z) for r, z in strip for a in angles]
        for ring in range(len(strip) - 1):
            for side in range(_SIDES):
                a, b = start + ring * _SIDES + side, start + ring * _SIDES + (side + 1) % _SIDES
                faces += [(a, b, b + _SIDES), (a, b + _SIDES, a + _SIDES)]
    return np.array(vertices, np.float32), np.array(faces, np.uint32)
