"""What is seen of a MuJoCo model: its visible geoms as triangles, at any posture."""

from dataclasses import dataclass

import mujoco
import numpy as np

from morph_core import shapes
from morph_core.picture import Surface

_LAST_VISIBLE_GROUP = 2
"""Last group of geoms that is drawn. MuJoCo's own viewers hide the groups beyond it: collision shapes by convention."""
_UNPAINTED = (0.5, 0.5, 0.5, 1.0)
"""MuJoCo's colour of a geom that names none: there its material's colour shows."""
_ENDLESS = 2.0
"""Half a side of what is drawn of an endless plane, in extents of the model."""


@dataclass(frozen=True)
class Geoms:
    """The visible geoms of a compiled model; the model is not changed."""

    model: mujoco.MjModel
    ids: tuple[int, ...]
    triangles: tuple[np.ndarray, ...]
    """Triangles of each geom, (F, 3, 3) m in the geom's own frame."""

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Geoms":
        """Return the visible geoms of a compiled model."""
        drawn = {i: _triangles(model, i) for i in range(model.ngeom) if _is_visible(model, i)}
        kept = {i: triangles for i, triangles in drawn.items() if len(triangles)}
        return cls(model, tuple(kept), tuple(kept.values()))

    def at(self, qpos: np.ndarray) -> list[Surface]:
        """Return the geoms' surfaces in the world at one posture qpos (nq,)."""
        data = mujoco.MjData(self.model)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, data)
        return [
            (triangles @ data.geom_xmat[i].reshape(3, 3).T + data.geom_xpos[i], _rgba(self.model, i)[:3])
            for i, triangles in zip(self.ids, self.triangles, strict=True)
        ]

    @property
    def are_planes(self) -> list[bool]:
        """Return for each geom whether it is a plane."""
        return [bool(self.model.geom_type[i] == mujoco.mjtGeom.mjGEOM_PLANE) for i in self.ids]


def _is_visible(model: mujoco.MjModel, geom: int) -> bool:
    return bool(model.geom_group[geom] <= _LAST_VISIBLE_GROUP and _rgba(model, geom)[3] > 0)


def _rgba(model: mujoco.MjModel, geom: int) -> np.ndarray:
    material, own = model.geom_matid[geom], model.geom_rgba[geom]
    return model.mat_rgba[material] if material >= 0 and np.allclose(own, _UNPAINTED) else own


def _triangles(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the triangles (F, 3, 3) m of a geom in its own frame; none for a kind that is not drawn."""
    vertices, faces = _shape(model, geom)
    return vertices.astype(float)[faces]


def _shape(model: mujoco.MjModel, geom: int) -> shapes.Shape:
    kinds, size = mujoco.mjtGeom, model.geom_size[geom]
    match model.geom_type[geom]:
        case kinds.mjGEOM_PLANE:
            half = np.where(size[:2] > 0, size[:2], _ENDLESS * model.stat.extent)
            corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * [*half, 0]
            return corners, np.array([(0, 1, 2), (0, 2, 3)])
        case kinds.mjGEOM_SPHERE:
            return _scaled(shapes.sphere(), size[[0, 0, 0]])
        case kinds.mjGEOM_ELLIPSOID:
            return _scaled(shapes.sphere(), size)
        case kinds.mjGEOM_CAPSULE:
            return _scaled(shapes.capsule(size[1] / size[0]), size[[0, 0, 0]])
        case kinds.mjGEOM_CYLINDER:
            return _scaled(shapes.cylinder(), size[[0, 0, 1]])
        case kinds.mjGEOM_BOX:
            return _scaled(shapes.box(), size)
        case kinds.mjGEOM_MESH:
            mesh = int(model.geom_dataid[geom])
            v, f = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
            return model.mesh_vert[v : v + model.mesh_vertnum[mesh]], model.mesh_face[f : f + model.mesh_facenum[mesh]]
    return np.zeros((0, 3)), np.zeros((0, 3), int)


def _scaled(shape: shapes.Shape, size: np.ndarray) -> shapes.Shape:
    vertices, faces = shape
    return vertices * size, faces
