"""One robot as different readers understand its files: MuJoCo, yourdfpy, pinocchio, pybullet."""

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from studio.export.urdf import CARRIER_MASS, NO_LIMIT, free_base, joint_effort, joint_limits, link_origin, urdf_names
from studio.export.zero import zero_of

_TOWARDS = np.array([d for d in itertools.product((0.0, 1.0, -1.0), repeat=3) if d > (0.0, 0.0, 0.0)])
DIRECTIONS = _TOWARDS[np.argsort(np.abs(_TOWARDS).sum(1), kind="stable")][:, ::-1]
DIRECTIONS = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
"""Unit vectors (13, 3): x, y, z, the diagonals of a cube's faces, and those of the cube. Two boxes,
cylinders or spheres that reach equally far along all of them are the same shape at the same place."""


@dataclass(frozen=True)
class Reading:
    """A robot as one reader understood it; bodies and joints go by their names in the URDF."""

    masses: dict[str, float]  # kg
    inertias: dict[str, np.ndarray]
    """Inertias (3, 3) in kg m^2 about the centre of mass, in the axes of the body."""
    limits: dict[str, tuple[float, float]]
    efforts: dict[str, float]  # N or N m
    dampings: dict[str, float]
    extents: dict[str, np.ndarray]
    """How far (n, 2, 13) in m each of a body's n collision shapes reaches along `DIRECTIONS`, at least and at most,
    from its centre of mass, in its axes; a capsule is a cylinder and two spheres, as in a URDF."""
    poses: Callable[[Mapping[str, float]], dict[str, np.ndarray]]
    """Function of joint values that returns a matrix (4, 4) for each body: its axes, at its centre of mass, seen from
    the base; sites likewise.

    A URDF link's frame is at its joint, which may be elsewhere in MuJoCo; the centre of mass is the same for all.
    """


def read_mjcf(model: mujoco.MjModel, zero: Mapping[str, float] | None = None) -> Reading:
    """Read a model under the names that its bodies and joints have in the URDF.

    Joint values count from `zero`, values of the model's joints by name, or else from the nearest to 0 that is allowed.
    """
    names = urdf_names(model)
    base = free_base(model)
    reading = _read_mujoco(model, names.links, names.joints, names.sites, base or 0, zero_of(model, zero or {}))
    frames = [names.links[b] for b in range(model.nbody) if model.body_mass[b] <= 0 and (b or base is None)]
    return replace(reading, masses=reading.masses | dict.fromkeys(frames, CARRIER_MASS))


def read_urdf(model: mujoco.MjModel) -> Reading:
    """Read what MuJoCo made of a URDF."""
    links, joints = [model.body(i).name for i in range(model.nbody)], [model.joint(i).name for i in range(model.njnt)]
    return _read_mujoco(model, links, joints, [], 0, np.zeros(model.njnt))


def _read_mujoco(
    model: mujoco.MjModel, links: list[str], joints: list[str], sites: list[str], base: int, zero: np.ndarray
) -> Reading:
    data = mujoco.MjData(model)
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    moving = {joints[j]: j for j in range(model.njnt) if j not in free}
    heavy = [i for i in range(model.nbody) if model.body_mass[i] > 0]
    offsets = np.array([model.body_ipos[i] if i in heavy else link_origin(model, i) for i in range(model.nbody)])

    def poses(posture: Mapping[str, float]) -> dict[str, np.ndarray]:
        for name, j in moving.items():
            data.qpos[model.jnt_qposadr[j]] = posture[name] + zero[j]
        mujoco.mj_kinematics(model, data)
        origin = np.linalg.inv(_pose(data.xmat[base], data.xpos[base]))
        centres = data.xpos + np.einsum("bij,bj->bi", data.xmat.reshape(-1, 3, 3), offsets)
        bodies, frames = _pose(data.xmat, centres), _pose(data.site_xmat, data.site_xpos)
        placed = origin @ np.concatenate([bodies[1:], frames[: len(sites)]])
        return dict(zip([*links[1:], *sites], placed, strict=True))

    return Reading(
        masses={links[i]: float(model.body_mass[i]) for i in heavy},
        inertias={links[i]: _tensor(model.body_iquat[i], model.body_inertia[i]) for i in heavy},
        limits={name: joint_limits(model, j, float(zero[j])) for name, j in moving.items()},
        efforts={name: joint_effort(model, j) for name, j in moving.items()},
        dampings={name: float(model.dof_damping[model.jnt_dofadr[j]]) for name, j in moving.items()},
        extents={
            links[i]: np.stack(shapes) for i in range(model.nbody) if (shapes := list(_shapes(model, i, offsets[i])))
        },
        poses=poses,
    )


def collision_box(model: mujoco.MjModel, body: int) -> np.ndarray | None:
    """Return the corners (2, 3) m of the box round a body's collision shapes, in its frame; None without any."""
    shapes = list(_shapes(model, body, np.zeros(3)))
    if not shapes:
        return None
    return np.stack([np.min(shapes, axis=0)[0, :3], np.max(shapes, axis=0)[1, :3]])


def _shapes(model: mujoco.MjModel, body: int, origin: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the reach (2, 13) m of each collision shape of a body, seen from `origin`."""
    for g in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
        if not model.geom_contype[g] and not model.geom_conaffinity[g]:
            continue
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
        axes = rotation.reshape(3, 3)
        centre, size = model.geom_pos[g] - origin, model.geom_size[g]
        match int(model.geom_type[g]):
            case mujoco.mjtGeom.mjGEOM_CAPSULE:
                yield _reach(axes, centre, disc=size[0], line=size[1])
                for end in (-size[1], size[1]):
                    yield _reach(axes, centre + end * axes[:, 2], sphere=size[0])
            case mujoco.mjtGeom.mjGEOM_SPHERE:
                yield _reach(axes, centre, sphere=size[0])
            case mujoco.mjtGeom.mjGEOM_CYLINDER:
                yield _reach(axes, centre, disc=size[0], line=size[1])
            case mujoco.mjtGeom.mjGEOM_MESH:
                mesh = model.geom_dataid[g]
                first = model.mesh_vertadr[mesh]
                yield _reach_of_points(model.mesh_vert[first : first + model.mesh_vertnum[mesh]] @ axes.T + centre)
            case _:
                yield _reach(axes, centre, box=size)


def _reach(
    axes: np.ndarray,
    centre: np.ndarray,
    sphere: float = 0.0,
    disc: float = 0.0,
    line: float = 0.0,
    box: np.ndarray | None = None,
) -> np.ndarray:
    """Return how far (2, 13) the sum of a sphere, a disc and a line along z, and a box reaches along `DIRECTIONS`."""
    along = DIRECTIONS @ axes
    half = sphere + disc * np.hypot(along[:, 0], along[:, 1]) + line * np.abs(along[:, 2])
    half = half + (0.0 if box is None else np.abs(along) @ box)
    return np.stack([-half, half]) + DIRECTIONS @ centre


def _reach_of_points(points: np.ndarray) -> np.ndarray:
    along = points @ DIRECTIONS.T
    return np.stack([along.min(0), along.max(0)])


def read_yourdfpy(path: Path) -> Reading:
    """Read a URDF with yourdfpy; its meshes play no part in the comparison."""
    import yourdfpy

    robot = yourdfpy.URDF.load(str(path), load_meshes=False, build_collision_scene_graph=False)
    centres = {
        name: np.eye(4) if link.inertial is None else link.inertial.origin for name, link in robot.link_map.items()
    }
    inertials = {name: link.inertial for name, link in robot.link_map.items() if link.inertial is not None}

    def poses(posture: Mapping[str, float]) -> dict[str, np.ndarray]:
        robot.update_cfg(dict(posture))
        found = {}
        for name, centre in centres.items():
            pose = robot.get_transform(name).copy()
            pose[:3, 3] += pose[:3, :3] @ centre[:3, 3]
            found[name] = pose
        return found

    joints = {n: j for n, j in robot.joint_map.items() if j.type != "fixed"}
    return Reading(
        masses={name: inertial.mass for name, inertial in inertials.items()},
        inertias={
            name: inertial.origin[:3, :3] @ inertial.inertia @ inertial.origin[:3, :3].T
            for name, inertial in inertials.items()
        },
        limits={
            n: (-NO_LIMIT, NO_LIMIT) if j.type == "continuous" else (j.limit.lower, j.limit.upper)
            for n, j in joints.items()
        },
        efforts={n: j.limit.effort for n, j in joints.items()},
        dampings={n: j.dynamics.damping for n, j in joints.items()},
        extents={
            name: np.stack(shapes)
            for name, link in robot.link_map.items()
            if (shapes := [_yourdfpy_reach(c, centres[name][:3, 3], path.parent) for c in link.collisions])
        },
        poses=poses,
    )


def _yourdfpy_reach(collision: Any, origin: np.ndarray, folder: Path) -> np.ndarray:
    pose, shape = np.eye(4) if collision.origin is None else collision.origin, collision.geometry
    axes, centre = pose[:3, :3], pose[:3, 3] - origin
    if shape.sphere:
        return _reach(axes, centre, sphere=shape.sphere.radius)
    if shape.cylinder:
        return _reach(axes, centre, disc=shape.cylinder.radius, line=shape.cylinder.length / 2)
    if shape.box:
        return _reach(axes, centre, box=np.asarray(shape.box.size) / 2)
    import trimesh

    return _reach_of_points(trimesh.load_mesh(folder / shape.mesh.filename).vertices @ axes.T + centre)


def _pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return rotations (..., 9) and positions (..., 3) as matrices (..., 4, 4)."""
    pose = np.zeros((*position.shape[:-1], 4, 4))
    pose[..., :3, :3] = rotation.reshape(*position.shape[:-1], 3, 3)
    pose[..., :3, 3] = position
    pose[..., 3, 3] = 1.0
    return pose


def _tensor(quat: np.ndarray, diagonal: np.ndarray) -> np.ndarray:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quat)
    axes = rotation.reshape(3, 3)
    return axes @ np.diag(diagonal) @ axes.T
