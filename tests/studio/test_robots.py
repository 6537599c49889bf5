"""Any robot can be exported: one of which this package knows nothing, from its `spec`, its shapes and its units."""

import dataclasses
import io
import itertools
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from manifold3d import Manifold
from safetensors.numpy import save_file

from morph_core import config
from morph_core.catalogue import TASKS, make_method, make_task
from morph_core.history import History
from morph_core.protocol import FORMAT, Evaluation, Progress, RunRecord, StateChanged
from morph_core.run_folder import EventLog, create_run
from morph_core.task import Task
from studio.export.bundle import Bundle, build_bundle, check_formats, default_formats
from studio.export.check import Check
from studio.export.control import control_settings
from studio.export.errors import ExportError
from studio.export.policy import Policy
from studio.export.proof import prove, unpack
from studio.export.urdf import urdf_names, write_urdf
from studio.robots.arm import ArmRobot
from studio.robots.chooser import robot_of
from studio.robots.hand import HandRobot
from studio.robots.parts import body_of, link_names
from studio.robots.plain import PlainRobot, why_not_in_mujoco
from studio.robots.shapes import solid_of
from studio.viewer.change import change_table
from studio.viewer.parts import quantities_of
from studio.viewer.take import Shot, make_take
from tests.foreign import Pointer, Swinging, Unnamed

FOREIGN = (Pointer, Unnamed, Swinging)
PHI = (0.25, 0.5)


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the stranger's tasks known by name, as a plug-in does."""
    for kind in FOREIGN:
        monkeypatch.setitem(TASKS._loaded(), kind.name, kind)


def recorded(runs: Path, task: Task, phi: Sequence[float] = PHI) -> History:
    """Return a run of one iteration, evaluated, with a policy."""
    options = {} if task == TASKS[task.name]() else {"tunnel": "paper"}
    settings = config.recorded(make_method("morph", task))
    record = RunRecord(
        id=f"run-{task.name}", task=task.name, task_options=options, method="morph", seed=0, iterations=10, versions={},
        created=0.0, format=FORMAT, config=settings, parameters=list(task.design_space.parameters),
    )  # fmt: skip
    folder = create_run(runs, record)
    log, phi = EventLog(folder), list(phi)
    log.append(StateChanged(status="starting", iteration=0))
    log.append(Progress(iteration=1, env_steps=9, phi=phi, episode_return=0, success=0, policy_std=0.5))
    log.append(
        Evaluation(
            iteration=1, env_steps=9, phi=phi, sampled_success=0.5, sampled_return=0, deterministic_success=0,
            deterministic_return=0,
        )
    )  # fmt: skip
    log.append(StateChanged(status="finished", iteration=1))
    log.close()
    rng, sizes = np.random.default_rng(0), [task.observation_size, 8, 8, task.action_size]
    tensors = {"policy/log_std": np.full(task.action_size, -1.0, np.float32)}
    for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        tensors[f"policy/mean.{2 * i}.weight"] = rng.standard_normal((outputs, inputs)).astype(np.float32)
        tensors[f"policy/mean.{2 * i}.bias"] = 0.3 * rng.standard_normal(outputs).astype(np.float32)
    path = folder.checkpoint(0)  # of an iteration whose success was not measured
    path.mkdir(parents=True)
    save_file(tensors, path / "weights.safetensors")
    (path / "state.json").write_text("{}")
    return History(folder)


@pytest.fixture(params=FOREIGN, ids=lambda kind: kind.name)
def task(request: pytest.FixtureRequest) -> Task:
    return request.param()


@pytest.fixture
def bundle(task: Task, tmp_path: Path) -> Bundle:
    return build_bundle(recorded(tmp_path / "runs", task), "best")


def faults(checks: list[Check]) -> list[str]:
    return [str(check) for check in checks if not check.passed]


def run_policy(bundle: Bundle, folder: Path, said: str = "") -> str:
    """Run the shipped program away from this package, and return what it prints."""
    unpack(bundle.files, folder)
    code = (
        "import runpy, sys; sys.path.insert(0, '.'); before = {*sys.modules};"
        "runpy.run_path('run_policy.py', run_name='__main__');"
        "loaded = {m.split('.')[0] for m in {*sys.modules} - before};"
        "sys.exit(len(loaded & {'morph_core', 'studio', 'torch', 'trimesh'}))"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=folder, capture_output=True, text=True, check=False, input=said
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def mean(arrays: Mapping[str, np.ndarray], seen: np.ndarray) -> np.ndarray:
    """Return the mean action (action_size,) of an exported policy."""
    layers = [[arrays[f"{name}_{i}"] for i in range(3)] for name in ("weight", "bias")]
    return Policy(layers[0], layers[1], arrays["std"], 0).act(seen[None].astype(np.float32), None)[0]


# --- which robot ---


def test_a_task_has_the_robot_of_its_kind_whatever_it_is_called() -> None:
    assert isinstance(robot_of(make_task("reacher")), ArmRobot)
    for name in ("pen_press", "mouse_click"):
        assert isinstance(robot_of(make_task(name)), HandRobot)
    for kind in FOREIGN:
        assert isinstance(robot_of(kind()), PlainRobot)

    class Renamed(type(make_task("pen_press"))):
        name = "a_task_with_another_name"

    assert isinstance(robot_of(Renamed()), HandRobot)


# --- a foreign bundle ---


def test_a_foreign_task_exports_every_format(bundle: Bundle) -> None:
    links = ("base", "rod_1", "rod_2")
    plates = {path for path in bundle.files if path.startswith("plates/")}
    assert {"plates/plate_1.3mf", "plates/plate_1.svg", "plates/pieces.csv"} <= plates
    assert set(bundle.files) - plates == {
        "robot.xml", "robot.mjz", "scene.xml", "robot.urdf", "control.json", "assembly.glb", "policy.npz",
        "policy.onnx", "policy.py", "run_policy.py", "design.json", "provenance.json", "report.html", "LICENSE",
        "README.txt",
        *(f"{folder}/{link}.{ending}" for folder, ending in (("parts", "stl"), ("3mf", "3mf")) for link in links),
    }  # fmt: skip
    provenance = json.loads(bundle.files["provenance.json"])
    assert provenance["policy"][0]["where"] == "at export"
    assert "stand in for parts" in bundle.files["README.txt"].decode()
    assert "coupon" not in bundle.files["README.txt"].decode()
    assert "PLA" not in bundle.files["report.html"].decode()


def test_verify_passes_on_a_foreign_bundle_and_sees_another_length(bundle: Bundle, task: Task) -> None:
    assert faults(prove(bundle.files, episodes=8)) == []  # in this process, which alone knows the task
    longer = bundle.files["design.json"].replace(b'"value": 0.5', b'"value": 0.51')
    assert longer != bundle.files["design.json"]
    found = faults(prove({**bundle.files, "design.json": longer}, episodes=0))
    for file in ("robot.xml", "robot.mjz", "robot.urdf"):
        assert any(fault.startswith(f"{file} in MuJoCo: masses") for fault in found), task.name


def test_a_shape_that_is_larger_than_what_collides_is_found_out(bundle: Bundle) -> None:
    mesh = trimesh.load_mesh(io.BytesIO(bundle.files["parts/rod_2.stl"]), file_type="stl")
    mesh.apply_scale(1.01)
    files = {**bundle.files, "parts/rod_2.stl": mesh.export(file_type="stl")}
    assert any(
        "parts/rod_2.stl: inside the collision shapes of rod_2" in fault for fault in faults(prove(files, episodes=0))
    )


def test_formats_of_a_robot_without_shapes_leave_meshes_out() -> None:
    class Ghost(Pointer):
        def spec(self, phi: np.ndarray) -> mujoco.MjSpec:
            spec = super().spec(phi)
            for geom in list(spec.geoms):
                spec.delete(geom)
            for body in spec.bodies[1:]:
                body.explicitinertial, body.mass, body.inertia = True, 1.0, [1, 1, 1]
            return spec

    assert default_formats(Ghost()) == ("mjcf", "urdf")
    with pytest.raises(ExportError, match="pointer has no shapes for stl; choose from: mjcf, urdf"):
        check_formats(["stl"], Ghost())


# --- its policy ---


def test_the_program_of_joints_ends_where_the_task_does(tmp_path: Path) -> None:
    task = Pointer()
    history = recorded(tmp_path / "runs", task)
    said = run_policy(build_bundle(history, "best"), tmp_path / "out")
    assert said == f"joints at {_own_end(task, tmp_path / 'out').tolist()} after 20 control steps\n"


def test_the_program_of_motors_ends_where_the_task_does(tmp_path: Path) -> None:
    task = Swinging()
    history = recorded(tmp_path / "runs", task)
    said = run_policy(build_bundle(history, "best"), tmp_path / "out")
    assert said == f"joints at {_own_end(task, tmp_path / 'out').tolist()} after 20 control steps\n"


def _own_end(task: Task, folder: Path) -> np.ndarray:
    """Return qpos (nq,) after an episode of the exported policy's mean in the task, from the scene's keyframe."""
    policy = np.load(folder / "policy.npz")
    hardware = task.hw_phy(np.array(PHI))
    s = task.reset(hardware, 1, np.random.default_rng(0))
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    np.testing.assert_allclose(task.qpos(s)[0], model.key("start").qpos, atol=1e-12)
    for _ in range(task.horizon):
        s = task.step(hardware, s, mean(policy, task.observe(s)[0])[None]).s
    return task.qpos(s)[0].round(4)


def test_the_program_of_the_arm_sees_what_the_task_shows(tmp_path: Path) -> None:
    task = make_task("reacher", {"tunnel": "paper"})
    phi = task.design_space.initial / 10  # too short to reach a wall, which would not stop the program
    said = run_policy(build_bundle(recorded(tmp_path / "runs", task, phi.tolist()), "best"), tmp_path / "out")
    policy = np.load(tmp_path / "out" / "policy.npz")
    arm = task.hw_phy(phi)
    s = np.zeros((1, task.state_size))
    s[0, :5] = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "scene.xml")).key("start").qpos
    s[:, 5:7] = arm(s, np.zeros((1, 5)))[:, -2:]
    for _ in range(task.horizon):
        s = task.step(arm, s, mean(policy, task.observe(s)[0])[None]).s
    assert said.startswith(f"tip at {np.pad(s[0, 5:7], (0, 1)).round(3)} m")


def test_a_policy_without_units_answers_what_it_is_told(tmp_path: Path) -> None:
    bundle = build_bundle(recorded(tmp_path / "runs", Unnamed()), "best")
    readme = bundle.files["README.txt"].decode()
    assert "Policy:  python run_policy.py < observations.txt" in readme
    assert "the task has no observation_units and action_units" in readme
    assert "python run_policy.py &lt; observations.txt" in bundle.files["report.html"].decode()
    answer = run_policy(bundle, tmp_path / "out", "0.1 -0.2\n0 0\n")
    policy = np.load(tmp_path / "out" / "policy.npz")
    for line, seen in zip(answer.splitlines(), ([0.1, -0.2], [0.0, 0.0]), strict=True):
        expected = np.clip(mean(policy, np.array(seen)), -1, 1)
        np.testing.assert_allclose([float(word) for word in line.split()], expected, atol=1e-6)
    wrong = subprocess.run(
        [sys.executable, "run_policy.py"], cwd=tmp_path / "out", capture_output=True, text=True, input="1 2 3\n",
        check=False,
    )  # fmt: skip
    assert wrong.returncode == 1
    assert wrong.stderr == "a line must hold the 2 numbers that the policy sees, not 3\n"


class Scaled(Pointer):
    def observe(self, s: np.ndarray) -> np.ndarray:
        return np.sin(s).astype(np.float32)


class Hasty(Pointer):
    def step(self, hardware, s, action):
        return dataclasses.replace(super().step(hardware, s, action), s=s + 0.6 * np.clip(action, -1, 1))


class Wordy(Pointer):
    observation_size = 3
    observation_units = (np.zeros(3), np.ones(3))


class Turned(Pointer):
    def qpos(self, s: np.ndarray) -> np.ndarray:
        return s[:, ::-1]


class Lame(Swinging):
    action_size = 1
    action_units = np.ones(1)


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        (Pointer, ""),
        (Swinging, ""),
        (Unnamed, "no observation_units"),
        (Scaled, "not the first entries of its state"),
        (Hasty, "does not move the robot as the task does"),
        (Wordy, "it observes 3 numbers, and the scene holds 2"),
        (Turned, "does not begin with qpos"),
        (Lame, "it has 1 actions, and the scene 2 actuators"),
    ],
)
def test_a_policy_runs_in_mujoco_where_that_is_what_the_task_does(kind: Callable[[], Task], reason: str) -> None:
    found = why_not_in_mujoco(kind(), np.array(PHI))
    assert reason in found
    assert bool(found) == bool(reason)


# --- its shapes ---


def test_shapes_are_as_large_as_mujoco_has_them() -> None:
    spec = mujoco.MjSpec()
    spec.add_mesh(name="cube", uservert=np.ravel(list(itertools.product((-0.1, 0.1), repeat=3))))
    shapes = {
        "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, [0.1, 0, 0], 4 / 3 * np.pi * 0.1**3),
        "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, [0.1, 0.2, 0], np.pi * 0.1**2 * (0.4 + 4 / 3 * 0.1)),
        "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, [0.1, 0.2, 0], np.pi * 0.1**2 * 0.4),
        "ellipsoid": (mujoco.mjtGeom.mjGEOM_ELLIPSOID, [0.1, 0.2, 0.3], 4 / 3 * np.pi * 0.1 * 0.2 * 0.3),
        "box": (mujoco.mjtGeom.mjGEOM_BOX, [0.1, 0.2, 0.3], 8 * 0.1 * 0.2 * 0.3),
        "mesh": (mujoco.mjtGeom.mjGEOM_MESH, [0, 0, 0], 0.2**3),
    }
    for name, (kind, size, _) in shapes.items():
        body = spec.worldbody.add_body(name=name, pos=[1, 2, 3])
        geom = body.add_geom(type=kind, size=size, pos=[0.5, 0, 0], quat=[1, 1, 0, 0], mass=1)
        geom.meshname = "cube" if name == "mesh" else ""
    model = spec.compile()
    for name, (_, size, volume) in shapes.items():
        solid = solid_of(model, model.body(name).id)
        assert isinstance(solid, Manifold)
        assert solid.volume() * 1e-9 == pytest.approx(volume, rel=0.02)
        assert solid.volume() * 1e-9 <= volume * (1 + 1e-6)
        low, high = np.array(solid.bounding_box()).reshape(2, 3) / 1000
        np.testing.assert_allclose((low + high) / 2, [0.5, 0, 0], atol=1e-6)
        if name == "box":  # turned by a quarter about x
            np.testing.assert_allclose(high - low, 2 * np.array(size)[[0, 2, 1]], atol=1e-6)


def test_shapes_that_only_show_count_where_nothing_collides() -> None:
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="body")
    shown = body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.2, 0, 0])
    shown.contype = shown.conaffinity = 0
    assert solid_of(spec.compile(), 1) is not None
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.01, 0.01, 0.01])
    solid = solid_of(spec.compile(), 1)
    assert solid is not None
    assert solid.volume() == pytest.approx(20**3)
    assert solid_of(spec.compile(), 0) is None


def test_links_have_names_of_their_own_and_those_of_the_urdf() -> None:
    spec = mujoco.MjSpec()
    for name in ("", "base", "base_2", ""):
        spec.worldbody.add_body(name=name).add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    model = spec.compile()
    names = link_names(model)
    assert len(set(names)) == 5
    assert names[:2] == ["base", "body_1"]
    assert list(control_settings(model, model)["links"]) == names[1:]
    urdf = write_urdf(model, "robot.urdf", "robot")["robot.urdf"].decode()
    assert all(f'<link name="{name}"' in urdf for name in names)
    assert [body_of(model, name) for name in names] == list(range(5))
    for name in ('<arm>\n& "claw"', "<arm> & 'claw'", "arm/claw-1.2"):
        spec.worldbody.add_body(name=name).add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    plain = ["_arm_claw_", "_arm_claw__2", "arm_claw_1_2"]
    assert urdf_names(spec.compile()).links == [*names, *plain], "Gazebo and Isaac take no such signs"
    with pytest.raises(ValueError, match='no link "tail"; it has: base'):
        body_of(model, "tail")


# --- in the viewer ---


def test_a_foreign_robot_is_seen_with_its_own_colours_and_parts(task: Task, tmp_path: Path) -> None:
    history = recorded(tmp_path / "runs", task)
    (rod,) = quantities_of(history)
    assert (rod.name, rod.unit.name) == ("rod", "cm")
    assert [(e.part, e.colour) for e in rod.entries] == [("rod 1", "rgb(51, 102, 204)"), ("rod 2", "rgb(51, 178, 204)")]
    assert "rod 2" in change_table(history, history.phi)
    for printed in (False, True):
        take = make_take(Shot(task.name, (), PHI, printed=printed))
        assert set(take.robot.kinds) == {"capsule", "box"}
