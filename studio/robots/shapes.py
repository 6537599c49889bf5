"""The shapes of a compiled model as solids, in millimetres: what stands in for parts that nobody has drawn."""

import mujoco
import numpy as np
from manifold3d import Manifold, OpType

from studio.robots.parts import MILLIMETRE

SEGMENTS = 48
"""Facets round a circle; their corners are on it, so that a solid is inside its shape."""


def solid_of(model: mujoco.MjModel, body: int) -> Manifold | None:
    """Return the union of a body's collision shapes, or of all its shapes where none collides; None without any."""
    first = int(model.body_geomadr[body])
    geoms = list(range(first, first + int(model.body_geomnum[body])))
    colliding = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
    solids = [solid for g in colliding or geoms if (solid := _placed(model, g)) is not None]
    return Manifold.batch_boolean(solids, OpType.Add) if solids else None


def _placed(model: mujoco.MjModel, geom: int) -> Manifold | None:
    """Return a shape where it is in its body's frame; None for what has no volume."""
    solid = _shape(model, geom)
    if solid is None or solid.is_empty():
        return None
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    return solid.transform(np.column_stack([turn.reshape(3, 3), model.geom_pos[geom] / MILLIMETRE]))


def _shape(model: mujoco.MjModel, geom: int) -> Manifold | None:
    """Return a shape in its own frame; a mesh collides as its convex hull."""
    a, b, c = (float(size) / MILLIMETRE for size in model.geom_size[geom])
    match int(model.geom_type[geom]):
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return Manifold.sphere(a, SEGMENTS)
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            return Manifold.sphere(1.0, SEGMENTS).scale((a, b, c))
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            ball = Manifold.sphere(a, SEGMENTS)
            return Manifold.batch_hull([ball.translate((0, 0, -b)), ball.translate((0, 0, b))])
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return Manifold.cylinder(2 * b, a, a, SEGMENTS, center=True)
        case mujoco.mjtGeom.mjGEOM_BOX:
            return Manifold.cube((2 * a, 2 * b, 2 * c), center=True)
        case mujoco.mjtGeom.mjGEOM_MESH:
            mesh = int(model.geom_dataid[geom])
            start = int(model.mesh_vertadr[mesh])
            vertices = model.mesh_vert[start : start + int(model.mesh_vertnum[mesh])]
            return Manifold.hull_points(vertices.astype(float) / MILLIMETRE)
    return None
