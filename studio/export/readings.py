"""One robot as different readers understand its files: MuJoCo, yourdfpy, pinocchio, pybullet."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from studio.export.urdf import CARRIER_MASS, NO_LIMIT, free_base, joint_effort, joint_limits, link_origin, urdf_names
from studio.export.zero import zero_of


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
    """Corners (2, 3) in m of the box round a body's collision shapes, from its centre of mass, in its axes."""
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
        found = {links[i]: origin @ _pose(data.xmat[i], centres[i]) for i in range(1, model.nbody)}
        return found | {s: origin @ _pose(data.site_xmat[i], data.site_xpos[i]) for i, s in enumerate(sites)}

    return Reading(
        masses={links[i]: float(model.body_mass[i]) for i in heavy},
        inertias={links[i]: _tensor(model.body_iquat[i], model.body_inertia[i]) for i in heavy},
        limits={name: joint_limits(model, j, float(zero[j])) for name, j in moving.items()},
        efforts={name: joint_effort(model, j) for name, j in moving.items()},
        dampings={name: float(model.dof_damping[model.jnt_dofadr[j]]) for name, j in moving.items()},
        extents={links[i]: box for i in range(model.nbody) if (box := collision_box(model, i, offsets[i])) is not None},
        poses=poses,
    )


def collision_box(model: mujoco.MjModel, body: int, origin: np.ndarray) -> np.ndarray | None:
    """Return the corners (2, 3) m of the box round a body's collision shapes, seen from `origin`; None without any."""
    boxes = []
    for g in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
        if not model.geom_contype[g] and not model.geom_conaffinity[g]:
            continue
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
        axes = rotation.reshape(3, 3)
        size = model.geom_size[g]
        match int(model.geom_type[g]):
            case mujoco.mjtGeom.mjGEOM_CAPSULE:
                low, high = _around(axes, sphere=size[0], line=size[1])
            case mujoco.mjtGeom.mjGEOM_SPHERE:
                low, high = _around(axes, sphere=size[0])
            case mujoco.mjtGeom.mjGEOM_CYLINDER:
                low, high = _around(axes, disc=size[0], line=size[1])
            case mujoco.mjtGeom.mjGEOM_MESH:
                mesh = model.geom_dataid[g]
                first = model.mesh_vertadr[mesh]
                vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]] @ axes.T
                low, high = vertices.min(0), vertices.max(0)
            case _:
                low, high = _around(axes, box=size)
        boxes.append(np.stack([low, high]) + model.geom_pos[g] - origin)
    return _union(boxes)


def _around(
    axes: np.ndarray, sphere: float = 0.0, disc: float = 0.0, line: float = 0.0, box: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box round the sum of a sphere, a disc and a line along z, and a box."""
    z = axes[:, 2]
    half = sphere + disc * np.sqrt(np.clip(1 - z**2, 0, None)) + line * np.abs(z)
    half = half + (0.0 if box is None else np.abs(axes) @ box)
    return -half, half


def _union(boxes: list[np.ndarray]) -> np.ndarray | None:
    if not boxes:
        return None
    return np.stack([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)])


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
            name: box
            for name, link in robot.link_map.items()
            if (box := _yourdfpy_box(link, centres[name][:3, 3], path.parent)) is not None
        },
        poses=poses,
    )


def _yourdfpy_box(link: Any, origin: np.ndarray, folder: Path) -> np.ndarray | None:
    boxes = []
    for collision in link.collisions:
        pose, shape = np.eye(4) if collision.origin is None else collision.origin, collision.geometry
        axes = pose[:3, :3]
        if shape.sphere:
            low, high = _around(axes, sphere=shape.sphere.radius)
        elif shape.cylinder:
            low, high = _around(axes, disc=shape.cylinder.radius, line=shape.cylinder.length / 2)
        elif shape.box:
            low, high = _around(axes, box=np.asarray(shape.box.size) / 2)
        else:
            import trimesh

            vertices = trimesh.load_mesh(folder / shape.mesh.filename).vertices @ axes.T
            low, high = vertices.min(0), vertices.max(0)
        boxes.append(np.stack([low, high]) + pose[:3, 3] - origin)
    return _union(boxes)


def _pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation.reshape(3, 3)
    pose[:3, 3] = position
    return pose


def _tensor(quat: np.ndarray, diagonal: np.ndarray) -> np.ndarray:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quat)
    axes = rotation.reshape(3, 3)
    return axes @ np.diag(diagonal) @ axes.T
