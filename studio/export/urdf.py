"""A compiled MuJoCo model as URDF for the strictest reader: one link per body, its frame at the joint, exact numbers.

The root is an empty link `world` to which the base is fixed: Gazebo and Drake then hold the robot without being told,
and KDL finds no mass in the root. No two links or joints share a name, and zero is allowed for every joint.
URDF knows no capsule (here: a cylinder and two spheres), no body with several joints (here: a chain of links without
size and of negligible mass), and no armature, servo gain or contact option (they are in the MJCF only).
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from xml.etree import ElementTree

import mujoco
import numpy as np

from studio.export.errors import ExportError
from studio.export.zero import held, nearest_zero
from studio.robots.parts import BASE, free_name, link_names
from studio.robots.stl import stl

NO_LIMIT = 1e6
"""The number that stands in for a limit which the task does not set, where URDF demands one (N, N m, m/s, rad/s, m)."""
FRAME_MASS = 1e-12
"""Mass (kg) and inertia (kg m^2) of links that are only a frame: without any, readers make it a kilogram."""
CARRIER_MASS = 2e-6
"""Mass (kg) of such a link where it carries others: with less than 1e-6, Gazebo drops it with all that it carries."""
MESHES = "meshes_urdf"
WORLD = "world"
"""Name of the root link of a robot that stands fixed, which readers know."""
DRIVES = ("transmission", "ros2_control")
"""Elements of a URDF that say what drives its joints."""
_UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)


@dataclass(frozen=True)
class Names:
    """What the links and joints of a model are called in its URDF: unique over all of them, never empty."""

    links: list[str]
    """Names of the links, one per body; the first is the base."""
    joints: list[str]
    sites: list[str]
    """Names of the sites, which are written as links of no size and negligible mass."""


def urdf_names(model: mujoco.MjModel) -> Names:
    """Return the names of links, joints and sites; what has none in the model is numbered from 1."""
    taken: set[str] = set()
    links = [_unique(_plain(name), taken) for name in link_names(model)]
    taken |= {WORLD, _fixed(BASE)}
    joints = [_joint_name(_plain(model.joint(i).name) or f"joint_{i + 1}", taken) for i in range(model.njnt)]
    sites = [_unique(_plain(model.site(i).name) or f"site_{i + 1}", taken) for i in range(model.nsite)]
    return Names(links, joints, sites)


def _plain(name: str) -> str:
    """Return a name in letters, digits and underscores that begins with no digit: what Isaac's importer, whose names
    are those of USD, takes as it is; Gazebo stumbles over signs of XML, and all readers over line ends."""
    word = re.sub(r"[^A-Za-z0-9_]+", "_", name)
    return f"_{word}" if word[:1].isdigit() else word


def _joint_name(name: str, taken: set[str]) -> str:
    """Return the name of a joint; one that is called like its link says that it is the joint."""
    return _unique(f"{name}_joint" if name in taken else name, taken)


def _fixed(link: str) -> str:
    return f"{link}_fixed"


def free_base(model: mujoco.MjModel) -> int | None:
    """Return the body that floats freely and carries all others, or None if the robot is fixed to the world."""
    free = [int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        return None
    if len(free) > 1 or any(model.body_rootid[b] != free[0] for b in range(1, model.nbody)) or model.body_geomnum[0]:
        raise ExportError("URDF holds one robot: a free-floating base must carry every other body and geom")
    return free[0]


def write_urdf(
    model: mujoco.MjModel,
    name: str,
    robot: str,
    visuals: Mapping[str, str] | None = None,
    speeds: Mapping[str, float] | None = None,
    *,
    drives: bool = False,
) -> dict[str, bytes]:
    """Return {`name`: XML, meshes}; raise ExportError for what URDF can't hold.

    `visuals` names the STL file (mm, in the body's frame) that a link shows in place of its collision shapes, `speeds`
    (m/s, rad/s) what the model's joints are limited to; with `drives`, servos are transmissions and ros2_control
    interfaces.
    """
    if model.neq or model.ntendon:
        raise ExportError("URDF can't hold equality constraints or tendons: choose mjcf alone")
    names = urdf_names(model)
    root = ElementTree.Element("robot", name=robot)
    # Read by MuJoCo alone: keep visuals, mesh folders and fixed links, and let geoms add no mass of their own.
    ElementTree.SubElement(
        ElementTree.SubElement(root, "mujoco"), "compiler",
        discardvisual="false", strippath="false", fusestatic="false", inertiafromgeom="false",
    )  # fmt: skip
    base = free_base(model)
    if base is None:
        ElementTree.SubElement(root, "link", name=WORLD)
        _add_joint(root, _fixed(BASE), "fixed", WORLD, BASE, np.zeros(3), _UNTURNED)
    for body in range(model.nbody):
        if base is not None and body == 0:
            continue
        origin = _add_joints(root, model, body, names, speeds or {}) if body not in (0, base) else np.zeros(3)
        link = ElementTree.SubElement(root, "link", name=names.links[body])
        _add_inertial(link, model, body, origin)
        for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
            _add_geom(link, model, geom, origin, names.links[body] not in (visuals or {}))
        if visuals and names.links[body] in visuals:
            _add_part(link, model, body, visuals[names.links[body]], origin)
        for site in np.flatnonzero(model.site_bodyid == body):
            _add_frame(root, names.sites[site], FRAME_MASS)
            _add_joint(
                root, _fixed(names.sites[site]), "fixed", names.links[body], names.sites[site],
                model.site_pos[site] - origin, model.site_quat[site],
            )  # fmt: skip
    _separate_names(root)
    if drives:
        _add_drives(root, model, names)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return {name: text + b"\n", **{_mesh_path(model, i): _stl(model, i) for i in range(model.nmesh)}}


def _add_joints(
    root: ElementTree.Element, model: mujoco.MjModel, body: int, names: Names, speeds: Mapping[str, float]
) -> np.ndarray:
    """Join `body` to its parent by its joints, or fixedly; return where its link's frame is in the body's (3,) m."""
    joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    parent_body = int(model.body_parentid[body])
    parent = names.links[parent_body]
    position = model.body_pos[body] - link_origin(model, parent_body)
    rotation = model.body_quat[body]
    if not joints:
        _add_joint(root, _fixed(names.links[body]), "fixed", parent, names.links[body], position, rotation)
        return np.zeros(3)
    origin = np.zeros(3)
    for joint in joints:
        position = position + _rotate(rotation, model.jnt_pos[joint] - origin)
        origin = model.jnt_pos[joint]
        last = joint == joints[-1]
        child = names.links[body] if last else f"{names.links[body]}__{names.joints[joint]}"
        if not last:
            _add_frame(root, child, CARRIER_MASS)
        speed = speeds.get(model.joint(joint).name, NO_LIMIT)
        _add_moving_joint(root, model, joint, names.joints[joint], parent, child, position, rotation, speed)
        parent, position, rotation = child, np.zeros(3), _UNTURNED
    return origin


def _add_moving_joint(
    root: ElementTree.Element,
    model: mujoco.MjModel,
    joint: int,
    name: str,
    parent: str,
    child: str,
    position: np.ndarray,
    rotation: np.ndarray,
    speed: float,
) -> None:
    axis = model.jnt_axis[joint]
    moved = float(nearest_zero(model)[joint] - model.qpos0[model.jnt_qposadr[joint]])
    match int(model.jnt_type[joint]):
        case mujoco.mjtJoint.mjJNT_HINGE:
            kind = "revolute" if model.jnt_limited[joint] else "continuous"
            turned = np.zeros(4)
            mujoco.mju_axisAngle2Quat(turned, axis, moved)
            rotation = _multiply(rotation, turned)  # URDF's zero posture is the one of joint value zero
        case mujoco.mjtJoint.mjJNT_SLIDE:
            kind = "prismatic"
            position = position + _rotate(rotation, axis * moved)
        case _:
            raise ExportError(f"URDF can't hold the joint {name}: only hinge, slide and a free base are possible")
    element = _add_joint(root, name, kind, parent, child, position, rotation)
    ElementTree.SubElement(element, "axis", xyz=_row(axis))
    limit = ElementTree.SubElement(
        element, "limit", effort=_number(joint_effort(model, joint)), velocity=_number(speed)
    )
    if kind != "continuous":
        lo, hi = joint_limits(model, joint, float(nearest_zero(model)[joint]))
        limit.set("lower", _number(lo))
        limit.set("upper", _number(hi))
    dof = int(model.jnt_dofadr[joint])
    ElementTree.SubElement(
        element, "dynamics",
        damping=_number(float(model.dof_damping[dof])), friction=_number(float(model.dof_frictionloss[dof])),
    )  # fmt: skip


def joint_limits(model: mujoco.MjModel, joint: int, zero: float) -> tuple[float, float]:
    """Return (lo, hi) as the URDF states them, measured from `zero`: +-NO_LIMIT for a joint without limits."""
    if not model.jnt_limited[joint]:
        return -NO_LIMIT, NO_LIMIT
    return float(model.jnt_range[joint, 0] - zero), float(model.jnt_range[joint, 1] - zero)


def joint_effort(model: mujoco.MjModel, joint: int) -> float:
    """Return the largest force or torque on a joint: its own limit, or what its actuators can give together."""
    if model.jnt_actfrclimited[joint]:
        return float(np.abs(model.jnt_actfrcrange[joint]).max())
    drives = np.flatnonzero(
        np.isin(model.actuator_trntype, [int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)])
        & (model.actuator_trnid[:, 0] == joint)
    )
    if not len(drives) or not model.actuator_forcelimited[drives].all():
        return NO_LIMIT
    return float(sum(np.abs(model.actuator_forcerange[a]).max() * abs(model.actuator_gear[a, 0]) for a in drives))


def link_origin(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Return where the link's frame is in the body's frame (3,) m: at its last joint."""
    count = model.body_jntnum[body]
    if not count or body == free_base(model):
        return np.zeros(3)
    return model.jnt_pos[model.body_jntadr[body] + count - 1]


def _add_joint(
    root: ElementTree.Element,
    name: str,
    kind: str,
    parent: str,
    child: str,
    position: np.ndarray,
    rotation: np.ndarray,
) -> ElementTree.Element:
    element = ElementTree.SubElement(root, "joint", name=name, type=kind)
    _add_origin(element, position, rotation)
    ElementTree.SubElement(element, "parent", link=parent)
    ElementTree.SubElement(element, "child", link=child)
    return element


def _add_frame(root: ElementTree.Element, name: str, mass: float) -> None:
    _weigh(ElementTree.SubElement(ElementTree.SubElement(root, "link", name=name), "inertial"), mass)


def _weigh(inertial: ElementTree.Element, mass: float) -> None:
    """Give a link that is only a frame next to no mass, and even less inertia."""
    _add_origin(inertial, np.zeros(3), _UNTURNED)
    ElementTree.SubElement(inertial, "mass", value=_number(mass))
    _add_inertia(inertial, np.full(3, FRAME_MASS))


def _add_inertial(link: ElementTree.Element, model: mujoco.MjModel, body: int, origin: np.ndarray) -> None:
    inertial = ElementTree.SubElement(link, "inertial")
    if model.body_mass[body] <= 0:
        _weigh(inertial, CARRIER_MASS)
        return
    _add_origin(inertial, model.body_ipos[body] - origin, model.body_iquat[body])
    ElementTree.SubElement(inertial, "mass", value=_number(model.body_mass[body]))
    _add_inertia(inertial, model.body_inertia[body])


def _add_inertia(inertial: ElementTree.Element, diagonal: np.ndarray) -> None:
    ixx, iyy, izz = map(_number, diagonal)
    ElementTree.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")


def _add_part(link: ElementTree.Element, model: mujoco.MjModel, body: int, file: str, origin: np.ndarray) -> None:
    element = ElementTree.SubElement(link, "visual")
    _add_origin(element, -origin, _UNTURNED)
    geometry = ElementTree.SubElement(element, "geometry")
    ElementTree.SubElement(geometry, "mesh", filename=file, scale="0.001 0.001 0.001")
    _add_colour(element, _colour(model, int(model.body_geomadr[body])))


def _add_geom(link: ElementTree.Element, model: mujoco.MjModel, geom: int, origin: np.ndarray, shown: bool) -> None:
    position, rotation = model.geom_pos[geom] - origin, model.geom_quat[geom]
    collides = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
    for use in [*["visual"] * shown, *["collision"] * collides]:
        for offset, shape, sizes in _shapes(model, geom):
            element = ElementTree.SubElement(link, use)
            _add_origin(element, position + _rotate(rotation, np.array([0.0, 0.0, offset])), rotation)
            ElementTree.SubElement(ElementTree.SubElement(element, "geometry"), shape, sizes)
            if use == "visual":
                _add_colour(element, _colour(model, geom))


def _colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    rgba = model.geom_rgba[geom]
    if model.geom_matid[geom] >= 0 and np.array_equal(rgba, _DEFAULT_RGBA):
        return model.mat_rgba[model.geom_matid[geom]]
    return rgba


def _add_colour(element: ElementTree.Element, rgba: np.ndarray) -> None:
    colour = _row(rgba)
    material = ElementTree.SubElement(element, "material", name="rgba " + colour)
    ElementTree.SubElement(material, "color", rgba=colour)


def _shapes(model: mujoco.MjModel, geom: int) -> Iterator[tuple[float, str, dict[str, str]]]:
    """Yield (offset along the geom's z, URDF shape, its sizes)."""
    size = model.geom_size[geom]
    match int(model.geom_type[geom]):
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            yield 0.0, "sphere", {"radius": _number(size[0])}
        case mujoco.mjtGeom.mjGEOM_BOX:
            yield 0.0, "box", {"size": _row(2 * size)}
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            yield 0.0, "cylinder", {"radius": _number(size[0]), "length": _number(2 * size[1])}
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            yield 0.0, "cylinder", {"radius": _number(size[0]), "length": _number(2 * size[1])}
            for end in (-size[1], size[1]):
                yield float(end), "sphere", {"radius": _number(size[0])}
        case mujoco.mjtGeom.mjGEOM_MESH:
            yield 0.0, "mesh", {"filename": _mesh_path(model, int(model.geom_dataid[geom]))}
        case kind:
            shape = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
            label = model.geom(geom).name or geom
            raise ExportError(
                f"URDF can't hold the {shape} {label}: choose from: box, capsule, cylinder, mesh, sphere, or mjcf alone"
            )


def _add_drives(root: ElementTree.Element, model: mujoco.MjModel, names: Names) -> None:
    """Add a transmission for each servo, of which Drake makes an actuator, and all as one ros2_control system."""
    block = ElementTree.SubElement(root, "ros2_control", name="servos", type="system")
    plugin = ElementTree.SubElement(ElementTree.SubElement(block, "hardware"), "plugin")
    plugin.text = "mock_components/GenericSystem"  # until real ones have a driver
    zero = nearest_zero(model)
    for actuator in held(model):
        j = int(model.actuator_trnid[actuator, 0])
        joint = names.joints[j]
        drive = ElementTree.SubElement(root, "transmission", name=f"{joint}_transmission")
        ElementTree.SubElement(drive, "type").text = "transmission_interface/SimpleTransmission"
        driven = ElementTree.SubElement(drive, "joint", name=joint)
        ElementTree.SubElement(driven, "hardwareInterface").text = "hardware_interface/PositionJointInterface"
        motor = ElementTree.SubElement(drive, "actuator", name=f"{joint}_servo")
        ElementTree.SubElement(motor, "mechanicalReduction").text = "1"
        entry = ElementTree.SubElement(block, "joint", name=joint)
        command = ElementTree.SubElement(entry, "command_interface", name="position")
        if model.jnt_limited[j]:
            for name, limit in zip(("min", "max"), joint_limits(model, j, float(zero[j])), strict=True):
                ElementTree.SubElement(command, "param", name=name).text = _number(limit)
        position = ElementTree.SubElement(entry, "state_interface", name="position")
        ElementTree.SubElement(position, "param", name="initial_value").text = "0.0"
        ElementTree.SubElement(entry, "state_interface", name="velocity")


def _separate_names(root: ElementTree.Element) -> None:
    """Rename fixed joints whose made-up name a link or an authored joint has already."""
    taken = {e.get("name", "") for e in [*root.iter("link"), *root.iter("joint")] if e.get("type") != "fixed"}
    for element in root.iter("joint"):
        if element.get("type") == "fixed":
            element.set("name", _unique(element.get("name", ""), taken))


def _mesh_path(model: mujoco.MjModel, mesh: int) -> str:
    return f"{MESHES}/mesh_{mesh}_{_plain(model.mesh(mesh).name)[:60]}.stl"


def _stl(model: mujoco.MjModel, mesh: int) -> bytes:
    """Return a compiled mesh as binary STL in metres; its vertices are single precision in MuJoCo too."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices = model.mesh_vert[first : first + count]
    return stl(vertices, model.mesh_face[face : face + faces], "binary STL, metres")


def _add_origin(element: ElementTree.Element, position: np.ndarray, rotation: np.ndarray) -> None:
    ElementTree.SubElement(element, "origin", xyz=_row(position), rpy=_row(_rpy(rotation)))


def _rpy(quat: np.ndarray) -> tuple[float, float, float]:
    """Return URDF's fixed-axis roll, pitch, yaw of a quaternion; exact near a pitch of 90 degrees too.

    Roll is taken after yaw has been undone: taken alone, it is noise where pitch is 90 degrees.
    """
    r = np.zeros(9)
    mujoco.mju_quat2Mat(r, quat)
    r = r.reshape(3, 3)
    yaw = math.atan2(r[1, 0], r[0, 0])
    sin, cos = math.sin(yaw), math.cos(yaw)
    pitch = math.atan2(-r[2, 0], cos * r[0, 0] + sin * r[1, 0])
    roll = math.atan2(sin * r[0, 2] - cos * r[1, 2], cos * r[1, 1] - sin * r[0, 1])
    return roll, pitch, yaw


def _rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    result = np.zeros(3)
    mujoco.mju_rotVecQuat(result, vector, quat)
    return result


def _multiply(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    result = np.zeros(4)
    mujoco.mju_mulQuat(result, first, second)
    return result


def _number(value: float) -> str:
    """Return the shortest text that reads as the same number."""
    if not math.isfinite(value):
        raise ExportError("the model holds a number that is not finite")
    return repr(float(value) + 0.0)  # no "-0.0"


def _row(values: np.ndarray | tuple[float, ...]) -> str:
    return " ".join(_number(float(v)) for v in values)


def _unique(name: str, taken: set[str]) -> str:
    """Return `name`, with a number behind it if it is taken, and take it."""
    free = free_name(name, taken)
    taken.add(free)
    return free
