"""MJCF and URDF of a design are the same robot, and a file that is not is found out."""

import io
import re
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from morph_core.catalogue import make_task
from studio.export.check import Check
from studio.export.errors import ExportError
from studio.export.mjcf import write_mjcf
from studio.export.urdf import MESHES, write_urdf
from studio.export.verify import POSTURES
from tests.verifying import verify

REACHER = make_task("reacher")


def export(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, dict[str, bytes]]:
    model = spec.compile()
    return model, write_mjcf(spec, "robot.xml", "meshes") | write_urdf(model, "robot.urdf", "robot")


def faults(checks: list[Check]) -> list[str]:
    return [str(check) for check in checks if not check.passed]


def awkward_robot() -> mujoco.MjSpec:
    """Return a robot with most of what MJCF allows: offsets, references, several joints and geoms, no names."""
    spec = mujoco.MjSpec()
    spec.add_mesh(name="../hull of\n'a' <part>", uservert=np.random.default_rng(1).uniform(-1, 1, 60) / 10)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.3, 0.2, 0.1])
    spec.worldbody.add_site(name="camera", pos=[0, 0, 1], quat=[0.9, 0.1, 0.2, 0.3])
    palm = spec.worldbody.add_body(name="palm", pos=[0.1, 0.2, 0.3], quat=[0.3, 0.5, -0.4, 0.7])
    palm.add_joint(name="lift", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 1], range=[-0.2, 0.5], ref=0.1)
    palm.add_joint(name="turn", axis=[1, 0.2, 0], pos=[0.05, 0.01, 0], range=[-30, 80], ref=20, damping=[0.3, 0, 0])
    palm.add_joint(axis=[0, 0, 1], pos=[-0.02, 0.03, 0.01])
    palm.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05, 0.04, 0.02], pos=[0.01, 0, 0], quat=[1, 1, 0, 0])
    palm.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.02, 0.05, 0], contype=0, conaffinity=0)
    mount = palm.add_body(pos=[0.1, 0, 0], quat=[0.7071067811865476, 0, 0.7071067811865475, 0])  # pitch of 90 degrees
    mount.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.03, 0, 0])
    finger = mount.add_body(name="finger", pos=[0, 0.05, 0])
    finger.add_joint(name="bend", axis=[0, 1, 0], pos=[0, 0, -0.01], frictionloss=0.02, range=[-10, 95])
    finger.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, 0.1, 0.02, 0.03], size=[0.01, 0, 0])
    finger.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=spec.meshes[0].name, pos=[0.1, 0, 0])
    finger.add_body(name="pad", pos=[0.1, 0, 0], quat=[0.1, 0.2, 0.3, 0.4]).add_site(name="finger", pos=[0.01, 0, 0])
    return spec


lengths = st.one_of(st.sampled_from([0.05, 5.0]), st.floats(0.05, 5.0))


@given(st.lists(lengths, min_size=5, max_size=5))
@example([0.05] * 5)
@example([5.0] * 5)
@example([3.0] * 5)
@settings(max_examples=6, deadline=None)
def test_every_reader_sees_the_same_arm_for_any_design(phi: list[float]) -> None:
    pytest.importorskip("yourdfpy")
    model, files = export(REACHER.spec(np.array(phi)))
    checks = verify(files, model)
    assert faults(checks) == []
    compared = {check.name for check in checks if "positions" in check.name}
    assert compared == {
        f"{reader}: positions in {POSTURES} postures (m)"
        for reader in ("robot.xml in MuJoCo", "robot.urdf in MuJoCo", "robot.urdf in yourdfpy")
    }


def test_forward_kinematics_of_both_files_agree_to_a_nanometre_without_the_verifier() -> None:
    yourdfpy = pytest.importorskip("yourdfpy")
    _, files = export(REACHER.spec(np.array([3.0, 0.05, 5.0, 1 / 3, 2.2])))
    model = mujoco.MjModel.from_xml_string(files["robot.xml"].decode())
    data = mujoco.MjData(model)
    urdf = yourdfpy.URDF.load(io.BytesIO(files["robot.urdf"]), load_meshes=False)
    rng = np.random.default_rng(3)
    for q in rng.uniform(-np.pi, np.pi, (100, 5)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        urdf.update_cfg({f"joint_{i + 1}": angle for i, angle in enumerate(q)})
        for i in range(5):
            np.testing.assert_allclose(
                urdf.get_transform(f"link_{i + 1}")[:3, 3], data.body(f"link_{i + 1}").xpos, rtol=0, atol=1e-9
            )
        np.testing.assert_allclose(urdf.get_transform("tip")[:3, 3], data.site("tip").xpos, rtol=0, atol=1e-9)


def test_an_awkward_robot_survives_the_translation() -> None:
    pytest.importorskip("yourdfpy")
    model, files = export(awkward_robot())
    assert faults(verify(files, model)) == []
    [mesh] = [name for name in files if name.startswith(MESHES)]
    assert "/" not in mesh.removeprefix(MESHES + "/")
    assert ".." not in mesh


def test_mesh_files_travel_with_the_mjcf() -> None:
    _, files = export(awkward_robot())
    [stl] = [content for name, content in files.items() if name.startswith(MESHES)]
    spec = mujoco.MjSpec()
    spec.assets = {"a/part.stl": stl}
    spec.add_mesh(name="part", file="a/part.stl")
    body = spec.worldbody.add_body(name="body")
    body.add_joint(axis=[1, 0, 0])
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="part")
    model, files = export(spec)
    assert files["meshes/0_part.stl"] == stl
    assert faults(verify(files, model)) == []


def test_a_free_floating_base_becomes_the_root_link() -> None:
    spec = mujoco.MjSpec()
    base = spec.worldbody.add_body(name="hull", pos=[0, 0, 0.5])
    base.add_freejoint()
    base.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 0.1, 0.05], pos=[0.01, 0, 0])
    leg = base.add_body(name="leg", pos=[0.2, 0, 0])
    leg.add_joint(name="hip", axis=[0, 1, 0], range=[-45, 45])
    leg.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, 0, 0, -0.3], size=[0.02, 0, 0])
    model, files = export(spec)
    assert faults(verify(files, model)) == []
    assert b'<link name="base">' not in files["robot.urdf"]


def ball(spec: mujoco.MjSpec) -> None:
    spec.body("link_5").add_joint(name="wrist", type=mujoco.mjtJoint.mjJNT_BALL)


def ellipsoid(spec: mujoco.MjSpec) -> None:
    spec.body("link_5").add_geom(name="egg", type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=[0.1, 0.2, 0.3])


def coupling(spec: mujoco.MjSpec) -> None:
    spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1="joint_1", name2="joint_2")


@pytest.mark.parametrize(("add", "word"), [(ball, "wrist"), (ellipsoid, "egg"), (coupling, "equality")])
def test_what_urdf_cannot_hold_is_refused_by_name(add: Callable[[mujoco.MjSpec], None], word: str) -> None:
    spec = REACHER.spec(REACHER.design_space.initial)
    spec.delete(spec.key("start"))  # its posture has no value for a joint that is added
    add(spec)
    with pytest.raises(ExportError, match=word):
        write_urdf(spec.compile(), "robot.urdf", "robot")


@pytest.mark.parametrize(
    ("before", "after", "finding"),
    [
        ('xyz="3.0 0.0 0.0"', 'xyz="3.000001 0.0 0.0"', "positions"),
        ('axis xyz="0.0 0.0 1.0"', 'axis xyz="0.0 0.0 -1.0"', "positions"),
        ('mass value="', 'mass value="1', "masses"),
        ('mass value="', 'mass value="-', "valid"),
        ('izz="0.0', 'izz="9.0', "inertias"),
        ('effort="500.0"', 'effort="5.0"', "efforts"),
        ('damping="1.0"', 'damping="0.0"', "dampings"),
        ('name="link_3"', 'name="link_x"', "can't be read"),
        ('<child link="link_4" />', '<child link="link_5" />', "valid"),
        ("</robot>", "", "can't be read"),
    ],
)
def test_a_broken_urdf_is_found_out(before: str, after: str, finding: str) -> None:
    model, files = export(REACHER.spec(REACHER.design_space.initial))
    text = files["robot.urdf"].decode()
    assert before in text
    broken = files | {"robot.urdf": text.replace(before, after, 1).encode()}
    assert any(finding in fault for fault in faults(verify(broken, model)))
    assert any(finding in fault for fault in faults(verify(broken))), "without the model, both files are compared"


def test_limits_in_the_wrong_order_and_a_missing_mesh_are_found_out() -> None:
    model, files = export(awkward_robot())
    text = files["robot.urdf"].decode()
    for lower in ("7.0", "much"):
        wrong = re.sub('lower="[^"]*"', f'lower="{lower}"', text, count=1)
        assert any("lower < upper" in fault for fault in faults(verify(files | {"robot.urdf": wrong.encode()}, model)))
    without = {name: content for name, content in files.items() if not name.startswith(MESHES)}
    assert any("is missing" in fault for fault in faults(verify(without, model)))


def test_a_broken_mjcf_is_found_out() -> None:
    model, files = export(REACHER.spec(REACHER.design_space.initial))
    text = files["robot.xml"].decode()
    broken = files | {"robot.xml": re.sub('mass="[1-9][^"]*"', 'mass="9"', text, count=1).encode()}
    assert any(fault.startswith("robot.xml in MuJoCo: masses") for fault in faults(verify(broken, model)))
