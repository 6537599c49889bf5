"""Exported files stand where every reader begins, in words that strict and old readers take, and show in ROS."""

import itertools
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from test_export import awkward_robot, export, faults
from test_export_proof import design_in

from morph_core.catalogue import TASKS, make_task
from morph_core.task import Task
from studio.export.bundle import check_formats, robot_files
from studio.export.check import Check
from studio.export.control import control_settings
from studio.export.errors import ExportError
from studio.export.mjcf import in_old_words, new_words, oldest_reader
from studio.export.proof import prove_robot, unpack
from studio.export.ros import package_name
from studio.export.screen import screen
from studio.export.stand import check_standing
from studio.export.urdf import CARRIER_MASS, write_urdf
from studio.export.zero import moved_zero
from studio.robots.chooser import robot_of
from tests.foreign import Pointer
from tests.verifying import verify

OLD_VERSIONS = ("3.2.7", "3.3.7", "3.10.0")
SPEEDS = {"reacher": {2.0}, "pen_press": {0.5, 3.0}, "mouse_click": {0.5, 3.0}}  # rad/s; m/s of the palm
EVERY = ("mjcf", "urdf", "ros2_control")


@st.composite
def designs(draw: st.DrawFn) -> tuple[Task, np.ndarray]:
    """Draw a task and a design of it (d,), often on the faces of the box, that can be assembled."""
    task = make_task(draw(st.sampled_from(sorted(TASKS))))
    space = task.design_space
    share = st.one_of(st.sampled_from([0.0, 0.5, 1.0]), st.floats(0, 1))
    shares = np.array(draw(st.lists(share, min_size=len(space), max_size=len(space))))
    phi = space.lo + shares * (space.hi - space.lo)
    assume(task.buildable(phi))
    return task, phi


def corner(name: str, low: bool) -> tuple[Task, np.ndarray]:
    """Return a task with the design whose lengths are all shortest, or all longest."""
    task = make_task(name)
    space = task.design_space
    lengths = np.array([parameter.unit == "m" for parameter in space.parameters])
    return task, np.where(lengths, space.lo if low else space.hi, space.initial)


@given(designs())
@example(corner("pen_press", low=True))
@example(corner("pen_press", low=False))
@example(corner("mouse_click", low=False))
@example(corner("reacher", low=True))
@settings(max_examples=6, deadline=None)
def test_every_file_is_legal_and_holds_where_readers_begin(chosen: tuple[Task, np.ndarray]) -> None:
    task, phi = chosen
    files, robot = robot_files(task, phi, [], EVERY), robot_of(task).file_name
    meshes = {path: content for path, content in files.items() if path.startswith("meshes_scene/")}
    for file in (f"{robot}.xml", "scene.xml"):
        assert new_words(ElementTree.fromstring(files[file])) == []
        model = mujoco.MjModel.from_xml_string(files[file].decode(), meshes)
        starts = [mujoco.MjData(model), mujoco.MjData(model)]
        mujoco.mj_resetDataKeyframe(model, starts[1], model.key("start").id)
        for data in starts:
            stands(model, data, robot_alone=file != "scene.xml")
    root = ElementTree.fromstring(files[f"{robot}.urdf"])
    names = [e.attrib["name"] for e in [*root.findall("link"), *root.findall("joint")]]
    assert len(set(names)) == len(names)
    limits = [joint.find("limit") for joint in root.findall("joint") if joint.get("type") != "fixed"]
    assert {float(limit.attrib["velocity"]) for limit in limits if limit is not None} == SPEEDS[task.name]
    assert all(float(e.get("lower", 0)) <= 0 <= float(e.get("upper", 0)) for e in limits if e is not None)
    model = mujoco.MjModel.from_xml_string(files[f"{robot}.xml"].decode())
    assert np.all((model.jnt_range[:, 0] <= 0) & (model.jnt_range[:, 1] >= 0))
    plan = control_settings(model, model)["joints"]
    assert isinstance(plan, dict)
    assert [e.attrib["name"] for e in root.findall("ros2_control/joint")] == list(plan)
    assert [e.attrib["name"] for e in root.findall("transmission/joint")] == list(plan)


def stands(model: mujoco.MjModel, data: mujoco.MjData, robot_alone: bool) -> None:
    """Assert that a robot may be where it begins, that nothing pushes it, and that it stays for a second."""
    joints = model.actuator_trnid[:, 0]
    before = data.qpos[model.jnt_qposadr[joints]].copy()
    bounded = model.jnt_limited[joints].astype(bool)
    assert np.all((model.jnt_range[joints, 0] <= before + 1e-12) | ~bounded)
    assert np.all((before - 1e-12 <= model.jnt_range[joints, 1]) | ~bounded)
    mujoco.mj_forward(model, data)
    walls = [c for c in data.contact if any("wall" in model.geom(g).name for g in (c.geom1, c.geom2))]
    if robot_alone:
        assert all(contact.dist > -1e-9 for contact in data.contact)
    if walls:
        return  # a design that begins inside a wall is pushed out of it
    while data.time < 1:
        mujoco.mj_step(model, data)
    allowed = np.where(model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_SLIDE), 1e-3, 0.01)
    assert np.all(np.abs(data.qpos[model.jnt_qposadr[joints]] - before) < allowed)


@given(st.floats(-1.5, 1.5), st.floats(-0.5, 0.5), st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_moving_the_zero_moves_no_body(turn: float, slide: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    quats = rng.standard_normal((2, 4))
    lift = spec.worldbody.add_body(name="lift", pos=rng.uniform(-1, 1, 3), quat=quats[0] / np.linalg.norm(quats[0]))
    lift.add_joint(name="lift", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=rng.uniform(0.1, 1, 3), range=[-2, 2])
    arm = lift.add_body(name="arm", pos=rng.uniform(-1, 1, 3), quat=quats[1] / np.linalg.norm(quats[1]))
    arm.add_joint(name="arm", axis=rng.uniform(0.1, 1, 3), pos=rng.uniform(-1, 1, 3), range=[-3, 3])
    for body in (lift, arm):
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.2, 0.3])
    zero = {"lift": slide, "arm": turn}
    spec.add_key(name="start", qpos=[slide, turn])
    before, after = spec.compile(), moved_zero(spec, zero).compile()
    one, other, q = mujoco.MjData(before), mujoco.MjData(after), rng.uniform(-1, 1, 2)
    one.qpos[:], other.qpos[:] = q + np.array([slide, turn]), q
    mujoco.mj_kinematics(before, one)
    mujoco.mj_kinematics(after, other)
    np.testing.assert_allclose(other.xpos, one.xpos, rtol=0, atol=1e-12)
    np.testing.assert_allclose(other.xmat, one.xmat, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.jnt_range, before.jnt_range - np.array([[slide], [turn]]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.key_qpos, 0, atol=1e-12)


def test_the_zero_of_a_joint_that_shares_its_body_stays() -> None:
    with pytest.raises(ValueError, match="zero of lift can't be moved"):
        moved_zero(awkward_robot(), {"lift": 0.1})


def test_a_zero_that_is_not_allowed_moves_in_the_urdf_to_the_nearest_place_that_is() -> None:
    pytest.importorskip("yourdfpy")
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    lift = spec.worldbody.add_body(name="lift", quat=[0.9, 0.1, 0.2, 0.3])
    lift.add_joint(name="lift", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 1], range=[0.06, 0.75])
    arm = lift.add_body(name="arm", pos=[0.1, 0.2, 0.3])
    arm.add_joint(name="arm", axis=[0, 1, 0.5], pos=[0.05, 0.02, 0], range=[-2, -0.5])
    for body in (lift, arm):
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, 0.3, 0, 0.1], size=[0.02, 0, 0])
    model, files = export(spec)
    assert faults(verify(files, model)) == []
    limits = {
        joint.attrib["name"]: (float(limit.attrib["lower"]), float(limit.attrib["upper"]))
        for joint in ElementTree.fromstring(files["robot.urdf"]).findall("joint")
        if (limit := joint.find("limit")) is not None
    }
    assert limits["lift_joint"] == pytest.approx((0.0, 0.69))
    assert limits["arm_joint"] == pytest.approx((-1.5, 0.0))


# --- what would not stand is found out ---


def the_hand() -> tuple[dict[str, bytes], Callable[[dict[str, bytes]], list[str]]]:
    """Return the files of a hand, and a function that finds what is wrong with them."""
    task = make_task("pen_press")
    phi = task.design_space.initial
    parts = robot_of(task).parts(phi)
    files = robot_files(task, phi, parts, ("mjcf", "urdf", "ros"))
    design = design_in(task, [])  # parts have tests of their own
    return files, lambda changed: faults(prove_robot(changed, design, task, phi, only_mujoco=True))


def test_a_hand_that_would_not_stand_is_found_out() -> None:
    files, found = the_hand()
    assert found(files) == []
    package = "ros/pen_press_description/urdf/hand.urdf"
    for path, before, after, finding in (
        ("scene.xml", 'ctrl="0 ', 'ctrl="-0.05 ', "scene.xml in MuJoCo at key \"start\": stands"),
        ("hand.xml", 'key name="start" qpos="0', 'key name="start" qpos="1', "start\": joints within their limits"),
        ("hand.urdf", 'velocity="3.0"', 'velocity="3.1"', "hand.urdf: speeds"),
        ("hand.urdf", 'velocity="3.0"', 'velocity="0.0"', "no positive effort and velocity"),
        (package, 'mass value="0', 'mass value="1', f"{package} in MuJoCo: masses"),
        (package, "package://pen_press_description/", "package://elsewhere/", "its address must begin with package://"),
    ):  # fmt: skip
        text = files[path].decode()
        assert before in text, before
        changed = files | {path: text.replace(before, after, 1).encode()}
        assert any(finding in fault for fault in found(changed)), finding


def test_links_in_each_other_are_found_out_and_what_begins_in_a_wall_is_not_asked_to_stand() -> None:
    spec = mujoco.MjSpec()
    for name, place in (("left", 0.0), ("right", 0.15), ("apart", 5.0)):
        body = spec.worldbody.add_body(name=name, pos=[place, 0, 0])
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0])
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
        spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_position(kp=10, kv=1)
    model = spec.compile()
    assert [c.name.split(": ")[1] for c in check_standing("f", model, {"left", "right", "apart"}) if not c.passed] == [
        "links apart (m)", "stands for 1 s (of what is allowed)",
    ]  # fmt: skip
    against_another = check_standing("f", model, {"left", "apart"})
    assert all(check.passed for check in against_another)
    assert against_another[-1].detail == "not asked: it begins with left in right"


def broken(urdf: str, before: str, after: str) -> list[Check]:
    assert before in urdf, before
    return verify({"robot.urdf": urdf.replace(before, after, 1).encode()})


def test_what_a_strict_reader_refuses_in_a_urdf_is_found_out() -> None:
    task = make_task("pen_press")
    hand = moved_zero(task.spec(task.design_space.initial), robot_of(task).zero(task.design_space.initial)).compile()
    urdf = write_urdf(hand, "robot.urdf", "hand")["robot.urdf"].decode()
    carrier = f'mass value="{CARRIER_MASS!r}"'
    for before, after, finding in (
        ('joint name="palm_joint"', 'joint name="palm"', "two links or joints are named palm"),
        ('upper="0.25"', 'upper="-0.25"', "zero, where readers begin, is outside the limits"),
        (carrier, 'mass value="1e-06"', "base is so light that Gazebo drops it"),
        ('effort="100.0"', 'effort="inf"', "palm_joint has no positive effort and velocity"),
    ):
        assert any(finding in str(check) for check in broken(urdf, before, after) if not check.passed), finding
    without = urdf[: urdf.index("<inertial>")] + urdf[urdf.index("</inertial>") + len("</inertial>") :]
    assert any("base has no inertial" in str(check) for check in verify({"robot.urdf": without.encode()}))


def test_names_are_such_as_isaac_takes_unchanged_whatever_a_robots_own_are() -> None:
    spec, own = mujoco.MjSpec(), ["1st", "link.a", "link-a", "link a", "\N{SNOWMAN}", "a/b:c"]
    spec.add_mesh(name="2-sided", uservert=np.ravel([*itertools.product((0.0, 0.1), repeat=3)]))
    for name in own:
        body = spec.worldbody.add_body(name=name)
        body.add_joint(name=name, range=[-1, 1])
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="2-sided")
        body.add_site(name=name)
    files = write_urdf(spec.compile(), "robot.urdf", "robot")
    root = ElementTree.fromstring(files["robot.urdf"])
    names = [e.attrib["name"] for e in [*root.findall("link"), *root.findall("joint")]]
    assert len({*names}) == len(names) == 2 + 4 * len(own) + 1  # link, joint, and a frame with its joint, of each
    stems = [Path(path).stem for path in files]
    assert all(re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", name) for name in [*names, *stems]), names
    limits = [joint.find("limit") for joint in root.findall("joint") if joint.get("type") == "revolute"]
    assert all(limit is not None and set(limit.attrib) == {"lower", "upper", "effort", "velocity"} for limit in limits)


def test_no_link_or_joint_of_an_awkward_robot_shares_its_name() -> None:
    model = awkward_robot().compile()
    root = ElementTree.fromstring(write_urdf(model, "robot.urdf", "robot", drives=True)["robot.urdf"])
    names = [e.attrib["name"] for e in [*root.findall("link"), *root.findall("joint")]]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", name) for name in names), "what Isaac documents of names"
    assert names[0] == "world"
    assert root.find("link[@name='world']/inertial") is None
    assert root.find("ros2_control/joint") is None, "a robot without servos has none to drive"


# --- old words ---


def test_servos_get_their_name_and_other_actuators_keep_their_form() -> None:
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="arm")
    body.add_joint(name="arm")
    body.add_geom(name="arm", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    for kind in ("servo", "motor", "damper", "velocity", "cylinder"):
        actuator = spec.add_actuator(name=kind, target="arm", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if kind == "servo":
            actuator.set_to_position(kp=1 / 3, kv=0.1)
        if kind == "velocity":
            actuator.set_to_velocity(kv=0.2)
        if kind == "cylinder":
            actuator.set_to_cylinder(timeconst=0.1, bias=0.2, area=0.3)
        if kind == "damper":
            actuator.biastype, actuator.biasprm[2] = mujoco.mjtBias.mjBIAS_AFFINE, -0.3
    model = spec.compile()
    text = in_old_words(spec.to_xml())
    assert b"<position" in text
    assert b"input=" not in text
    again = mujoco.MjModel.from_xml_string(text.decode())
    for field in ("actuator_gainprm", "actuator_biasprm", "actuator_gaintype", "actuator_biastype"):
        np.testing.assert_allclose(getattr(again, field), getattr(model, field), rtol=1e-6)
    assert oldest_reader([text]) == "3.2"


@pytest.mark.parametrize(
    ("before", "after", "word"),
    [
        ("<worldbody>", '<worldbody><cloth name="c"/>', "body/cloth"),
        ("<worldbody>", '<worldbody wind="1">', "mujoco/worldbody wind"),
        ('type="sphere"', 'type="sphere" shade="1"', "body/geom shade"),
        ("<body>", '<body><joint damping="1 2"/>', "body/joint damping=1 2"),
        ("<worldbody>", '<asset><mesh inertia="shell"/></asset><worldbody>', "asset/mesh inertia=shell"),
    ],
)
def test_a_new_word_names_the_version_that_wrote_it(before: str, after: str, word: str) -> None:
    text = '<mujoco><worldbody><body><geom type="sphere" size=".1"/></body></worldbody></mujoco>'
    changed = text.replace(before, after)
    assert new_words(ElementTree.fromstring(changed)) == [word]
    assert oldest_reader([text.encode(), changed.encode()]) == mujoco.__version__


def test_sensors_that_old_versions_lack_stay_out_and_others_stay_in() -> None:
    task = make_task("pen_press")
    scene = task.scene(task.design_space.initial)
    scene.add_sensor(name="angle", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT,
                     objname="finger_1_distal")  # fmt: skip
    scene.compile()
    assert [s.tag for s in ElementTree.fromstring(in_old_words(scene.to_xml())).iterfind("sensor/*")] == ["jointpos"]


ASK = """
import sys
from pathlib import Path
import mujoco
import numpy as np
ends = []
for path in sorted(Path(sys.argv[1]).glob("*/*.*")):
    if path.suffix not in (".xml", ".urdf"):
        continue
    model = mujoco.MjModel.from_xml_path(str(path))
    if path.name != "scene.xml" or path.parent.name == "reacher":
        continue
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    change = np.concatenate([[0.0075], np.tile([-0.09, 0.03], (model.nu - 1) // 2)])  # rise, close and curl
    for _ in range(40):
        data.ctrl[:] = np.clip(data.qpos[: model.nu] + change, *model.actuator_ctrlrange.T)
        mujoco.mj_step(model, data, nstep=10)
        ends.append(data.qpos[: model.nu + 3].copy())
np.savetxt(sys.argv[2], np.concatenate(ends))
"""


@pytest.mark.slow
@pytest.mark.timeout(580)
def test_mujoco_of_the_last_two_years_reads_the_files_and_moves_them_alike(tmp_path: Path) -> None:
    """Its wheels go into folders of their own; without a way to the package index there is nothing to ask."""
    for name in sorted(TASKS):
        task = make_task(name)
        phi = task.design_space.initial
        unpack(robot_files(task, phi, robot_of(task).parts(phi), ("mjcf", "urdf")), tmp_path / "files" / name)
    program = tmp_path / "ask.py"
    program.write_text(ASK)

    def ends(place: Path | None) -> np.ndarray:
        out = tmp_path / "ends.txt"
        surroundings = os.environ | {"MUJOCO_GL": "disable"} | ({"PYTHONPATH": str(place)} if place else {})
        command = [sys.executable, program, tmp_path / "files", out]
        subprocess.run(command, check=True, capture_output=True, timeout=120, env=surroundings)
        return np.loadtxt(out)

    now = ends(None)
    asked = 0
    for version in OLD_VERSIONS:
        place = tmp_path / version
        pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--only-binary", ":all:", "--no-compile"]
        try:
            wheel = [*pip, "--target", place, f"mujoco=={version}"]
            subprocess.run(wheel, check=True, capture_output=True, timeout=120)
        except subprocess.SubprocessError:
            continue
        off = np.abs(ends(place) - now)
        pen = np.arange(len(off)) >= 40 * 14  # the mouse is first: 40 control steps of 11 joints and 3 coordinates
        assert off[pen].max() < 2e-4  # m, rad
        assert off[~pen].max() < 0.15  # rad: convex meshes touch elsewhere since 4.0
        asked += 1
    if not asked:
        pytest.skip("no package index within reach")


# --- ROS ---


@given(st.text(max_size=40))
@example("pen_press")
@example("5-bar Ünit")
@settings(max_examples=30, deadline=None)
def test_a_package_is_called_what_ros_allows_whatever_the_task_is(task: str) -> None:
    name = package_name(task)
    assert name.isascii()
    assert name.isidentifier()
    assert name == name.lower()
    assert name[0].isalpha()
    assert "__" not in name


def test_a_ros_package_holds_all_that_its_files_ask_for() -> None:
    files, _ = the_hand()
    (folder,) = {path.split("/")[1] for path in files if path.startswith("ros/")}
    assert folder == "pen_press_description"
    inside = {path.split("/", 2)[2]: content for path, content in files.items() if path.startswith("ros/")}
    urdf = ElementTree.fromstring(inside["urdf/hand.urdf"].decode())
    meshes = {mesh.attrib["filename"] for mesh in urdf.iter("mesh")}
    assert len(meshes) == 3
    assert {mesh.removeprefix(f"package://{folder}/") for mesh in meshes} <= set(inside)
    assert ElementTree.fromstring(inside["package.xml"]).findtext("name") == folder
    assert b"Fixed Frame: world" in inside["rviz/display.rviz"]
    installed = inside["CMakeLists.txt"].decode()
    assert all(f" {place}" in installed for place in {path.split("/")[0] for path in inside if "/" in path})
    texts = [content.decode() for path, content in inside.items() if not path.startswith("meshes/")]
    assert not any("@" in text.replace("nobody@example.com", "") for text in texts), "a word was left unfilled"


def test_the_launch_file_starts_what_shows_the_description_of_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ROS 2 itself is not here: its modules are stood in for, and what the file gives them is looked at."""
    files, _ = the_hand()
    unpack({path.removeprefix("ros/"): content for path, content in files.items() if path.startswith("ros/")}, tmp_path)
    asked: list[dict[str, Any]] = []
    stand_ins: dict[str, dict[str, Callable[..., object]]] = {
        "ament_index_python.packages": {"get_package_share_directory": lambda name: str(tmp_path / name)},
        "launch": {"LaunchDescription": list},
        "launch_ros.actions": {"Node": lambda **facts: asked.append(facts)},
        "launch_ros.parameter_descriptions": {"ParameterValue": lambda value, value_type: value_type(value)},
    }
    for name, words in stand_ins.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**words))
    runpy.run_path(str(tmp_path / "pen_press_description" / "launch" / "display.launch.py"))[
        "generate_launch_description"
    ]()
    publisher, sliders, viewer = asked
    robot = ElementTree.fromstring(publisher["parameters"][0]["robot_description"])
    assert {link.get("name") for link in robot.iter("link")} >= {"world", "base", "palm", "finger_4_distal"}
    assert [node["package"] for node in (publisher, sliders)] == ["robot_state_publisher", "joint_state_publisher_gui"]
    assert Path(viewer["arguments"][1]).read_text().startswith("Panels:")
    needed = ElementTree.parse(tmp_path / "pen_press_description" / "package.xml").iter("exec_depend")
    modules = {name.split(".")[0] for name in stand_ins}
    assert {node["package"] for node in asked} | modules == {depend.text for depend in needed}


@pytest.mark.parametrize(
    "address", ["package://pen_press_description/../../../x.stl", "package://other/meshes/x.stl", "x.stl"]
)
def test_a_package_that_asks_for_a_file_outside_is_screened_out(address: str) -> None:
    path, mesh = "ros/pen_press_description/urdf/hand.urdf", "ros/pen_press_description/meshes/x.stl"
    shown = '<visual><geometry><mesh filename="{}"/></geometry></visual>'
    urdf = f'<robot name="hand"><link name="world">{shown}</link></robot>'
    sound = {path: urdf.format("package://pen_press_description/meshes/x.stl").encode(), mesh: b""}
    assert all(check.passed for check in screen(sound, "hand"))
    assert not all(check.passed for check in screen(sound | {path: urdf.format(address).encode()}, "hand"))


def test_servos_for_ros_need_a_urdf_and_a_robot_without_any_has_none() -> None:
    with pytest.raises(ExportError, match="choose urdf or ros with it"):
        check_formats(["mjcf", "ros2_control"], make_task("reacher"))
    check_formats(["ros", "ros2_control"], Pointer())
    root = ElementTree.fromstring(robot_files(Pointer(), np.array([0.3, 0.4]), [], EVERY)["robot.urdf"])
    assert {limit.attrib["velocity"] for limit in root.iterfind("joint/limit")} == {"3.0"}, "0.3 rad in 0.1 s"
