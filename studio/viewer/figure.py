"""A compiled design as drawable parts: their kinds, sizes and colours, and where each is at every instant."""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

KINDS: dict[int, str] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_MESH): "mesh",
    int(mujoco.mjtGeom.mjGEOM_PLANE): "box",
}
_PLANE_THICKNESS = 0.02
"""Half-thickness of the slab that a plane is drawn as, as a share of its shorter half-extent."""
_LAST_VISIBLE_GROUP = 2
"""Last group of geoms that is drawn. MuJoCo's own viewers hide the groups beyond it: collision shapes by convention."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in its geom's frame."""

    vertices: np.ndarray
    """Corners of the mesh in metres, (V, 3) float32."""
    faces: np.ndarray
    """Indices of the three corners of each face, (F, 3) uint32."""

    def depth(self, point: np.ndarray) -> float:
        """Return how far (m) a point (3,) of the mesh's frame is beyond its faces' planes; negative in a convex one."""
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return float(np.max(np.einsum("fc,fc->f", normals, point - corners[:, 0])))


@dataclass(frozen=True)
class Figure:
    """Parts to draw, n of them, and where each is at T instants."""

    names: tuple[str, ...]
    """Names of the geoms, or of their bodies where geoms have none."""
    kinds: tuple[str, ...]
    sizes: np.ndarray
    """Half-extents along each part's own axes in metres, (n, 3); a capsule's third one leaves out its round ends."""
    colours: np.ndarray
    """Red, green and blue of each part, (n, 3) uint8."""
    meshes: tuple[Mesh | None, ...]
    positions: np.ndarray
    """Positions in the world in metres, (T, n, 3) float32."""
    wxyz: np.ndarray
    """Orientations in the world as quaternions w, x, y, z, (T, n, 4) float32."""

    @classmethod
    def from_model(cls, model: mujoco.MjModel, qpos: np.ndarray) -> "Figure":
        """Place the visible geoms of `model` at each row of qpos (T, nq) by forward kinematics."""
        if qpos.ndim != 2 or qpos.shape[1] != model.nq:
            raise ValueError(f"qpos must have the shape (T, {model.nq}), not {qpos.shape}")
        visible = [
            i
            for i in range(model.ngeom)
            if int(model.geom_type[i]) in KINDS
            and model.geom_group[i] <= _LAST_VISIBLE_GROUP
            and model.geom_rgba[i, 3] > 0
            and not _is_endless(model, i)
        ]
        data = mujoco.MjData(model)
        positions = np.empty((len(qpos), len(visible), 3), np.float32)
        wxyz = np.empty((len(qpos), len(visible), 4), np.float32)
        quaternion = np.empty(4)
        for t, row in enumerate(qpos):
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            positions[t] = data.geom_xpos[visible]
            for k, i in enumerate(visible):
                mujoco.mju_mat2Quat(quaternion, data.geom_xmat[i])
                wxyz[t, k] = quaternion
        sizes = np.array([_size(model, i) for i in visible]).reshape(-1, 3)
        for k, i in enumerate(visible):
            if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_PLANE:  # its top is the plane
                positions[:, k] -= rotations(wxyz[:, k])[..., 2] * sizes[k, 2]
        kinds = tuple(KINDS[int(model.geom_type[i])] for i in visible)
        return cls(
            names=tuple(model.geom(i).name or model.body(int(model.geom_bodyid[i])).name for i in visible),
            kinds=kinds,
            sizes=sizes,
            colours=np.round(255 * model.geom_rgba[visible, :3]).astype(np.uint8),
            meshes=tuple(_mesh(model, i) if k == "mesh" else None for k, i in zip(kinds, visible, strict=True)),
            positions=positions,
            wxyz=wxyz,
        )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def instants(self) -> int:
        """Return the number of instants, T."""
        return len(self.positions)

    @classmethod
    def balls(cls, centres: np.ndarray, radius: float, name: str, colour: tuple[int, int, int]) -> "Figure":
        """Return a figure of balls with one colour and one radius (m) round centres (T, n, 3) m."""
        instants, n, _ = centres.shape
        return cls(
            names=(name,) * n,
            kinds=("sphere",) * n,
            sizes=np.full((n, 3), radius),
            colours=np.tile(np.array(colour, np.uint8), (n, 1)),
            meshes=(None,) * n,
            positions=centres.astype(np.float32),
            wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (instants, n, 1)),
        )

    @classmethod
    def joined(cls, figures: Sequence["Figure"]) -> "Figure":
        """Return one figure of the parts of several, which have the same instants."""
        return cls(
            names=tuple(name for f in figures for name in f.names),
            kinds=tuple(kind for f in figures for kind in f.kinds),
            sizes=np.concatenate([f.sizes for f in figures]),
            colours=np.concatenate([f.colours for f in figures]),
            meshes=tuple(mesh for f in figures for mesh in f.meshes),
            positions=np.concatenate([f.positions for f in figures], 1),
            wxyz=np.concatenate([f.wxyz for f in figures], 1),
        )

    def take(self, parts: Sequence[int]) -> "Figure":
        """Return the figure of some of the parts, by index."""
        index = list(parts)
        return Figure(
            names=tuple(self.names[i] for i in index),
            kinds=tuple(self.kinds[i] for i in index),
            sizes=self.sizes[index].reshape(-1, 3),
            colours=self.colours[index].reshape(-1, 3),
            meshes=tuple(self.meshes[i] for i in index),
            positions=self.positions[:, index],
            wxyz=self.wxyz[:, index],
        )

    def moved(self, by: np.ndarray) -> "Figure":
        """Return the figure `by` (3,) m away."""
        return dataclasses.replace(self, positions=self.positions + by.astype(np.float32))

    def tinted(self, colour: tuple[int, int, int], share: float) -> "Figure":
        """Return the figure with a share of its colours in [0, 1] taken by another one."""
        mixed = np.round((1 - share) * self.colours + share * np.array(colour)).astype(np.uint8)
        return dataclasses.replace(self, colours=mixed)

    def thinned(self, factor: float) -> "Figure":
        """Return the figure with rods and balls `factor` as thick, so that it hides inside the original."""
        rods = np.array([kind in ("capsule", "cylinder", "sphere") for kind in self.kinds], bool)
        sizes = self.sizes.copy()
        sizes[rods, :2] *= factor
        return dataclasses.replace(self, sizes=sizes)

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners (3,) and (3,) of a box that holds all parts at all instants."""
        if not len(self):
            return np.zeros(3), np.zeros(3)
        corners = self.corners(range(self.instants))
        return corners.min(0), corners.max(0)

    def corners(self, instants: Sequence[int]) -> np.ndarray:
        """Return the corners (8 n T, 3) of level boxes, each of which holds one part at one of T instants."""
        signs = np.array(list(itertools.product((-1, 1), repeat=3)))
        found = [np.zeros((0, 3))]
        for i, kind in enumerate(self.kinds):
            mesh = self.meshes[i]
            half = np.abs(mesh.vertices).max(0) if mesh else self.sizes[i].copy()
            half[2] += half[0] if kind == "capsule" else 0.0
            reach = np.abs(rotations(self.wxyz[list(instants), i])) @ half
            found.append((self.positions[list(instants), i, None] + reach[:, None] * signs).reshape(-1, 3))
        return np.concatenate(found)

    def nearest(self, point: np.ndarray, instant: int = 0) -> int:
        """Return the index of the part nearest to a point (3,) of the world, or of the one that holds it deepest."""
        turned = np.einsum("nji,nj->ni", rotations(self.wxyz[instant]), point - self.positions[instant])
        distances = [
            mesh.depth(local) if mesh else float(np.max(np.abs(local) - size))
            for mesh, local, size in zip(self.meshes, turned, self.sizes, strict=True)
        ]
        return int(np.argmin(distances))


def smooth(model: mujoco.MjModel, qpos: np.ndarray, factor: int) -> np.ndarray:
    """Return qpos ((T - 1) * factor + 1, nq) with postures put in between, along the shortest way of every joint."""
    frames = np.empty(((len(qpos) - 1) * factor + 1, model.nq))
    velocity = np.empty(model.nv)
    for t, (here, there) in enumerate(itertools.pairwise(qpos)):
        mujoco.mj_differentiatePos(model, velocity, 1.0, here, there)
        for k in range(factor):
            frames[t * factor + k] = here
            mujoco.mj_integratePos(model, frames[t * factor + k], velocity, k / factor)
    frames[-1] = qpos[-1]
    return frames


def _is_endless(model: mujoco.MjModel, geom: int) -> bool:
    plane = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE
    return bool(plane and (model.geom_size[geom, :2] <= 0).any())


def _size(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return half-extents (3,) for MuJoCo's geom_size (3,), whose unused entries are zero."""
    kind, size = KINDS[int(model.geom_type[geom])], model.geom_size[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
        return np.array([*size[:2], _PLANE_THICKNESS * size[:2].min()])
    if kind in ("capsule", "cylinder"):
        return np.array([size[0], size[0], size[1]])
    if kind == "sphere":
        return np.where(size > 0, size, size[0])
    return np.ones(3) if kind == "mesh" else size.copy()


def _mesh(model: mujoco.MjModel, geom: int) -> Mesh:
    i = int(model.geom_dataid[geom])
    v, f = int(model.mesh_vertadr[i]), int(model.mesh_faceadr[i])
    return Mesh(
        model.mesh_vert[v : v + model.mesh_vertnum[i]].astype(np.float32),
        model.mesh_face[f : f + model.mesh_facenum[i]].astype(np.uint32),
    )


def rotations(wxyz: np.ndarray) -> np.ndarray:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(wxyz, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)
