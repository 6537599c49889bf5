"""What matters of a print, measured on its mesh: the thinnest wall, what hangs over, and the play of its joints."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from manifold3d import Manifold

from studio.export.pieces import LAYER
from studio.robots import geometry
from studio.robots.parts import MILLIMETRE, Part, link_names

THINNEST = 0.4
"""Least thickness of a wall (mm) that is printed: one line of a 0.4 mm nozzle."""
STEEP = 45.0
"""Angle from the upright (degrees) up to which a side is printed without support."""
PARALLEL = 15.0
"""Largest angle (degrees) between two surfaces that are taken for the two sides of one wall."""
MOST_RAYS = 1000
"""Largest number of faces from which a wall is measured: an export should take no longer than a few seconds."""
NEAR = 2.0
"""Distance (mm) up to which the gap between neighbours is looked for."""


@dataclass(frozen=True)
class Fit:
    """How two links turn on one another, in mm."""

    joint: str
    links: tuple[str, str]
    """Names of the parts: that which carries, and that which turns."""
    bores: tuple[float, float]
    """Largest diameter of a pin through either part."""
    gap: float
    """Smallest distance between both parts where the joint is at zero; at most `NEAR`."""

    @property
    def play(self) -> float:
        """Difference of both bores' diameters: a pin that is tight in the one has this much play in the other."""
        return abs(self.bores[1] - self.bores[0])


def thinnest_wall(solid: Manifold) -> float:
    """Return the smallest thickness of a body, in its unit; infinity for one without opposite sides.

    A wall is measured from the middle of each face straight through the body, to a face that is parallel to it but
    for 15 degrees: near an edge every body is thin. Of a body with very many faces only every second, third ... is
    measured.
    """
    vertices, faces = geometry.mesh(solid)
    corners = vertices[faces]  # (F, 3, 3)
    inward = -np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(inward, axis=1)
    reach = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    start, level = 1e-6 * reach, np.cos(np.radians(PARALLEL))
    thinnest = np.inf
    measured = np.flatnonzero(areas > 0)
    measured = measured[:: math.ceil(len(measured) / MOST_RAYS)]
    for middle, direction in zip(corners[measured].mean(1), inward[measured] / areas[measured, None], strict=True):
        far = min(reach, thinnest)  # a shorter ray is a quicker one
        hits = solid.ray_cast(tuple(middle + start * direction), tuple(middle + far * direction))
        if hits and np.dot(hits[0].normal, direction) > level:
            thinnest = min(thinnest, hits[0].distance * (far - start) + start)
    return float(thinnest)


def overhang(laid: Manifold) -> float:
    """Return the area (mm^2) of a body's sides above its first layer that lean outward by more than 45 degrees."""
    vertices, faces = geometry.mesh(laid)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    areas = np.linalg.norm(normals, axis=1)
    hangs = (normals[:, 2] < -np.sin(np.radians(STEEP)) * areas * (1 + 1e-9)) & (corners[..., 2].max(1) > LAYER)
    return float(areas[hangs].sum())


def bore(vertices: np.ndarray, faces: np.ndarray, point: np.ndarray, axis: np.ndarray) -> float:
    """Return the diameter of the largest pin round an axis (3,) through a point (3,) that a surface leaves room for.

    It is 0 where the axis runs through the surface.
    """
    u = np.linalg.svd(axis[None])[2][1:]  # (2, 3): the plane across the axis
    flat = ((vertices - point) @ u.T)[faces]  # (F, 3, 2)
    sides = np.roll(flat, -1, axis=1) - flat
    turns = flat[..., 0] * sides[..., 1] - flat[..., 1] * sides[..., 0]
    if np.any(np.all(turns > 0, axis=1) | np.all(turns < 0, axis=1)):
        return 0.0
    squares = np.maximum((sides**2).sum(-1), 1e-300)
    share = np.clip(-(flat * sides).sum(-1) / squares, 0.0, 1.0)
    return 2 * float(np.linalg.norm(flat + share[..., None] * sides, axis=-1).min())


def fits_of(model: mujoco.MjModel, parts: Sequence[Part]) -> list[Fit]:
    """Return how the parts of a robot fit at each hinge between two of them."""
    part_of = {link: part for part in parts for link in part.links}
    names = link_names(model)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    fits: list[Fit] = []
    for j in range(model.njnt):
        child = int(model.jnt_bodyid[j])
        parent = int(model.body_parentid[child])
        both = [part_of.get(names[body]) for body in (parent, child)]
        if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE or both[0] is None or both[1] is None:
            continue
        fits.append(_fit(model.joint(j).name, (both[0], both[1]), (parent, child), data, j))
    return fits


def _fit(name: str, parts: tuple[Part, Part], bodies: tuple[int, int], data: mujoco.MjData, joint: int) -> Fit:
    frames = [(data.xmat[body].reshape(3, 3), data.xpos[body]) for body in bodies]
    bores, solids = [], []
    for part, (turn, place) in zip(parts, frames, strict=True):
        point = turn.T @ (data.xanchor[joint] - place) / MILLIMETRE
        bores.append(bore(part.vertices, part.faces, point, turn.T @ data.xaxis[joint]))
        solids.append(part.solid.transform(np.column_stack([turn, place / MILLIMETRE])))
    gap = solids[0].min_gap(solids[1], NEAR)
    return Fit(name, (parts[0].name, parts[1].name), (bores[0], bores[1]), gap)


def tightest(fits: Sequence[Fit]) -> Mapping[str, float]:
    """Return the pin, the smallest play and the smallest gap (mm) of joints with bores in both parts; {} if none."""
    bored = [fit for fit in fits if min(fit.bores) > 0]
    if not bored:
        return {}
    return {
        "pin": min(min(fit.bores) for fit in bored),
        "play": min(fit.play for fit in bored),
        "gap": min(fit.gap for fit in bored),
    }
