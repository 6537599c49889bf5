"""Whether a bundle keeps its promise: files whole, parts sound and as heavy as simulated, the policy as able."""

import hashlib
import io
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import mujoco
import numpy as np
from manifold3d import Error, Manifold, Mesh64

from morph_core.catalogue import make_task
from morph_core.task import Task
from studio.export import onnx_policy
from studio.export.archive import unpack
from studio.export.check import Check, relative, worst
from studio.export.check_anew import (
    PART_FOLDERS,
    UNLIKE_ALLOWED,
    beyond,
    check_anew,
    check_parts,
    check_program_arrays,
    check_provenance,
    unlike,
)
from studio.export.check_copies import check_archive, check_drives, check_package
from studio.export.check_prints import Surface, check_part_file, check_plates, read_3mf
from studio.export.demand import Recorder
from studio.export.design_file import FILE, Design, PartEntry, phi_for, read_design
from studio.export.meshes import start_posture
from studio.export.plates import PIECES
from studio.export.policy import LAYERS, Score, read_policy, score
from studio.export.provenance import Provenance
from studio.export.readings import collision_box
from studio.export.ros import FOLDER, in_packages
from studio.export.screen import screen
from studio.export.stand import check_standing
from studio.export.urdf import NO_LIMIT, urdf_names
from studio.export.verify import load_model, verify_folder
from studio.export.zero import moved_zero
from studio.robots.chooser import robot_of
from studio.robots.geometry import moments
from studio.robots.parts import BASE, DENSITY, MILLIMETRE, Part, body_of, stl_files

MASS_ALLOWED = 1e-6
"""Relative difference of masses that is allowed: STL and GLB are single precision."""
DOWELS_ALLOWED = 0.1
"""Share of a part's mass that its pieces may miss: the holes for dowels."""
CENTRE_ALLOWED = 0.25
"""Distance of a print's centre of mass from the simulated one that is allowed, as a share of the print's size: that of
a short link of the arm is off by a fifth."""
SINGLE_ALLOWED = 1e-6  # relative to the robot's size
SCENE_ALLOWED = 1e-9
_DYNAMICS = (
    "body_mass", "body_ipos", "body_iquat", "body_inertia", "body_pos", "body_quat", "body_gravcomp", "jnt_type",
    "jnt_pos", "jnt_axis", "jnt_range", "jnt_stiffness", "dof_armature", "dof_damping", "actuator_gainprm",
    "actuator_biasprm", "actuator_forcerange", "actuator_ctrlrange",
)  # fmt: skip
_TOUCH = (
    "geom_size", "geom_pos", "geom_quat", "geom_friction", "geom_bodyid", "geom_type", "geom_contype",
    "geom_conaffinity", "geom_condim", "geom_margin", "geom_gap", "geom_solref", "geom_solimp", "geom_solmix",
    "geom_priority", "geom_rbound",
)  # fmt: skip
"""What makes a shape collide as it does; of a mesh the bounding sphere stands for its corners."""
PROVENANCE = "provenance.json"


def prove(files: Mapping[str, bytes], *, episodes: int, only_mujoco: bool = False) -> list[Check]:
    """Check a bundle's files against one another, and against the robot that its phi makes here.

    Whatever is wrong is a failed check, not an exception.
    """
    checks = [check_digests(files)]
    try:
        design = read_design(files.get(FILE, b""))
        task = make_task(design.task, design.task_options)
        phi = phi_for(design, task.name, task.design_space)
        checks += screen(files, robot_of(task).file_name)
        checks.append(_check_name(design, task))
        if not all(check.passed for check in checks[1:]):
            return checks  # no reader sees what asks for more than a bundle needs
        has_parts = bool(design.parts) or any(path.startswith(PART_FOLDERS) for path in files)
        parts = robot_of(task).parts(phi) if has_parts else []  # to draw them takes long
        checks += _guarded(FILE, lambda: check_parts(files, design, parts))
        checks += _guarded("made anew", lambda: check_anew(files, task, phi, design, parts))
        if PROVENANCE in files:
            checks += _guarded(PROVENANCE, lambda: [check_provenance(files, design, files[PROVENANCE])])
        if {"run_policy.py", "policy.py", "policy.npz"} & files.keys():
            checks += _guarded("run_policy.py", lambda: _check_program(files, task, phi))
        if onnx_policy.FILE in files:
            checks.append(check_onnx(files, task, phi))
        checks += prove_robot(files, design, task, phi, only_mujoco=only_mujoco, drawn=parts)
        if episodes and "policy.npz" in files:
            checks += prove_policy(files, task, phi, _promised(files), episodes)[1]
        elif "scene.xml" in files:
            checks += _guarded("scene.xml in MuJoCo", lambda: [_prove_scene(files, task, phi)])
    except Exception as error:  # whatever is wrong with a stranger's file
        checks.append(Check(FILE, math.inf, 0.0, f"can't be read: {str(error) or type(error).__name__}"))
    return checks


def _check_name(design: Design, task: Task) -> Check:
    """Check that the files are called as those of this robot are: the word becomes part of paths."""
    expected = robot_of(task).file_name
    same = design.robot == expected
    return Check(f"{FILE}: robot", float(not same), 0.0, "" if same else f"{design.robot[:40]!r}, not {expected}")


def _check_program(files: Mapping[str, bytes], task: Task, phi: np.ndarray) -> list[Check]:
    """Compare the program that runs the policy with the one that this version ships."""
    checks, program = [], robot_of(task).program(phi)
    if "policy.npz" in files:
        checks.append(check_program_arrays(files["policy.npz"], program, task.horizon, LAYERS))
    for path, source in program.sources.items():
        if path not in files:
            continue
        same = files[path] == source
        said = "" if same else "not the program that this version ships: read it before you run it"
        checks.append(Check(f"{path}: the program that is shipped", float(not same), 0.0, said))
    return checks


def check_onnx(files: Mapping[str, bytes], task: Task, phi: np.ndarray) -> Check:
    """Compare the actions of policy.onnx with those of policy.npz."""
    name = f"{onnx_policy.FILE}: actions, of the largest"
    if not onnx_policy.is_available():
        return Check(name, 0.0, onnx_policy.ALLOWED, f"not compared: {onnx_policy.MISSING}")
    try:
        policy, program = read_policy(files["policy.npz"]), robot_of(task).program(phi)
        off = onnx_policy.off_from_arrays(files[onnx_policy.FILE], policy, program)
        facts = {"task": task.name, "control_step_s": task.control_dt}
        if others := onnx_policy.other_facts(files[onnx_policy.FILE], program, facts):
            return Check(name, math.inf, onnx_policy.ALLOWED, f"it tells another {', '.join(others)}")
    except Exception as error:  # whatever a reader throws at a broken file is the finding
        return Check(name, math.inf, onnx_policy.ALLOWED, f"can't be compared: {str(error) or type(error).__name__}")
    return Check(name, off, onnx_policy.ALLOWED, f"{onnx_policy.PAIRS} observations")


def prove_robot(
    files: Mapping[str, bytes],
    design: Design,
    task: Task,
    phi: np.ndarray,
    *,
    only_mujoco: bool = False,
    drawn: Sequence[Part] = (),
) -> list[Check]:
    """Compare MJCF, URDF and parts with the robot that phi (d,) makes, and parts with those that are `drawn` of it."""
    robot = robot_of(task)
    model, printed = task.spec(phi).compile(), robot.printed
    moved = moved_zero(task.spec(phi), robot.zero(phi)).compile()  # with the zeros of the files
    with tempfile.TemporaryDirectory() as name:
        folder, load = Path(name), cache(load_model)  # to build a model takes long
        unpack(files, folder)
        checks = verify_folder(
            folder, files, model, robot=design.robot, zero=robot.zero(phi), only_mujoco=only_mujoco, load=load
        )
        if robot.printed:  # what a stranger's robot does without commands is not known
            checks += _guarded("standing", lambda: _check_standing(folder, design.robot, model, load))
    for urdf in [path for path in (f"{design.robot}.urdf", *in_packages(files, design.robot)) if path in files]:
        checks += _guarded(urdf, lambda urdf=urdf: _check_joints(urdf, files[urdf], model, moved, robot.speeds))
    if (archive := f"{design.robot}.mjz") in files:
        checks += _guarded(archive, lambda: [check_archive(files, design.robot)])
    if any(path.startswith(f"{FOLDER}/") for path in files):
        size = float(moved.stat.extent)
        checks += _guarded(FOLDER, lambda: [check_package(files, design.robot, task.name, size)])
    read = cache(lambda path: read_3mf(files[path]))  # a part's file is looked at as a part, and as a plate
    drawings = {part.name: part for part in drawn}
    for part in design.parts:
        checks += _guarded(
            f"part {part.name}",
            lambda part=part: _check_part(files, part, model, printed, read, drawings.get(part.name)),
        )
    if PIECES in files:
        checks += _guarded("plates", lambda: check_plates(files, design.parts, read))
    if "assembly.glb" in files:
        checks += _guarded("assembly.glb", lambda: _check_assembly(files["assembly.glb"], design, model, printed))
    return checks


def _check_standing(
    folder: Path, robot: str, model: mujoco.MjModel, load: Callable[[Path], mujoco.MjModel]
) -> list[Check]:
    """Check that the robot of a `model` stands where each MJCF file of a folder begins."""
    own = {model.body(b).name for b in range(1, model.nbody)}
    checks: list[Check] = []
    for file, bodies in ((f"{robot}.xml", own | {"world"}), ("scene.xml", own)):
        if (folder / file).exists():
            checks += check_standing(file, load(folder / file), bodies)
    return checks


def _check_joints(
    path: str, content: bytes, model: mujoco.MjModel, moved: mujoco.MjModel, speeds: Mapping[str, float]
) -> list[Check]:
    """Compare what a URDF says of its joints, which readers pass over, with what the task asks of them.

    `moved` is the model with the zeros of the files.
    """
    return [
        _check_speeds(path, content, model, speeds),
        _check_frictions(path, content, model),
        check_drives(path, content, moved),
    ]


def _check_speeds(path: str, content: bytes, model: mujoco.MjModel, speeds: Mapping[str, float]) -> Check:
    """Compare the velocity limits of a URDF with what the task asks of the joints."""
    names = urdf_names(model).joints
    expected = {names[j]: speeds.get(model.joint(j).name, NO_LIMIT) for j in range(model.njnt)}
    found = {
        joint.get("name", ""): float(limit.get("velocity", "nan"))
        for joint in ElementTree.fromstring(content).findall("joint")
        if (limit := joint.find("limit")) is not None
    }
    known = {name: speed for name, speed in expected.items() if name in found}  # a free base has no limit
    return worst(f"{path}: speeds", SCENE_ALLOWED, relative(known, found))


def _check_frictions(path: str, content: bytes, model: mujoco.MjModel) -> Check:
    """Compare the frictions of a URDF's joints with those that are simulated."""
    names = urdf_names(model).joints
    expected = {names[j]: float(model.dof_frictionloss[model.jnt_dofadr[j]]) for j in range(model.njnt)}
    found = {
        joint.get("name", ""): float(dynamics.get("friction", "0"))
        for joint in ElementTree.fromstring(content).findall("joint")
        if (dynamics := joint.find("dynamics")) is not None
    }
    return worst(f"{path}: frictions", SCENE_ALLOWED, relative(expected, dict.fromkeys(expected, 0.0) | found))


def prove_policy(
    files: Mapping[str, bytes],
    task: Task,
    phi: np.ndarray,
    promised: list[Score],
    episodes: int,
    recorder: Recorder | None = None,
) -> tuple[Score | None, list[Check]]:
    """Run the policy on the scene read from its file, and compare its success with what is `promised`.

    A `recorder` is shown what the hardware does.
    """
    name = "policy"
    try:
        with tempfile.TemporaryDirectory() as folder:
            unpack(files, Path(folder))
            scene = _as_simulated(mujoco.MjSpec.from_file(str(Path(folder) / "scene.xml")), task, phi)
            reloaded = scene.compile()
            policy, hardware = read_policy(files["policy.npz"]), task.hw_phy_from(scene, phi)
            found = score(task, policy, hardware, episodes, "reloaded", recorder=recorder)
    except Exception as error:  # as with every other file
        return None, [Check(name, math.inf, 0.0, f"can't be run: {error}")]
    checks = [_compare_scenes(task.scene(phi).compile(), reloaded)]
    for other in promised:
        off = abs(other.success - found.success)
        said = (
            f"{found.success:.1%} of {found.episodes} episodes; {other.where}: {other.success:.1%} of {other.episodes}"
        )
        checks.append(Check(f"{name}: success", off, found.allowed(other), said))
    if not promised:
        checks.append(Check(f"{name}: runs", 0.0, 0.0, f"{found.success:.1%} of {found.episodes} episodes"))
    return found, checks


def _prove_scene(files: Mapping[str, bytes], task: Task, phi: np.ndarray) -> Check:
    """Compare the scene of the files with the simulated one, where no policy is run in it."""
    with tempfile.TemporaryDirectory() as folder:
        unpack(files, Path(folder))
        scene = _as_simulated(mujoco.MjSpec.from_file(str(Path(folder) / "scene.xml")), task, phi)
        return _compare_scenes(task.scene(phi).compile(), scene.compile())


def _as_simulated(scene: mujoco.MjSpec, task: Task, phi: np.ndarray) -> mujoco.MjSpec:
    """Return a scene that was read from its file with the zero of the task's joints, and the task's sensors."""
    scene = moved_zero(scene, {name: -value for name, value in robot_of(task).zero(phi).items()})
    known = {sensor.name for sensor in scene.sensors}
    for sensor in task.scene(phi).sensors:
        if sensor.name not in known:
            copied = scene.add_sensor(
                name=sensor.name, type=sensor.type, objtype=sensor.objtype, objname=sensor.objname,
                reftype=sensor.reftype, refname=sensor.refname, intprm=sensor.intprm,
            )  # fmt: skip
            copied.dim = sensor.dim
    return scene


def _compare_scenes(simulated: mujoco.MjModel, reloaded: mujoco.MjModel) -> Check:
    """Compare what moves, and how it is driven; shapes that are only shown were added to the file."""
    name = "scene.xml in MuJoCo: bodies, joints, servos, options"
    off: dict[str, float] = {}
    for field in _DYNAMICS:
        one, other = np.asarray(getattr(simulated, field)), np.asarray(getattr(reloaded, field))
        off[field] = float(np.abs(one - other).max(initial=0.0)) if one.shape == other.shape else math.inf
    off["timestep"] = abs(simulated.opt.timestep - reloaded.opt.timestep)
    types = [{m.sensor(i).name: float(m.sensor_type[i]) for i in range(m.nsensor)} for m in (simulated, reloaded)]
    off["sensors"] = max((abs(kind - types[1].get(name, math.inf)) for name, kind in types[0].items()), default=0.0)
    return worst(name, SCENE_ALLOWED, off | _touching_off(simulated, reloaded))


def _touching_off(simulated: mujoco.MjModel, found: mujoco.MjModel) -> dict[str, float]:
    """Return how far the shapes of two models that can touch others are apart, by what makes them collide."""
    off = {}
    touching = [(m.geom_contype != 0) | (m.geom_conaffinity != 0) for m in (simulated, found)]
    for field in _TOUCH:
        one, other = (getattr(m, field)[t] for m, t in zip((simulated, found), touching, strict=True))
        off[field] = float(np.abs(one - other).max(initial=0.0)) if one.shape == other.shape else math.inf
    return off


def check_digests(files: Mapping[str, bytes]) -> Check:
    """Compare every file with its digest in provenance.json."""
    name = f"{PROVENANCE}: digests"
    try:
        expected = msgspec.json.decode(files.get(PROVENANCE, b""), type=Provenance).sha256
    except (ValueError, RecursionError) as error:
        return Check(name, math.inf, 0.0, f"can't be read: {error}")
    found = {path: hashlib.sha256(content).hexdigest() for path, content in files.items() if path != PROVENANCE}
    wrong = sorted(path for path in found.keys() | expected.keys() if found.get(path) != expected.get(path))
    return Check(
        name, float(len(wrong)), 0.0, f"{len(found)} files" if not wrong else f"differ: {', '.join(wrong[:3])}"
    )


def _promised(files: Mapping[str, bytes]) -> list[Score]:
    try:
        return msgspec.json.decode(files[PROVENANCE], type=Provenance).policy
    except (KeyError, ValueError, RecursionError):
        return []


def _guarded(name: str, check: Callable[[], list[Check]]) -> list[Check]:
    try:
        return check()
    except Exception as error:  # whatever a reader throws at a broken file is the finding
        return [Check(name, math.inf, 0.0, f"can't be read: {error}")]


def _check_part(
    files: Mapping[str, bytes],
    part: PartEntry,
    model: mujoco.MjModel,
    printed: bool,
    read: Callable[[str], Any],
    drawing: Part | None,
) -> list[Check]:
    """Check the files of a part; one that is `printed` is one body, and as heavy as the link."""
    checks: list[Check] = []
    surfaces: dict[str, Surface] = {}
    stl, three_mf = f"parts/{part.name}.stl", f"3mf/{part.name}.3mf"
    if stl in files:
        import trimesh

        mesh = trimesh.load_mesh(io.BytesIO(files[stl]), file_type="stl")
        surfaces[stl] = np.asarray(mesh.vertices) * MILLIMETRE, np.asarray(mesh.faces)
    if three_mf in files:
        bodies, check = check_part_file(three_mf, read(three_mf), part)
        surfaces |= bodies
        checks.append(check)
    pieces = [surface for path, surface in surfaces.items() if path not in (stl, three_mf)]
    if pieces and printed:
        missing = 1 - sum(moments(*piece).inertial(part.density).mass for piece in pieces) / part.mass
        checks.append(Check(f"{three_mf}: mass that its pieces miss", abs(missing), DOWELS_ALLOWED))
    if drawing:
        checks += _check_drawn(files, surfaces, drawing, {stl, three_mf})
    for path, surface in surfaces.items():
        checks.append(_check_solid(path, surface, one_body=printed))
        if not len(surface[1]):
            continue
        for link in part.links:
            if link != BASE:
                whole = path in (stl, three_mf)
                checks += _check_mass(path, surface, part.density, model, link) if printed and whole else []
                checks += _check_enclosed(path, surface, model, link)
    return checks


def _check_drawn(
    files: Mapping[str, bytes], surfaces: Mapping[str, Surface], drawing: Part, whole: set[str]
) -> list[Check]:
    """Compare surfaces with the drawing of their part: those that are `whole` are it, the others lie in it."""
    same = {path for path, content in stl_files([drawing]).items() if files.get(path) == content}
    off = {path: (unlike if path in whole else beyond)(surface, drawing)
           for path, surface in surfaces.items() if path not in same}  # fmt: skip
    return [
        Check(f"{path}: as it is drawn (share of its volume)", share, UNLIKE_ALLOWED) for path, share in off.items()
    ]


def _check_solid(path: str, surface: Surface, one_body: bool) -> Check:
    """Check that a surface is watertight, outside out, and one body where it must be."""
    import trimesh

    name = f"{path}: watertight, a volume" + (", one body" if one_body else "")
    mesh = trimesh.Trimesh(*surface, process=False)
    body = Manifold(Mesh64(surface[0], surface[1].astype(np.uint64)))
    if not len(surface[1]):
        return Check(name, math.inf, 0.0, "it is empty")
    faults = [
        said
        for fault, said in (
            (not mesh.is_watertight, "not watertight"),
            (not mesh.is_volume, "no volume"),
            (body.status() != Error.NoError, f"no solid ({body.status().name})"),
            (one_body and len(body.decompose()) != 1, f"{len(body.decompose())} bodies"),
        )
        if fault
    ]
    return Check(name, float(len(faults)), 0.0, "; ".join(faults))


def _check_mass(path: str, surface: Surface, density: float, model: mujoco.MjModel, link: str) -> list[Check]:
    """Compare the mass of a printed part with that of the body that is simulated, and how it is spread about."""
    body = body_of(model, link)
    printed = moments(*surface).inertial(density)
    mass = float(model.body_mass[body])
    off_centre = np.abs(printed.com - model.body_ipos[body]).max() / np.ptp(surface[0], axis=0).max()
    return [
        Check(f"{path}: mass of {link}", abs(printed.mass - mass) / mass, MASS_ALLOWED),
        Check(f"{path}: density", density, DENSITY),
        Check(f"{path}: centre of mass of {link}", float(off_centre), CENTRE_ALLOWED),
    ]


def _check_enclosed(path: str, surface: Surface, model: mujoco.MjModel, link: str) -> list[Check]:
    """Check that a part is inside the box round its link's collision shapes."""
    body = body_of(model, link)
    box = collision_box(model, body)
    forks = int((model.body_parentid[1:] == body).sum()) > 1  # a palm's mounts are enclosed by the fingers' ends
    if box is None or forks:
        return []
    out = max((box[0] - surface[0].min(0)).max(), (surface[0].max(0) - box[1]).max(), 0.0)
    return [Check(f"{path}: inside the collision shapes of {link} (m)", float(out), SINGLE_ALLOWED)]


def _check_assembly(content: bytes, design: Design, model: mujoco.MjModel, printed: bool) -> list[Check]:
    """Check that each link's node stands where the link does at the start, and is as heavy as a `printed` part."""
    import trimesh

    scene = trimesh.load_scene(io.BytesIO(content), file_type="glb")
    data = start_posture(model)
    down = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # from y up to z up
    size = float(scene.extents.max())
    places: dict[str, float] = {}
    turns: dict[str, float] = {}
    masses: dict[str, float] = {}
    for part in design.parts:
        for link in part.links:
            body = body_of(model, link)
            pose, geometry = scene.graph[link]
            places[link] = float(np.abs(down @ pose[:3, 3] - data.xpos[body]).max()) / size
            turns[link] = float(np.abs(down @ pose[:3, :3] - data.xmat[body].reshape(3, 3)).max())
            if not printed:
                continue
            mesh = scene.geometry[geometry].copy()
            mesh.merge_vertices(merge_norm=True, merge_tex=True)
            mass = moments(np.asarray(mesh.vertices), np.asarray(mesh.faces)).inertial(part.density).mass
            masses[link] = abs(mass - part.mass) / part.mass
    positions = worst("assembly.glb: positions of the links", SINGLE_ALLOWED, places)
    turned = worst("assembly.glb: how the links are turned", SINGLE_ALLOWED, turns)
    return [positions, turned, *[worst("assembly.glb: masses", MASS_ALLOWED, masses)] * printed]
