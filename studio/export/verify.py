"""Proof that the exported files are the same robot: read them back with other programs' eyes and compare.

MuJoCo reads MJCF and URDF; yourdfpy, where it is installed, reads the URDF on its own account. Compared are masses,
centres and moments of inertia, joint limits, and where every body and site stands in random postures.
"""

import importlib.util
import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from studio.export.urdf import NO_LIMIT, free_base, joint_effort, joint_limits, link_origin, urdf_names

POSTURES = 100
POSITION_ALLOWED = 1e-9  # m
ROTATION_ALLOWED = 1e-9
RELATIVE_ALLOWED = 1e-9


@dataclass(frozen=True)
class Check:
    """One line of the proof: the largest difference found, and what is allowed."""

    name: str
    worst: float
    allowed: float
    detail: str = ""
    """Where the largest difference is, or why there is no comparison."""

    @property
    def passed(self) -> bool:
        return self.worst <= self.allowed  # False for NaN

    def __str__(self) -> str:
        verdict = "agrees" if self.passed else "DISAGREES"
        return (
            f"{self.name}: {verdict} ({self.worst:.2g}, allowed {self.allowed:g}{self.detail and f', {self.detail}'})"
        )


@dataclass(frozen=True)
class Reading:
    """A robot as one reader understood it; bodies and joints go by their names in the URDF."""

    masses: dict[str, float]  # kg
    inertias: dict[str, np.ndarray]
    """(3, 3) kg m^2 about the centre of mass, in the axes of the body."""
    limits: dict[str, tuple[float, float]]
    efforts: dict[str, float]  # N or N m
    dampings: dict[str, float]
    poses: Callable[[Mapping[str, float]], dict[str, np.ndarray]]
    """Joint values -> (4, 4) of each body: its axes, at its centre of mass, seen from the base; sites likewise.

    A URDF link's frame is at its joint, which may be elsewhere in MuJoCo; the centre of mass is the same for all.
    """


def verify(
    files: Mapping[str, bytes], model: mujoco.MjModel | None = None, *, only_mujoco: bool = False
) -> list[Check]:
    """Compare robot.xml and robot.urdf of `files` with `model`, or with one another if there is none.

    A file that can't be read gives a failed check, not an exception.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for path, content in files.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(content)
        checks = _read_and_compare(folder, model, only_mujoco)
    if "robot.urdf" in files:
        checks.append(_check_urdf(files))
    return checks


def _read_and_compare(folder: Path, model: mujoco.MjModel | None, only_mujoco: bool) -> list[Check]:
    readers: list[tuple[str, Callable[[], Reading]]] = []
    if (folder / "robot.xml").exists():
        readers.append(("robot.xml in MuJoCo", lambda: read_mjcf(_load(folder / "robot.xml"))))
    if (folder / "robot.urdf").exists():
        readers.append(("robot.urdf in MuJoCo", lambda: read_urdf(_load(folder / "robot.urdf"))))
        if not only_mujoco and importlib.util.find_spec("yourdfpy"):
            readers.append(("robot.urdf in yourdfpy", lambda: read_yourdfpy(folder / "robot.urdf")))
    checks = []
    reference = None if model is None else read_mjcf(model)
    for name, read in readers:
        try:
            reading = read()
            if reference is not None:
                checks += compare(name, reference, reading)
            else:
                reference = reading
        except Exception as error:  # whatever a reader throws at a broken file is the finding
            checks.append(Check(name, math.inf, 0.0, f"can't be read: {error}"))
    if (folder / "scene.xml").exists():
        try:
            _load(folder / "scene.xml")
            checks.append(Check("scene.xml in MuJoCo: read", 0.0, 0.0))
        except ValueError as error:
            checks.append(Check("scene.xml in MuJoCo", math.inf, 0.0, f"can't be read: {error}"))
    return checks


def compare(name: str, reference: Reading, reading: Reading) -> list[Check]:
    """Return one check per property; a body or joint that is missing differs by infinity."""
    properties = [
        ("masses", reference.masses, reading.masses),
        ("inertias", reference.inertias, reading.inertias),
        ("joint limits", reference.limits, reading.limits),
        ("efforts", reference.efforts, reading.efforts),
        ("dampings", reference.dampings, reading.dampings),
    ]
    checks = [_worst(f"{name}: {what}", RELATIVE_ALLOWED, _relative(a, b)) for what, a, b in properties]
    positions: dict[str, float] = {}
    rotations: dict[str, float] = {}
    for posture in postures(reference.limits):
        found = reading.poses(posture)
        for body, pose in reference.poses(posture).items():
            off = np.abs(found[body] - pose) if body in found else np.full((4, 4), math.inf)
            positions[body] = max(positions.get(body, 0.0), float(off[:3, 3].max()))
            rotations[body] = max(rotations.get(body, 0.0), float(off[:3, :3].max()))
    return [
        *checks,
        _worst(f"{name}: positions in {POSTURES} postures (m)", POSITION_ALLOWED, positions),
        _worst(f"{name}: rotations in {POSTURES} postures", ROTATION_ALLOWED, rotations),
    ]


def postures(limits: Mapping[str, tuple[float, float]]) -> list[dict[str, float]]:
    """Return random joint values within the limits; a full turn, or metre, each way where there is none."""
    rng = np.random.default_rng(0)
    turn = 2 * math.pi

    def value(lo: float, hi: float) -> float:
        a, b = sorted((max(lo, -turn), min(hi, turn)))
        return float(rng.uniform(a, b))

    return [{name: value(*limit) for name, limit in limits.items()} for _ in range(POSTURES)]


def read_mjcf(model: mujoco.MjModel) -> Reading:
    """Read a model under the names that its bodies and joints have in the URDF."""
    names = urdf_names(model)
    base = free_base(model)
    return _read_mujoco(model, names.links, names.joints, names.sites, base or 0)


def read_urdf(model: mujoco.MjModel) -> Reading:
    """Read what MuJoCo made of a URDF."""
    return _read_mujoco(
        model, [model.body(i).name for i in range(model.nbody)], [model.joint(i).name for i in range(model.njnt)], [], 0
    )


def _read_mujoco(model: mujoco.MjModel, links: list[str], joints: list[str], sites: list[str], base: int) -> Reading:
    data = mujoco.MjData(model)
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    moving = {joints[j]: j for j in range(model.njnt) if j not in free}
    heavy = [i for i in range(model.nbody) if model.body_mass[i] > 0]
    offsets = np.array([model.body_ipos[i] if i in heavy else link_origin(model, i) for i in range(model.nbody)])

    def poses(posture: Mapping[str, float]) -> dict[str, np.ndarray]:
        for name, j in moving.items():
            data.qpos[model.jnt_qposadr[j]] = posture[name]
        mujoco.mj_kinematics(model, data)
        origin = np.linalg.inv(_pose(data.xmat[base], data.xpos[base]))
        centres = data.xpos + np.einsum("bij,bj->bi", data.xmat.reshape(-1, 3, 3), offsets)
        found = {links[i]: origin @ _pose(data.xmat[i], centres[i]) for i in range(1, model.nbody)}
        return found | {s: origin @ _pose(data.site_xmat[i], data.site_xpos[i]) for i, s in enumerate(sites)}

    return Reading(
        masses={links[i]: float(model.body_mass[i]) for i in heavy},
        inertias={links[i]: _tensor(model.body_iquat[i], model.body_inertia[i]) for i in heavy},
        limits={name: joint_limits(model, j) for name, j in moving.items()},
        efforts={name: joint_effort(model, j) for name, j in moving.items()},
        dampings={name: float(model.dof_damping[model.jnt_dofadr[j]]) for name, j in moving.items()},
        poses=poses,
    )


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
        poses=poses,
    )


def _load(path: Path) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(path))


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


def _relative(expected: Mapping[str, object], found: Mapping[str, object]) -> dict[str, float]:
    """Return the difference of each entry of `expected`, relative to its size; infinity where it is missing."""
    differences = {}
    for name, value in expected.items():
        if name not in found:
            differences[name] = math.inf
            continue
        a, b = np.asarray(value, dtype=float), np.asarray(found[name], dtype=float)
        differences[name] = float(np.abs(a - b).max() / max(float(np.abs(a).max()), 1e-300)) if (a != b).any() else 0.0
    return differences


def _worst(name: str, allowed: float, differences: Mapping[str, float]) -> Check:
    """Return the check of the largest difference; NaN counts as larger than anything."""
    where = max(differences, key=lambda n: math.inf if math.isnan(differences[n]) else differences[n], default=None)
    if where is None:
        return Check(name, 0.0, allowed, "none to compare")
    return Check(name, differences[where], allowed, "" if differences[where] == 0 else f"at {where}")


def _check_urdf(files: Mapping[str, bytes]) -> Check:
    """Check what readers let pass: positive masses, possible inertias, limits in order, unique names, meshes there."""
    name = "robot.urdf: valid"
    try:
        root = ElementTree.fromstring(files["robot.urdf"])
    except ElementTree.ParseError as error:
        return Check(name, math.inf, 0.0, f"no XML: {error}")
    faults = [*_faults_of_inertials(root), *_faults_of_joints(root)]
    for kind in ("link", "joint"):
        names = [element.get("name", "") for element in root.findall(kind)]
        faults += [f"two {kind}s are named {n}" for n in sorted({n for n in names if names.count(n) > 1})]
    meshes = {element.get("filename", "") for element in root.iter("mesh")}
    faults += [f"mesh {mesh} is missing" for mesh in sorted(meshes - set(files))]
    return Check(name, float(len(faults)), 0.0, "; ".join(faults))


def _faults_of_inertials(root: ElementTree.Element) -> list[str]:
    faults = []
    for link in root.findall("link"):
        mass, inertia = link.find("inertial/mass"), link.find("inertial/inertia")
        if mass is None or inertia is None:
            continue
        if not _read(mass, "value") > 0:
            faults.append(f"{link.get('name')} has no positive mass")
        small, middle, large = sorted(_read(inertia, axis) for axis in ("ixx", "iyy", "izz"))
        if not (small > 0 and small + middle >= large * (1 - RELATIVE_ALLOWED)):
            faults.append(f"{link.get('name')} has an impossible inertia")
    return faults


def _faults_of_joints(root: ElementTree.Element) -> list[str]:
    faults = []
    children = [joint.find("child") for joint in root.findall("joint")]
    carried = [child.get("link", "") for child in children if child is not None]
    roots = [n for n in (link.get("name", "") for link in root.findall("link")) if n not in carried]
    if len(roots) != 1 or len(set(carried)) != len(carried):
        faults.append(f"the links are no tree (roots: {', '.join(roots) or 'none'})")
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if joint.get("type") not in ("revolute", "prismatic"):
            continue
        lo, hi = (math.nan if limit is None else _read(limit, end) for end in ("lower", "upper"))
        if not lo < hi:
            faults.append(f"{joint.get('name')} has no limits with lower < upper")
    return faults


def _read(element: ElementTree.Element, attribute: str) -> float:
    """Return a number of the file, NaN where there is none."""
    try:
        return float(element.get(attribute, "nan"))
    except ValueError:
        return math.nan
