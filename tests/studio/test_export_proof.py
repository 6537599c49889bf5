"""A bundle proves that it is one robot: for any design, read again from its files; and a broken one is found out."""

import hashlib
import importlib
import importlib.util
import io
import itertools
import json
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest
import trimesh
from conftest import FEW, design_of, make_hand_run
from safetensors.numpy import save_file
from trimesh.exchange.gltf import export_glb

from morph_core.catalogue import TASKS, make_task
from morph_core.history import History
from morph_core.task import Task
from studio.export.archive import unzipped, zipped
from studio.export.bundle import EPISODES, FORMATS, Bundle, build_bundle, parts_of_design, robot_files
from studio.export.design_file import Design, PartEntry, load_design, phi_for, read_design, starting_from
from studio.export.errors import ExportError
from studio.export.meshes import Body, Shape, three_mf
from studio.export.plates import plan_prints, print_files
from studio.export.policy import Policy, Score
from studio.export.printers import DEFAULT
from studio.export.proof import check_digests, prove, prove_robot, unpack
from studio.export.provenance import Provenance
from studio.export.servos import ServoTable
from studio.export.trial import Runner, Trial
from studio.export.urdf import urdf_names
from studio.export.zero import zero_of
from studio.new_run import StartRun
from studio.robots.chooser import robot_of
from studio.robots.parts import Part
from studio.robots.stl import stl
from tests.counts import DESIGNS
from tests.forked import morph_studio

NAME = "<b>run \N{SNOWMAN} .." + "x" * 120


def random_design(task: Task, rng: np.random.Generator) -> np.ndarray:
    """Return a design (d,) inside the box, often on its faces, that can be assembled."""
    space = task.design_space
    while True:
        phi = rng.uniform(space.lo, space.hi)
        phi = np.where(rng.random(len(phi)) < 0.3, rng.choice([space.lo, space.hi]), phi)
        if task.buildable(phi):
            return phi


def corners(task: Task) -> list[np.ndarray]:
    space = task.design_space
    lengths = np.array([p.unit == "m" for p in space.parameters])
    return [np.where(lengths, space.lo, space.lo), np.where(lengths, space.hi, space.lo), space.hi]


def designs_with_corners(task: Task, count: int, seed: int) -> list[np.ndarray]:
    """Return so many designs (d,) that can be assembled: the corners of the box, and random ones."""
    rng = np.random.default_rng(seed)
    chosen = [phi for phi in corners(task) if task.buildable(phi)][:count]
    return chosen + [random_design(task, rng) for _ in range(count - len(chosen))]


def faults_of(task: Task, phi: np.ndarray) -> list[str]:
    """Return where the files of a design differ from the robot that is simulated, whoever reads them."""
    parts, robot = robot_of(task).parts(phi), robot_of(task).file_name
    model = task.spec(phi).compile()
    files = robot_files(task, phi, parts, FORMATS) | print_files(plan_prints(parts, DEFAULT, model))
    checks = prove_robot(files, design_in(task, parts), task, phi)
    faults = [str(check) for check in checks if not check.passed]
    zero = zero_of(model, robot_of(task).zero(phi))
    with tempfile.TemporaryDirectory() as folder:
        unpack(files, Path(folder))
        urdf = Path(folder) / f"{robot}.urdf"
        return faults + faults_in_pinocchio(urdf, model, zero) + faults_in_pybullet(urdf, model, zero)


def design_in(task: Task, parts: Sequence[Part]) -> Design:
    """Return a design of a task as a bundle has it, as far as its robot is concerned."""
    return Design(
        task=task.name, task_options={}, robot=robot_of(task).file_name, run="", design="", iteration=0, parameters=[],
        parts=[PartEntry(part.name, list(part.links), part.inertial.mass, part.density) for part in parts],
    )  # fmt: skip


def faults_in_pinocchio(urdf: Path, model: mujoco.MjModel, zero: np.ndarray) -> list[str]:
    """Compare the URDF as pinocchio reads it: masses, limits from `zero`, and places in random postures."""
    if not (pinocchio := optional("pinocchio")):
        return []
    robot = pinocchio.buildModelFromUrdf(str(urdf))
    for kind in (pinocchio.GeometryType.VISUAL, pinocchio.GeometryType.COLLISION):
        pinocchio.buildGeomFromUrdf(robot, str(urdf), kind, pinocchio.GeometryModel(), str(urdf.parent))
    data, state, rng = robot.createData(), mujoco.MjData(model), np.random.default_rng(1)
    neutral, names = pinocchio.neutral(robot), urdf_names(model).joints
    faults = ["pinocchio: neutral is not allowed"] * bool(
        np.any((neutral < robot.lowerPositionLimit) | (neutral > robot.upperPositionLimit))
    )
    if abs(pinocchio.computeTotalMass(robot) / model.body_mass.sum() - 1) > 1e-9:
        faults.append("pinocchio: mass")
    for _ in range(10):
        q = pinocchio.neutral(robot)
        for j in range(model.njnt):
            lo, hi = model.jnt_range[j] if model.jnt_limited[j] else (-3.0, 3.0)
            state.qpos[j] = rng.uniform(lo, hi)
            joint = robot.joints[robot.getJointId(names[j])]
            bounded = joint.nq == 1
            place = slice(joint.idx_q, joint.idx_q + joint.nq)
            value = state.qpos[j] - zero[j]
            q[place] = value if bounded else [np.cos(value), np.sin(value)]
            limits = robot.lowerPositionLimit[joint.idx_q], robot.upperPositionLimit[joint.idx_q]
            if bounded and limits != (lo - zero[j], hi - zero[j]):
                faults.append(f"pinocchio: limits of {model.joint(j).name}")
        mujoco.mj_kinematics(model, state)
        pinocchio.framesForwardKinematics(robot, data, q)
        for body in range(1, model.nbody):
            place = data.oMf[robot.getFrameId(model.body(body).name)].translation  # no other frame has this name
            if np.abs(place - state.xpos[body]).max() > 1e-9:
                faults.append(f"pinocchio: place of {model.body(body).name}")
    return faults


def faults_in_pybullet(urdf: Path, model: mujoco.MjModel, zero: np.ndarray) -> list[str]:
    """Compare the URDF as pybullet reads it, which keeps limits and masses but moves in single precision."""
    if not (pybullet := optional("pybullet")):
        return []
    client = pybullet.connect(pybullet.DIRECT)
    faults = []
    try:
        robot = pybullet.loadURDF(str(urdf), physicsClientId=client)
        if robot < 0:
            return ["pybullet: can't load it"]
        if pybullet.getDynamicsInfo(robot, -1, client)[0] != 0:
            faults.append("pybullet: its base falls")
        for joint in range(pybullet.getNumJoints(robot, client)):
            info = pybullet.getJointInfo(robot, joint, client)
            link = info[12].decode()
            if info[2] == pybullet.JOINT_FIXED:
                continue
            mass = pybullet.getDynamicsInfo(robot, joint, client)[0]
            if abs(mass / model.body(link).mass[0] - 1) > 1e-6:
                faults.append(f"pybullet: mass of {link}")
            j = urdf_names(model).joints.index(info[1].decode())
            if model.jnt_limited[j] and not np.allclose(info[8:10], model.jnt_range[j] - zero[j], atol=1e-6):
                faults.append(f"pybullet: limits of {link}")
    finally:
        pybullet.disconnect(client)
    return faults


def optional(name: str) -> Any:
    """Return a module of the extra `readers`, or None where it is not installed; the merge check has all of them."""
    if importlib.util.find_spec(name) is None:
        assert "CI" not in os.environ, f'{name} is missing: pip install -e ".[test,readers]"'
        return None
    return importlib.import_module(name)


@pytest.mark.parametrize("name", sorted(TASKS))
def test_every_file_of_a_corner_design_is_the_robot_that_is_simulated(name: str) -> None:
    task = make_task(name)
    for phi in corners(task):
        assert faults_of(task, phi) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TASKS))
def test_every_file_of_many_designs_is_the_robot_that_is_simulated(name: str) -> None:
    task, rng = make_task(name), np.random.default_rng(0)
    for _ in range(DESIGNS):
        phi = random_design(task, rng)
        assert faults_of(task, phi) == [], phi


def test_a_hand_with_pockets_for_servos_is_one_robot_too() -> None:
    task = make_task("mouse_click", {"servo": "mg90s"})
    phi = task.design_space.initial
    assert faults_of(task, phi) == []
    plain = make_task("mouse_click")
    assert task.spec(phi).compile().body("palm").mass[0] < plain.spec(phi).compile().body("palm").mass[0]
    phi[1] = -0.6  # finger 2 beside finger 1: there is room for it, but not for its servo
    assert plain.buildable(phi)
    assert not task.buildable(phi)
    with pytest.raises(ExportError, match=r"fingers 1 and 2 stand 38\.7 mm apart on the palm, 44\.5 mm are needed"):
        parts_of_design(robot_of(task), phi)


def test_a_hand_that_cannot_be_assembled_is_refused_with_the_reason() -> None:
    task = make_task("pen_press")
    phi = task.design_space.initial
    phi[1] = -np.pi / 2 + 0.1  # finger 2 beside finger 1
    with pytest.raises(ExportError, match=r"fingers 1 and 2 stand 6 mm apart on the palm, 30 mm are needed"):
        parts_of_design(robot_of(task), phi)


def test_equal_links_are_one_part_with_a_quantity() -> None:
    task = make_task("pen_press")
    parts = {part.name: part for part in robot_of(task).parts(task.design_space.initial)}
    assert set(parts) == {"palm", "finger_1_proximal", "finger_1_distal"}
    assert parts["finger_1_distal"].links == tuple(f"finger_{i}_distal" for i in range(1, 5))


# --- a run's bundle ---


def add_policy(history: History, task: Task, iteration: int, scale: float = 0.3) -> None:
    """Put a checkpoint with a policy into the run."""
    rng = np.random.default_rng(0)
    sizes = [task.observation_size, 16, 16, task.action_size]
    tensors = {"policy/log_std": np.full(task.action_size, -1.0, np.float32)}
    for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        tensors[f"policy/mean.{2 * i}.weight"] = (scale * rng.standard_normal((outputs, inputs))).astype(np.float32)
        tensors[f"policy/mean.{2 * i}.bias"] = np.zeros(outputs, np.float32)
    path = history.folder.checkpoint(iteration)
    path.mkdir(parents=True)
    save_file(tensors, path / "weights.safetensors")
    (path / "state.json").write_text("{}")


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> History:
    """A run of a pen hand, with a policy and a hostile name."""
    folder = make_hand_run(tmp_path_factory.mktemp("runs"), "pen_press")
    folder.path.rename(folder.path.with_name(NAME))
    history = History(type(folder)(folder.path.with_name(NAME)))
    add_policy(history, make_task("pen_press"), 0)  # of an earlier iteration: its success was never measured
    return history


@pytest.fixture(scope="module")
def bundle(history: History) -> Bundle:
    """The bundle of that run."""
    return build_bundle(history, "best")


def test_a_bundle_holds_what_the_bench_needs(bundle: Bundle) -> None:
    links = [f"finger_{i}_{part}" for i in (1, 2) for part in ("proximal", "distal")]  # 2 = 3 = 4
    assert set(bundle.files) == {
        "hand.xml", "hand.mjz", "scene.xml", "hand.urdf", "control.json", "assembly.glb", "policy.npz", "run_policy.py",
        "policy.onnx", "policy.py", "design.json", "provenance.json", "BOM.csv", "report.html", "LICENSE", "README.txt",
        "servos.json",
        *(f"{folder}/{part}.{ending}" for folder, ending in (("parts", "stl"), ("3mf", "3mf"))
          for part in ("palm", *links)),
        *(f"plates/plate_{number}.{ending}" for number in (1, 2) for ending in ("3mf", "svg")),
        "plates/pieces.csv", "plates/joints.csv",
    }  # fmt: skip
    assert all(check.passed for check in prove(bundle.files, episodes=4))
    rows = bundle.files["BOM.csv"].decode().splitlines()
    assert any(row.startswith("finger_2_distal,3,finger_2_distal finger_3_distal finger_4_distal,") for row in rows)
    assert any(row.startswith("dowel pin 4 x 28 mm,8") for row in rows)
    assert (
        b"The prints follow the collision shapes: they reach out of them by at most 0.00 mm"
        in bundle.files["report.html"]
    )
    control = json.loads(bundle.files["control.json"])
    joint = control["joints"]["finger_1_distal_joint"]
    assert joint["zero"] == 0.25
    targets = pytest.approx([-0.6 - 0.25, 2.2 - 0.25])
    assert joint["servos"] == [{"kp": 8.0, "kd": 0.6, "max_force": 4.0, "targets": targets}]
    assert "MuJoCo 3.2 and newer read the .xml files" in bundle.files["README.txt"].decode()
    assert json.loads(bundle.files["provenance.json"])["oldest_mujoco"] == "3.2"
    assert joint["armature"] == 0.01


def servos_of(bundle: Bundle) -> ServoTable:
    return msgspec.json.decode(bundle.files["servos.json"], type=ServoTable)


def test_a_bundle_says_which_servo_can_do_what_the_policy_needs(bundle: Bundle) -> None:
    table = servos_of(bundle)
    assert (table.episodes, table.instants) == (FEW, FEW * 40 * 10)  # control steps, and 10 ms steps of each
    assert EPISODES == 256  # what everybody else is given
    assert [row.joint for row in table.joints] == [
        f"finger_{i}_{link}" for i in range(1, 5) for link in ("proximal", "distal")
    ]
    assert [(row.joint, row.unit) for row in table.others] == [("palm", "N")]
    for row in table.joints:
        assert 0 < row.torque_95 <= row.torque_peak <= 4.0 + 1e-9  # what the hand's drives were given
        assert 0 < row.speed_95 <= row.speed_peak
    assert f"<td>servo {table.servo}<" in bundle.files["report.html"].decode()
    assert f"\nservo {table.servo},8," in bundle.files["BOM.csv"].decode()
    assert f"Servos:  {table.servo} suffices for " in bundle.files["README.txt"].decode()


def test_a_servo_that_is_too_weak_is_compared_when_it_is_asked_for_by_whatever_process_runs_the_episodes(
    history: History, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("studio.export.bundle.EPISODES", 3)
    weak = build_bundle(history, "best", ["mjcf"], servo="mg90s")
    monkeypatch.setattr("studio.export.trial.APART", 3)
    apart = build_bundle(history, "best", ["mjcf"], servo="mg90s")
    assert {path for path in weak.files if apart.files[path] != weak.files[path]} <= {"provenance.json"}  # its date
    assert apart.checks == weak.checks
    table = servos_of(weak)
    assert (table.servo, table.episodes, table.suffices) == ("MG90S", 3, False)
    assert "does not suffice: peak torque" in weak.files["report.html"].decode()
    with pytest.raises(ExportError, match="choose the format mjcf"):
        build_bundle(history, "best", ["urdf"], servo="MG90S")
    with pytest.raises(ExportError, match="did you mean MG90S"):
        build_bundle(history, "best", ["mjcf"], servo="MG90")


def test_a_process_that_can_not_run_the_episodes_is_a_failed_check_that_says_why(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    stuck = tmp_path / "stuck"
    stuck.write_text("#!/bin/sh\nexec sleep 60\n")
    stuck.chmod(0o755)
    for program, why, patience in (
        (sys.executable, "choose from: reacher", 60.0),
        ("false", "its process ended without a word", 60.0),
        (str(stuck), "took more than 0.2 s", 0.2),
    ):
        monkeypatch.setattr(sys, "executable", program)
        monkeypatch.setattr("studio.export.trial.PATIENCE", patience)
        with Runner(apart=True) as runner:
            runner.begin(Trial({}, "no such task", {}, [], [], None, 1))
            [check] = runner.outcome().checks
        assert not check.passed
        assert why in str(check)


def test_the_report_escapes_names_and_loads_nothing_from_elsewhere(bundle: Bundle) -> None:
    page = bundle.files["report.html"].decode()
    assert "&lt;b&gt;run" in page
    assert "<b>run" not in page
    assert 'src="http' not in page
    assert "data:image/png;base64," in page
    assert "lifted 75\N{NO-BREAK SPACE}%" in page
    for heading in ("Printed and simulated", "Print it", "Servos", "Bill of materials"):
        assert f"<h2>{heading}</h2>" in page
    assert "The prints follow the collision shapes: they reach out of them by at most" in page


def test_a_bundle_name_is_plain_whatever_the_run_is_called(bundle: Bundle) -> None:
    assert bundle.name.isascii()
    assert bundle.name.endswith("-best-000001.zip")
    assert len(bundle.name) < 130


def test_the_policy_runs_with_numpy_and_mujoco_alone(bundle: Bundle, tmp_path: Path) -> None:
    for path, content in bundle.files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(content)
    code = (
        "import runpy, sys; sys.path.insert(0, '.'); before = {*sys.modules};"
        "runpy.run_path('run_policy.py', run_name='__main__');"
        "loaded = {m.split('.')[0] for m in {*sys.modules} - before};"
        "sys.exit(len(loaded & {'morph_core', 'studio', 'torch', 'trimesh'}))"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("object at [")


def test_the_exported_observation_is_the_tasks_own() -> None:
    task = make_task("pen_press")
    assert task.observation_units is not None
    middle, spread = task.observation_units
    rng = np.random.default_rng(0)
    s = task.reset(task.hw_phy(task.design_space.initial), 20, rng)
    s += 0.1 * np.abs(rng.standard_normal(s.shape))
    np.testing.assert_array_equal(task.observe(s), ((s[:, : len(middle)] - middle) / spread).astype(np.float32))


def test_chance_alone_may_part_two_measurements_and_no_more() -> None:
    assert Score(32, 0.9).allowed(Score(128, 0.9)) == pytest.approx(0.2, abs=0.04)
    assert Score(128, 0.0).allowed(Score(128, 0.0)) < 0.05


def test_a_policy_is_its_mean_where_nothing_is_drawn() -> None:
    policy = Policy([np.eye(2)] * 3, [np.zeros(2)] * 3, np.ones(2), 0)
    np.testing.assert_allclose(policy.act(np.array([[0.1, -0.2]]), None), np.tanh(np.tanh([[0.1, -0.2]])))


# --- what is broken is found out ---


def holed(content: bytes) -> bytes:
    """Return an STL without its first triangle."""
    return content[:80] + (int.from_bytes(content[80:84], "little") - 1).to_bytes(4, "little") + content[134:]


def larger(content: bytes) -> bytes:
    mesh = trimesh.load_mesh(io.BytesIO(content), file_type="stl")
    return stl(np.asarray(mesh.vertices) * 1.001, np.asarray(mesh.faces), "")


def doubled(content: bytes) -> bytes:
    mesh = trimesh.load_mesh(io.BytesIO(content), file_type="stl")
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return stl(np.concatenate([vertices, np.add(vertices, 500)]), np.concatenate([faces, faces + len(vertices)]), "")


def replaced(before: str, after: str) -> Callable[[bytes], bytes]:
    def replace(content: bytes) -> bytes:
        assert before in content.decode()
        return content.decode().replace(before, after, 1).encode()

    return replace


def in_inches(content: bytes) -> bytes:
    files = unzipped(content)
    return zipped(files | {"3D/3dmodel.model": replaced("millimeter", "inch")(files["3D/3dmodel.model"])})


def without_a_copy(content: bytes) -> bytes:
    files = unzipped(content)
    text = files["3D/3dmodel.model"].decode()
    copy = text[text.index("<item ") : text.index("/>", text.index("<item ")) + 2]
    return zipped(files | {"3D/3dmodel.model": text.replace(copy, "", 1).encode()})


def with_a_second_object(_: bytes) -> bytes:
    cube = trimesh.creation.box((10, 10, 10))
    body = Body("palm", Shape(np.asarray(cube.vertices), np.asarray(cube.faces)), [np.eye(3, 4)])
    files = unzipped(three_mf("palm", "", [body]))
    text = files["3D/3dmodel.model"].decode()
    thing = text[text.index("<object ") : text.index("</object>") + len("</object>")]
    text = text.replace(thing, thing + thing.replace('id="1"', 'id="2"')).replace(
        "<build>", '<build><item objectid="2"/>'
    )
    return zipped(files | {"3D/3dmodel.model": text.encode()})


def moved_item(by: str) -> Callable[[bytes], bytes]:
    """Return a breaking of a 3MF: its first item lies elsewhere."""

    def move(content: bytes) -> bytes:
        files = unzipped(content)
        text = files["3D/3dmodel.model"].decode()
        where = re.search(r'transform="((?:\S+ ){9})[^"]+"', text)
        assert where
        text = text.replace(where[0], f'transform="{where[1]}{by}"', 1)
        return zipped(files | {"3D/3dmodel.model": text.encode()})

    return move


def stretched(content: bytes) -> bytes:
    """Break a 3MF: all of its items are a tenth wider than they should be."""
    files = unzipped(content)
    text = files["3D/3dmodel.model"].decode()

    def wider(match: re.Match[str]) -> str:
        turn = [1.1 * float(number) for number in match[1].split()]
        return f'transform="{" ".join(map(repr, turn))} {match[2]}"'

    text = re.sub(r'transform="((?:\S+ ){9})([^"]+)"', wider, text)
    return zipped(files | {"3D/3dmodel.model": text.encode()})


def with_another_corner(content: bytes) -> bytes:
    """Break a 3MF: the first corner of its first body is a hundredth of a millimetre higher."""
    files = unzipped(content)
    text = files["3D/3dmodel.model"].decode()
    text = re.sub(r' z="([^"]+)"', lambda match: f' z="{float(match[1]) + 0.01}"', text, count=1)
    return zipped(files | {"3D/3dmodel.model": text.encode()})


def mirrored(content: bytes) -> bytes:
    """Break an STL: as heavy as before, and inside of the same shapes."""
    mesh = trimesh.load_mesh(io.BytesIO(content), file_type="stl")
    return stl(np.asarray(mesh.vertices) * [-1, 1, 1], np.asarray(mesh.faces)[:, ::-1], "")


def with_another_half(content: bytes) -> bytes:
    """Break a 3MF: its bodies are mirrored."""
    files = unzipped(content)
    text = files["3D/3dmodel.model"].decode()
    text = re.sub(r' x="([^"]+)"', lambda match: f' x="{-float(match[1])!r}"', text)
    text = re.sub(r'v1="(\d+)" v2="(\d+)"', r'v1="\2" v2="\1"', text)
    return zipped(files | {"3D/3dmodel.model": text.encode()})


def with_another_array(name: str) -> Callable[[bytes], bytes]:
    """Return a breaking of a policy.npz: the policy stays, what its program is told of an array does not."""

    def change(content: bytes) -> bytes:
        with np.load(io.BytesIO(content)) as file:
            arrays = dict(file)
        buffer = io.BytesIO()
        np.savez(buffer, **{**arrays, name: 1.01 * arrays[name]})
        return buffer.getvalue()

    return change


def replaced_bytes(before: bytes, after: bytes) -> Callable[[bytes], bytes]:
    def replace(content: bytes) -> bytes:
        assert before in content
        return content.replace(before, after, 1)

    return replace


def with_a_turned_node(content: bytes) -> bytes:
    """Break a GLB: a link is turned where it stands."""
    scene = trimesh.load_scene(io.BytesIO(content), file_type="glb")
    pose = scene.graph["finger_1_distal"][0] @ trimesh.transformations.rotation_matrix(0.1, [1, 0, 0])
    scene.graph.update("finger_1_distal", matrix=pose)
    return export_glb(scene)


def in_another_size(content: bytes) -> bytes:
    """Break the table of pieces: the palm is a millimetre longer than it is."""
    return re.sub(rb"(palm,1,1,)([\d.]+)", lambda m: m[1] + b"%.1f" % (float(m[2]) + 1), content, count=1)


BREAKS = {
    "one of each": [
        ("plates/plate_1.3mf", moved_item("-20 90 20"), "plates/plate_1.3mf: inside the printer"),
        ("3mf/finger_1_distal.3mf", moved_item("0 0 -50"), "3mf/finger_1_distal.3mf: lies on the bed"),
        ("3mf/palm.3mf", in_inches, "3mf/palm.3mf: quantity, name and unit"),
        ("3mf/finger_2_distal.3mf", without_a_copy, "3mf/finger_2_distal.3mf: quantity"),
        ("parts/palm.stl", holed, "parts/palm.stl: watertight"),
        ("parts/finger_1_distal.stl", larger, "parts/finger_1_distal.stl: mass"),
        ("hand.xml", replaced('range="-2.35 0.25"', 'range="-2.35 0.35"'), "hand.xml in MuJoCo: joint limits"),
        ("hand.urdf", replaced('xyz="0.0 0.0 -', 'xyz="0.0 0.00001 -'), "hand.urdf in MuJoCo"),
        ("scene.xml", replaced('timestep="0.01"', 'timestep="0.02"'), "scene.xml in MuJoCo: bodies"),
        ("assembly.glb", lambda content: content[:400], "assembly.glb"),
        ("policy.onnx", lambda content: content[:-40], "policy.onnx: actions"),
        ("README.txt", lambda content: content + b"!", "provenance.json: digests"),
    ],
    "another of some": [
        ("plates/plate_1.3mf", moved_item("128 128 6"), "plates/plate_1.3mf: none over another"),
        ("3mf/palm.3mf", with_a_second_object, "3mf/palm.3mf: quantity"),
        ("parts/finger_1_distal.stl", doubled, "one body"),
        ("hand.xml", replaced('size="0.015 ', 'size="0.016 '), "hand.xml in MuJoCo: collision extents"),
        ("hand.urdf", replaced('<cylinder radius="0.015"', '<cylinder radius="0.0149"'), "MuJoCo: collision extents"),
        ("policy.py", lambda content: content + b"#", "policy.py: the program"),
        ("parts/palm.stl", mirrored, "parts/palm.stl: as it is drawn"),
        ("3mf/finger_1_proximal.3mf", with_another_half, "3mf/finger_1_proximal.3mf: as it is drawn"),
        ("policy.npz", with_another_array("spread"), "policy.npz: what the program is told"),
        ("policy.onnx", replaced_bytes(b"control_step_s\x12\x030.1", b"control_step_s\x12\x030.2"), "policy.onnx"),
        ("provenance.json", replaced('"task": "pen_press"', '"task": "reacher"'), "provenance.json: of this design"),
        ("assembly.glb", with_a_turned_node, "assembly.glb: how the links are turned"),
        ("plates/pieces.csv", in_another_size, "plates/pieces.csv: sizes"),
    ],
    "a third of some": [
        ("plates/plate_1.3mf", with_another_corner, "plates/plate_1.3mf: bodies as in their own files"),
        ("3mf/palm.3mf", stretched, "3mf/palm.3mf: turned and moved alone"),
    ],
    "a plate with too little": [
        ("plates/plate_1.3mf", without_a_copy, "plates: each piece as often as needed"),
        ("parts/finger_1_distal.stl", lambda _: b"", "parts/finger_1_distal.stl"),
    ],
    "another piece": [
        ("plates/pieces.csv", replaced("finger_1_distal", "finger_9_distal"), "plates: each piece as often as needed"),
        ("design.json", replaced('"density": ', '"density": 1'), "design.json: parts"),
        ("hand.xml", replaced('scale="0.001 0.001 0.001"', 'scale="0.001 0.001 0.002"'), "hand.xml: physics options"),
        ("hand.urdf", replaced('scale="0.001 0.001 0.001"', 'scale="0.001 0.001 0.002"'), "hand.urdf: what is shown"),
    ],
    "no pieces": [("plates/pieces.csv", lambda _: b"", "plates")],
    "another design": [("design.json", replaced('"value": 0.1,', '"value": 0.2,'), "positions")],
    "archives cut short": [  # they are refused before anything is read
        ("3mf/palm.3mf", lambda content: content[:400], "3mf/palm.3mf"),
        ("hand.mjz", lambda content: content[:-40], "hand.mjz"),
        ("policy.npz", lambda content: content[:200], "policy"),
    ],
}  # fmt: skip
"""Files, how they are broken, and the findings; those of one round aren't compared with one another."""


@pytest.mark.parametrize("breaks", BREAKS.values(), ids=BREAKS)
def test_files_broken_on_purpose_are_found_out(
    bundle: Bundle, breaks: list[tuple[str, Callable[[bytes], bytes], str]]
) -> None:
    files = {**bundle.files, **{path: spoil(bundle.files[path]) for path, spoil, _ in breaks}}
    faults = [check.name for check in prove(files, episodes=1) if not check.passed]
    for path, _, finding in breaks:
        assert any(finding in fault for fault in faults), (path, faults)
    assert "provenance.json: digests" in faults


def test_a_file_that_is_gone_and_one_that_nobody_named_are_told() -> None:
    provenance = msgspec.json.encode(
        Provenance(
            run="r", iteration=1, task="t", task_options={}, method="m", seed=0, config={}, versions={},
            export_versions={}, git_revision=None, git_dirty=None, parent=None, created=0.0, commands=[],
            commands_sha256="", sha256={"a.xml": hashlib.sha256(b"a").hexdigest()}, checks=[], exported="",
        )
    )  # fmt: skip
    assert check_digests({"provenance.json": provenance, "a.xml": b"a"}).passed
    for files, name in (({}, "a.xml"), ({"a.xml": b"b"}, "a.xml"), ({"a.xml": b"a", "b.xml": b""}, "b.xml")):
        check = check_digests({"provenance.json": provenance, **files})
        assert not check.passed
        assert name in check.detail


@pytest.mark.slow
def test_verify_prints_a_table_and_fails_for_a_part_broken_on_purpose(bundle: Bundle, tmp_path: Path) -> None:
    good, bad = tmp_path / "good.zip", tmp_path / "bad.zip"
    good.write_bytes(bundle.content)
    bad.write_bytes(zipped({**bundle.files, "parts/palm.stl": holed(bundle.files["parts/palm.stl"])}))
    shown = {}
    for path, code in ((good, 0), (bad, 1), (tmp_path / "none.zip", 2)):
        done = morph_studio("verify", str(path), "--episodes", "2", environment={"COLUMNS": "140", "PATH": ""})
        assert done.returncode == code, done.stdout + done.stderr
        shown[code] = done.stdout
    assert "checks agree" in shown[0]
    assert "FAILS" in shown[1]
    assert "not watertight" in shown[1]


def test_an_export_with_a_broken_part_is_not_offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    history = History(make_hand_run(tmp_path, "pen_press"))
    monkeypatch.setattr("studio.robots.parts.stl", lambda v, f, title: holed(stl(v, f, title)))
    with pytest.raises(ExportError, match="watertight, a volume, one body: DISAGREES"):
        build_bundle(history, "best")


# --- hostile archives ---


@pytest.mark.parametrize("name", ["../evil", "/etc/evil", "a/../../evil", "C:evil", "..\\evil"])
def test_an_archive_with_a_path_that_leads_elsewhere_is_refused(name: str) -> None:
    with pytest.raises(ExportError, match="plain relative paths"):
        unzipped(zipped({"ok": b"", name: b""}))


def test_an_archive_that_would_unpack_to_too_much_is_refused() -> None:
    with pytest.raises(ExportError, match="at most"):
        unzipped(zipped({"zeros": bytes(300 << 20)}))
    with pytest.raises(ExportError, match="no zip"):
        unzipped(b"PK\x03\x04 and nothing more")


# --- import ---


def test_a_design_comes_back_from_its_bundle_whatever_the_order(
    bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = make_task("pen_press")
    design = read_design(bundle.content)
    assert design == read_design(bundle.files["design.json"])
    assert design == read_design(b"\xef\xbb\xbf" + bundle.files["design.json"]), "as an editor has stored it"
    monkeypatch.setattr("studio.export.design_file.MAX_BYTES", 1000)
    with pytest.raises(ExportError, match="too large to be a design"):
        load_design(Path("/dev/zero"))
    shuffled = msgspec.structs.replace(design, parameters=design.parameters[::-1])
    phi = phi_for(shuffled, "pen_press", task.design_space)
    np.testing.assert_array_equal(phi, design.phi)
    assert [p.initial for p in starting_from(design, StartRun()).parameters or []] == phi.tolist()


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"<mujoco><worldbody/></mujoco>", "no design.json"),
        (b"[" * 100_000, "no design.json"),
        (b'{"kind": "robot"}', "no design.json"),
        (zipped({"hand.xml": b"<mujoco/>"}), "holds no design.json"),
    ],
)
def test_what_is_no_design_is_refused(content: bytes, sentence: str) -> None:
    with pytest.raises(ExportError, match=sentence):
        read_design(content)


@pytest.mark.parametrize(
    ("index", "change", "sentence"),
    [
        (0, {"name": "thumb"}, "lacks placement_1"),
        (4, {"value": 4.0}, "length_1 must lie inside"),
        (4, {"value": float("nan")}, "length_1 must be finite"),
        (4, {"unit": "mm"}, "must be in m, not in mm"),
        (1, {"name": "placement_1"}, "lacks placement_2"),
    ],
)
def test_a_design_that_does_not_fit_is_refused(
    bundle: Bundle, index: int, change: dict[str, object], sentence: str
) -> None:
    design = read_design(bundle.content)
    values = list(design.parameters)
    values[index] = msgspec.structs.replace(values[index], **change)
    with pytest.raises(ExportError, match=sentence):
        phi_for(msgspec.structs.replace(design, parameters=values), "pen_press", make_task("pen_press").design_space)


def test_a_design_of_another_task_is_refused(tmp_path: Path) -> None:
    history = History(make_hand_run(tmp_path, "pen_press"))
    design = design_of(history, history.phi.tolist())
    with pytest.raises(ExportError, match="a design for pen_press, not for reacher"):
        phi_for(design, "reacher", make_task("reacher").design_space)


def test_the_same_bundle_twice_differs_in_nothing_but_the_time(bundle: Bundle) -> None:
    with zipfile.ZipFile(io.BytesIO(bundle.content)) as archive:
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        assert {name: archive.read(name) for name in archive.namelist()} == dict(bundle.files)
