"""Proof that the exported files are the same robot: read them back with other programs' eyes and compare.

MuJoCo reads MJCF and URDF; yourdfpy, where it is installed, reads the URDF on its own account. Compared are masses,
centres and moments of inertia, joint limits, and where every body and site stands in random postures.
"""

import importlib.util
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from studio.export.check import Check, relative, worst
from studio.export.errors import ExportError
from studio.export.readings import Reading, read_mjcf, read_urdf, read_yourdfpy
from studio.export.ros import FOLDER, in_packages, plain_urdf
from studio.export.urdf import DRIVES, WORLD

# MuJoCo would keep up to 500 MB of meshes by their paths, which are those of folders that are gone.
mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 0)

_WORDS = frozenset((
    "robot", "mujoco", "compiler", "link", "inertial", "origin", "mass", "inertia", "visual", "collision", "geometry",
    "box", "cylinder", "sphere", "mesh", "material", "color", "joint", "parent", "child", "axis", "limit", "dynamics",
))  # fmt: skip
"""Elements of a URDF that are compared or only shown; what else one holds, such as mimic, would pass unseen."""
POSTURES = 100
POSITION_ALLOWED = 1e-9  # m
ROTATION_ALLOWED = 1e-9
RELATIVE_ALLOWED = 1e-9
DROPPED_MASS = 1e-6
"""kg: Gazebo takes a link of no more than this for one without mass."""
FRAME_MASS = 1e-3
"""kg: what a link may weigh that stands for a place on a body, and is given a weight for readers that need one."""


def load_model(path: Path) -> mujoco.MjModel:
    """Return what MuJoCo makes of an MJCF or URDF."""
    return mujoco.MjModel.from_xml_path(str(path))


def verify_folder(
    folder: Path,
    files: Mapping[str, bytes],
    model: mujoco.MjModel | None = None,
    *,
    robot: str = "robot",
    zero: Mapping[str, float] | None = None,
    only_mujoco: bool = False,
    load: Callable[[Path], mujoco.MjModel] = load_model,
) -> list[Check]:
    """Compare `robot`.xml, .mjz and .urdf of `files` with `model`, or with one another if there is none.

    The files lie in a `folder` too, and MuJoCo reads them by `load`. `zero` holds the values at which the model's
    joints, by name, are where the files have them at 0. A file that can't be read gives a failed check, not an
    exception.
    """
    reference = None if model is None else read_mjcf(model, zero)
    checks = _read_and_compare(folder, robot, reference, only_mujoco, load)
    for path in (f"{robot}.urdf", *in_packages(files, robot)):
        if path in files:
            checks.append(_check_urdf(path, files))
    return checks


def _read_and_compare(
    folder: Path, robot: str, reference: Reading | None, only_mujoco: bool, load: Callable[[Path], mujoco.MjModel]
) -> list[Check]:
    xml, archive, urdf = (folder / f"{robot}{ending}" for ending in (".xml", ".mjz", ".urdf"))
    readers: list[tuple[str, Callable[[], Reading]]] = []
    if xml.exists():
        readers.append((f"{xml.name} in MuJoCo", lambda: read_mjcf(load(xml))))
    if archive.exists():
        readers.append((f"{archive.name} in MuJoCo", lambda: read_mjcf(mujoco.MjSpec.from_zip(str(archive)).compile())))
    if urdf.exists():
        readers.append((f"{urdf.name} in MuJoCo", lambda: read_urdf(load(urdf))))
        if not only_mujoco and importlib.util.find_spec("yourdfpy"):
            readers.append((f"{urdf.name} in yourdfpy", lambda: read_yourdfpy(urdf)))
    for path in in_packages((p.relative_to(folder).as_posix() for p in folder.rglob("*.urdf")), robot):
        readers.append((f"{path} in MuJoCo", lambda path=path: _read_packaged(folder, path)))
    checks = []
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
            load(folder / "scene.xml")
            checks.append(Check("scene.xml in MuJoCo: read", 0.0, 0.0))
        except ValueError as error:
            checks.append(Check("scene.xml in MuJoCo", math.inf, 0.0, f"can't be read: {error}"))
    return checks


def _read_packaged(folder: Path, path: str) -> Reading:
    """Read the URDF of a ROS package, with its meshes by plain paths."""
    plain = folder / "packaged.urdf"
    plain.write_bytes(plain_urdf(path, (folder / path).read_bytes()))
    return read_urdf(load_model(plain))


def compare(name: str, reference: Reading, reading: Reading) -> list[Check]:
    """Return one check per property; a body or joint that is missing, or too many, differs by infinity."""
    properties = [
        ("masses", reference.masses, reading.masses),
        ("inertias", reference.inertias, reading.inertias),
        ("joint limits", reference.limits, reading.limits),
        ("efforts", reference.efforts, reading.efforts),
        ("dampings", reference.dampings, reading.dampings),
    ]
    checks = [worst(f"{name}: {what}", RELATIVE_ALLOWED, relative(a, b)) for what, a, b in properties]
    extents = {
        body: _farthest(shapes, reading.extents[body]) if body in reading.extents else math.inf
        for body, shapes in reference.extents.items()
    }
    checks.append(worst(f"{name}: collision extents (m)", POSITION_ALLOWED, extents))
    checks.append(worst(f"{name}: nothing added", 0.0, _added(reference, reading)))
    positions: dict[str, float] = {}
    rotations: dict[str, float] = {}
    asked = postures(reference.limits)
    known = [reference.poses(posture) for posture in asked]
    found = [reading.poses(posture | dict.fromkeys(reading.limits.keys() - posture.keys(), 0.0)) for posture in asked]
    nowhere = np.full((4, 4), math.inf)
    for body in known[0]:
        off = np.abs(np.stack([f.get(body, nowhere) for f in found]) - np.stack([k[body] for k in known]))
        positions[body] = float(off[:, :3, 3].max())
        rotations[body] = float(off[:, :3, :3].max())
    return [
        *checks,
        worst(f"{name}: positions in {POSTURES} postures (m)", POSITION_ALLOWED, positions),
        worst(f"{name}: rotations in {POSTURES} postures", ROTATION_ALLOWED, rotations),
    ]


def _farthest(shapes: np.ndarray, found: np.ndarray) -> float:
    """Return how far (m) any of a body's shapes (n, 2, 13) is from the nearest one found (m, 2, 13), both ways.

    The order plays no part; another number of shapes is infinitely far.
    """
    if len(shapes) != len(found):
        return math.inf
    between = np.abs(shapes[:, None] - found[None]).max(axis=(2, 3))
    return float(max(between.min(0).max(), between.min(1).max()))


def _added(reference: Reading, reading: Reading) -> dict[str, float]:
    """Return what `reading` has and `reference` has not, by name: bodies, joints, shapes, and the weight of frames.

    What stands fixed in the world is a link of its own for readers of URDF alone: its shapes are not compared here.
    """
    known = {**reference.poses(dict.fromkeys(reference.limits, 0.0)), **reference.masses, **reference.extents}
    joints = reading.limits.keys() - reference.limits.keys()
    shapes = (reading.extents.keys() & known.keys()) - reference.extents.keys()
    added = {name: reading.masses[name] for name in reading.masses.keys() - reference.masses.keys()}
    heavy = {name: mass for name, mass in added.items() if not mass <= FRAME_MASS}
    return dict.fromkeys(joints | shapes, math.inf) | heavy


def postures(limits: Mapping[str, tuple[float, float]]) -> list[dict[str, float]]:
    """Return random joint values within the limits; a full turn, or metre, each way where there is none."""
    rng = np.random.default_rng(0)
    turn = 2 * math.pi

    def value(lo: float, hi: float) -> float:
        a, b = sorted((max(lo, -turn), min(hi, turn)))
        return float(rng.uniform(a, b))

    return [{name: value(*limit) for name, limit in limits.items()} for _ in range(POSTURES)]


def _check_urdf(path: str, files: Mapping[str, bytes]) -> Check:
    """Check what most readers let pass: masses and inertias that can be, limits that hold zero, names, meshes."""
    name = f"{path}: valid"
    try:
        content = plain_urdf(path, files[path]) if path.startswith(f"{FOLDER}/") else files[path]
        root = ElementTree.fromstring(content)
    except (ElementTree.ParseError, ExportError) as error:
        return Check(name, math.inf, 0.0, f"no URDF: {error}")
    faults = [*_faults_of_inertials(root), *_faults_of_joints(root)]
    names = [element.get("name", "") for element in [*root.findall("link"), *root.findall("joint")]]
    faults += [f"two links or joints are named {n}" for n in sorted({n for n in names if names.count(n) > 1})]
    driven = {element for kind in DRIVES for block in root.findall(kind) for element in block.iter()}
    strange = {str(element.tag) for element in root.iter() if element not in driven} - _WORDS
    faults += [f"it holds <{tag[:40]}>, which no export has" for tag in sorted(strange)]
    faults += [f"{tag} has two <{twice}>, of which readers take one each" for tag, twice in _doubled(root)]
    meshes = {element.get("filename", "") for element in root.iter("mesh")}
    faults += [f"mesh {mesh} is missing" for mesh in sorted(meshes - set(files))]
    return Check(name, float(len(faults)), 0.0, "; ".join(faults))


def _doubled(root: ElementTree.Element) -> Iterator[tuple[str, str]]:
    """Yield the elements of links and joints that have two children of a kind of which one is meant, and that kind."""
    for whole in [*root.findall("link"), *root.findall("joint")]:
        for element in whole.iter():
            tags = [str(child.tag) for child in element]
            several = {tag for tag in tags if tags.count(tag) > 1} - {"visual", "collision"}
            yield from ((whole.get("name", ""), tag) for tag in sorted(several))
            if element.tag == "geometry" and len(tags) > 1:
                yield whole.get("name", ""), "shapes"


def _faults_of_inertials(root: ElementTree.Element) -> list[str]:
    faults = []
    moving = [joint.find("parent") for joint in root.findall("joint") if joint.get("type") != "fixed"]
    carriers = {parent.get("link") for parent in moving if parent is not None}
    for link in root.findall("link"):
        mass, inertia = link.find("inertial/mass"), link.find("inertial/inertia")
        if mass is None or inertia is None:
            faults += [f"{link.get('name')} has no inertial"] * (link.get("name") != WORLD)
            continue
        if not _read(mass, "value") > 0:
            faults.append(f"{link.get('name')} has no positive mass")
        if link.get("name") in carriers and _read(mass, "value") <= DROPPED_MASS:
            faults.append(f"{link.get('name')} is so light that Gazebo drops it with all it carries")
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
        limit, axis = joint.find("limit"), joint.find("axis")
        if axis is not None and not math.isclose(math.hypot(*_numbers(axis, "xyz")), 1.0, rel_tol=1e-6):
            faults.append(f"the axis of {joint.get('name')} is no unit vector, which not all readers make of it")
        if limit is not None and not all(0 < _read(limit, name) < math.inf for name in ("effort", "velocity")):
            faults.append(f"{joint.get('name')} has no positive effort and velocity")
        if joint.get("type") not in ("revolute", "prismatic"):
            continue
        lo, hi = (math.nan if limit is None else _read(limit, end) for end in ("lower", "upper"))
        if not lo < hi:
            faults.append(f"{joint.get('name')} has no limits with lower < upper")
        elif not lo <= 0 <= hi:
            faults.append(f"zero, where readers begin, is outside the limits of {joint.get('name')}")
    return faults


def _numbers(element: ElementTree.Element, attribute: str) -> list[float]:
    try:
        return [float(word) for word in element.get(attribute, "nan").split()]
    except ValueError:
        return [math.nan]


def _read(element: ElementTree.Element, attribute: str) -> float:
    """Return a number of the file, NaN where there is none."""
    try:
        return float(element.get(attribute, "nan"))
    except ValueError:
        return math.nan
