"""A stranger's bundle reads nothing outside of itself, takes no more than it may, and agrees where it is the same."""

import contextlib
import io
import json
import os
import re
import time
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from xml.etree import ElementTree

import msgspec
import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.catalogue import make_task
from studio.export.apart import prove_apart
from studio.export.archive import read_files, unzipped, zipped
from studio.export.bundle import robot_files
from studio.export.check import Check
from studio.export.design_file import Design, Value, read_design
from studio.export.errors import ExportError
from studio.export.proof import _prove_scene, prove
from studio.export.readings import read_mjcf, read_urdf
from studio.export.screen import screen
from studio.export.verify import POSITION_ALLOWED, compare
from studio.robots.chooser import robot_of
from studio.robots.stl import stl

TASK = make_task("reacher")
ROBOT = robot_of(TASK).file_name
XML = f"{ROBOT}.xml"
PACKAGE = "ros/reacher_description"


def design_json(robot: str = ROBOT) -> bytes:
    parameters = [
        Value(name=p.name, value=p.initial, unit=p.unit, lo=p.lo, hi=p.hi, locked_at=None, hard_lo=p.hard_lo,
              hard_hi=p.hard_hi, initial=p.initial)
        for p in TASK.design_space.parameters
    ]  # fmt: skip
    return msgspec.json.encode(
        Design(task="reacher", task_options={}, robot=robot, run="", design="", iteration=0, parameters=parameters)
    )


@pytest.fixture(scope="module")
def bundle() -> dict[str, bytes]:
    """The files of a reacher, and its design; there are no digests, which prove nothing of a stranger's bundle."""
    phi = np.array([p.initial for p in TASK.design_space.parameters])
    program = robot_of(TASK).program(phi)
    assert program is not None
    files = robot_files(TASK, phi, [], ("mjcf", "urdf", "ros", "ros2_control"))
    return files | {"design.json": design_json(), **program.sources}


def faults(files: Mapping[str, bytes]) -> list[str]:
    return [str(check) for check in prove(files, episodes=0) if not check.passed and "digests" not in check.name]


def test_an_honest_bundle_agrees(bundle: dict[str, bytes]) -> None:
    assert faults(bundle) == []


@settings(max_examples=40)
@given(st.data())
def test_a_scene_in_which_something_that_moves_or_touches_differs_is_told(
    bundle: dict[str, bytes], data: st.DataObject
) -> None:
    """Whether there is a policy to run in it or not."""
    root = ElementTree.fromstring(bundle["scene.xml"])
    touching = [e for e in root.iter("geom") if (e.get("contype"), e.get("conaffinity")) != ("0", "0")]
    numbers = [
        (element, name)
        for element in [*touching, *root.iter("joint"), *root.iter("inertial"), *root.iter("body")]
        for name in (
            "pos",
            "quat",
            "size",
            "mass",
            "diaginertia",
            "range",
            "damping",
            "armature",
            "contype",
            "friction",
        )
        if name in element.attrib and element.get("type") != "mesh" and (element.tag, name) != ("geom", "mass")
    ]
    element, name = data.draw(st.sampled_from(numbers))
    words = element.attrib[name].split()
    i = data.draw(st.integers(0, len(words) - 1))
    words[i] = repr(float(words[i]) * 2 + 0.5) if name != "contype" else str(int(words[i]) + 4)
    element.attrib[name] = " ".join(words)
    phi = np.array([p.initial for p in TASK.design_space.parameters])
    with contextlib.suppress(ValueError):  # MuJoCo's: it can't be built
        assert not _prove_scene({**bundle, "scene.xml": ElementTree.tostring(root)}, TASK, phi).passed


@settings(max_examples=40)
@given(st.data())
def test_a_shape_that_differs_is_told_where_others_of_its_link_hide_it(
    bundle: dict[str, bytes], data: st.DataObject
) -> None:
    root = ElementTree.fromstring(bundle[f"{ROBOT}.urdf"])
    shapes = list(root.iter("collision"))
    assert _farthest_shape(bundle, root) < 1e-9
    shape = data.draw(st.sampled_from(shapes))
    size = shape.find("geometry/*")
    origin = shape.find("origin")
    assert size is not None
    assert origin is not None
    numbers = [(size, name, 0) for name in size.attrib] + [(origin, "xyz", i) for i in range(3)]
    if size.tag != "sphere":
        numbers += [(origin, "rpy", i) for i in range(2)]  # a cylinder that is turned about itself is the same
    element, name, i = data.draw(st.sampled_from(numbers))
    words = element.attrib[name].split()
    words[i] = repr(float(words[i]) * data.draw(st.floats(0.1, 0.9)) + 0.001)
    element.attrib[name] = " ".join(words)
    assert _farthest_shape(bundle, root) > POSITION_ALLOWED


def _farthest_shape(bundle: Mapping[str, bytes], root: ElementTree.Element) -> float:
    """Return how far (m) the collision shapes of a URDF are from those of the bundle's MJCF."""
    reference = read_mjcf(mujoco.MjModel.from_xml_string(bundle[XML].decode()))
    reading = read_urdf(mujoco.MjModel.from_xml_string(ElementTree.tostring(root, "unicode")))
    (check,) = (c for c in compare("it", reference, reading) if "collision extents" in c.name)
    return check.worst


@pytest.mark.parametrize(
    ("file", "before", "after"),
    [
        (XML, 'kp="', 'kp="9'),
        (XML, 'armature="', 'armature="9'),
        (XML, 'damping="', 'damping="9'),
        (XML, 'conaffinity="2"', 'conaffinity="3"'),
        (f"{ROBOT}.urdf", 'friction="0.0"', 'friction="0.9"'),
        (f"{ROBOT}.urdf", 'damping="', 'damping="9'),
    ],
)
def test_a_joint_or_servo_of_another_kind_is_told(bundle: dict[str, bytes], file: str, before: str, after: str) -> None:
    changed = bundle[file].replace(before.encode(), after.encode(), 1)
    assert changed != bundle[file]
    assert faults({**bundle, file: changed})


def test_of_what_is_read_nothing_is_kept(bundle: dict[str, bytes]) -> None:
    """MuJoCo keeps meshes by their path: a server that exports would grow by 500 MB."""
    prove(bundle, episodes=0)
    assert mujoco.mj_getCacheCapacity(mujoco.mj_getCache()) == 0


def inserted(text: str, where: str = "</mujoco>") -> Callable[[bytes], bytes]:
    return lambda content: content.replace(where.encode(), text.encode() + where.encode(), 1)


OUTSIDE = ["/etc/passwd", "../../x", "a/../../x", "~/x", "C:/x", "..\\x", "file:///etc/passwd", "\\\\host\\x"]
REPLICATE = '<replicate count="4000" offset="1 0 0">' * 2 + '<geom size=".1"/>' + "</replicate>" * 2
ASKS = {
    **{f"include {p}": (XML, inserted(f'<include file="{p}"/>')) for p in OUTSIDE},
    **{f"mesh {p}": (XML, inserted(f'<asset><mesh name="x" file="{p}"/></asset>')) for p in OUTSIDE},
    "meshdir": (XML, inserted('<compiler meshdir="/etc"/>')),
    "a file that is not there": (XML, inserted('<asset><mesh name="x" file="x.stl"/></asset>')),
    "replicate": (XML, inserted(REPLICATE, "</worldbody>")),
    "replicate in the scene": ("scene.xml", inserted(REPLICATE, "</worldbody>")),
    "hfield": (XML, inserted('<asset><hfield name="h" nrow="60000" ncol="60000" size="1 1 1 1"/></asset>')),
    "texture": (XML, inserted('<asset><texture builtin="flat" width="99999" height="99999"/></asset>')),
    "plugin": (XML, inserted('<extension><plugin plugin="mujoco.sdf.bolt"/></extension>')),
    "flexcomp": (XML, inserted('<flexcomp count="999 999 99" name="f" type="grid"/>', "</worldbody>")),
    "nan": (XML, inserted('<option timestep="nan"/>')),
    "infinity": (XML, inserted('<option gravity="0 0 1e999"/>')),
    "entities": (XML, lambda content: b'<!DOCTYPE x [<!ENTITY a "b">]>' + content),
    "utf-16": (XML, lambda content: content.decode().encode("utf-16")),
    "no xml": (XML, lambda content: content[: len(content) // 2]),
    "in the archive": (
        f"{ROBOT}.mjz",
        lambda content: zipped(
            (files := unzipped(content)) | {"model.xml": inserted('<include file="/etc/x.xml"/>')(files["model.xml"])}
        ),
    ),
    "a bomb in the archive": (f"{ROBOT}.mjz", lambda _: zipped({"model.xml": bytes(9 << 20)})),
    "urdf mesh": (
        f"{ROBOT}.urdf",
        inserted('<link name="x"><visual><geometry><mesh filename="/x.stl"/></geometry></visual></link>', "</robot>"),
    ),
}


@pytest.mark.parametrize("ask", ASKS)
def test_no_reader_sees_what_asks_for_more_than_a_bundle_needs(
    bundle: dict[str, bytes], ask: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, change = ASKS[ask]
    changed = change(bundle[path])
    assert changed != bundle[path]

    def never(*_: object, **__: object) -> None:
        raise AssertionError("a reader has seen it")

    if "bomb" in ask:
        monkeypatch.setattr("studio.export.screen.MAX_BYTES", 8 << 20)
    for reader in ("verify_folder", "check_anew", "check_parts"):
        monkeypatch.setattr(f"studio.export.proof.{reader}", never)
    found = faults(bundle | {path: changed})
    assert found
    assert all("asks for nothing outside" in fault for fault in found), found


def replaced(before: str, after: str) -> Callable[[bytes], bytes]:
    """Return a change of a file: the first `before` becomes `after`."""

    def replace(content: bytes) -> bytes:
        assert before.encode() in content
        return content.replace(before.encode(), after.encode(), 1)

    return replace


DIFFERS = {
    "gravity and timestep": (XML, inserted('<option gravity="0 0 99" timestep="0.5"/>'), "physics options"),
    "flags of the scene": ("scene.xml", inserted('<option><flag contact="disable"/></option>'), "physics options"),
    "one more body": (XML, inserted('<body name="b"><geom size=".1"/></body>', "</worldbody>"), "physics"),
    "one more shape": (XML, inserted('<geom size=".1" pos="9 9 9"/>', "</worldbody>"), "physics"),
    "one more link": (
        f"{ROBOT}.urdf",
        inserted(
            '<link name="added"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
            '</inertial></link><joint name="j" type="revolute"><parent link="link_1"/><child link="added"/>'
            '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>',
            "</robot>",
        ),
        "nothing added",
    ),
    "another servo in the archive": (
        f"{ROBOT}.mjz",
        lambda content: zipped(
            (files := unzipped(content)) | {"model.xml": files["model.xml"].replace(b'kp="', b'kp="9', 1)}
        ),
        f"{ROBOT}.mjz: holds",
    ),
    "another launch file": (f"{PACKAGE}/launch/display.launch.py", lambda c: c + b"1\n", "this version writes"),
    "a launch file more": (f"{PACKAGE}/launch/x.launch.py", lambda _: b"1\n", "this version writes"),
    "another build": (f"{PACKAGE}/CMakeLists.txt", lambda c: c + b"include(x)\n", "this version writes"),
    "another speed in the package": (
        f"{PACKAGE}/urdf/{ROBOT}.urdf",
        lambda content: content.replace(b'velocity="', b'velocity="9', 1),
        f"{ROBOT}.urdf: speeds",
    ),
    "another limit of a servo": (
        f"{ROBOT}.urdf",
        lambda content: content.replace(b"<mechanicalReduction>1<", b"<mechanicalReduction>9<", 1),
        "transmissions and interfaces",
    ),
    "a joint that follows another": (
        f"{ROBOT}.urdf",
        inserted('<mimic joint="joint_1"/>', "</joint>"),
        "which no export has",
    ),
    "a driver that is loaded": (
        f"{ROBOT}.urdf",
        lambda content: content.replace(b"mock_components/", b"evil_components/", 1),
        "transmissions and interfaces",
    ),
    "a servo too few": (
        f"{PACKAGE}/urdf/{ROBOT}.urdf",
        lambda content: re.sub(rb"<transmission .*?</transmission>", b"", content, count=1, flags=re.DOTALL),
        "transmissions and interfaces",
    ),
    **{
        f"a number that only {file} has: {after}": (file, replaced(before, after), finding)
        for file in (XML, "scene.xml")
        for before, after, finding in (
            ("<joint ", '<joint springref="0.5" ', "qpos_spring"),
            ("<joint ", '<joint margin="0.1" ', "jnt_margin"),
            ("<joint ", '<joint solreflimit="0.1 1" ', "jnt_solref"),
            ("<joint ", '<joint actuatorgravcomp="true" ', "jnt_actgravcomp"),
            ("<worldbody>", '<default><geom solmix="2"/></default><worldbody>', "geom_solmix"),
            ("<position ", '<position ctrlrange="-9 9" ', "actuator_ctrl"),
            ('<key name="start" qpos="', '<key name="start" time="1" qpos="', "key_time"),
            ('<key name="start"', '<key name="begin"', "not first of all the keys start"),
            ('<position name="', '<position name="other_', "the actuator joint_1 is called other_joint_1"),
            ('joint="joint_1"', 'joint="joint_2"', "actuator_trnid"),
        )
    },
    "a base that floats": (f"{ROBOT}.urdf", replaced('type="fixed"', 'type="floating"'), "how links are joined"),
    "a base that floats in ROS": (
        f"{PACKAGE}/urdf/{ROBOT}.urdf",
        replaced('type="fixed"', 'type="floating"'),
        "how links are joined",
    ),
    "a shape that is shown elsewhere": (
        f"{ROBOT}.urdf",
        lambda c: re.sub(rb'(<visual>\s*<origin xyz=")[^"]*', rb"\g<1>0 0 1", c, count=1),
        "is shown",
    ),
    "two limits": (f"{ROBOT}.urdf", replaced("<limit ", '<limit lower="-9" upper="9"/><limit '), "has two <limit>"),
    "a long axis": (f"{ROBOT}.urdf", replaced('<axis xyz="0.0 0.0 1.0"', '<axis xyz="0 0 2"'), "is no unit vector"),
    "another gain beside the URDF": ("control.json", replaced('"kp": ', '"kp": 9'), "control.json: what it says"),
    "a joint less beside the URDF": ("control.json", replaced('"joint_1"', '"joint_9"'), "joints joint_1"),
    "a part of nobody": ("parts/wing.stl", lambda _: stl(np.eye(4, 3), np.eye(1, 3, dtype=int), ""), "of no part"),
    "another program": ("run_policy.py", lambda content: content + b"\nimport os\n", "run_policy.py"),
    "a file more": ("run.sh", lambda _: b"#!/bin/sh\n", "belongs to an export"),
    "another robot's name": ("design.json", lambda _: design_json("../../../tmp/x"), "design.json: robot"),
    "an absolute name": ("design.json", lambda _: design_json("/tmp/x"), "design.json: robot"),
}


@pytest.mark.parametrize("what", DIFFERS)
def test_what_is_in_a_file_and_not_in_the_design_is_found(bundle: dict[str, bytes], what: str) -> None:
    path, change, finding = DIFFERS[what]
    found = faults(bundle | {path: change(bundle.get(path, b""))})
    assert any(finding in fault for fault in found), found


def test_what_nothing_depends_on_may_differ(bundle: dict[str, bytes]) -> None:
    changes = [
        replaced("<worldbody>", "<!-- mine --><worldbody>"),
        replaced("<worldbody>", '<default><site rgba="1 0 0 1"/></default><worldbody>'),
        replaced("</worldbody>", '<camera name="c"/><light name="l"/><site name="s"/></worldbody>'),
        replaced("</worldbody>", '<geom name="ball" size=".01" contype="0" conaffinity="0" mass="0"/></worldbody>'),
        replaced("<actuator>", '<sensor><jointpos name="q" joint="joint_1"/></sensor><actuator>'),
        lambda content: re.sub(rb'(<key name="start"([^>]*)/>)', rb'\1<key name="again"\2/>', content),
        lambda content: re.sub(rb'rgba="[^"]*"', b'rgba="1 0 0 1"', content),
    ]
    files = {path: content for path, content in bundle.items() if path != f"{ROBOT}.mjz"}
    for path in (XML, "scene.xml"):
        for change in changes:
            files[path] = change(files[path])
    urdf = ElementTree.fromstring(files[f"{ROBOT}.urdf"])
    urdf[:] = [*reversed(urdf)]
    files[f"{ROBOT}.urdf"] = ElementTree.tostring(urdf)
    files["control.json"] = msgspec.json.encode(msgspec.json.decode(files["control.json"]))
    assert faults(files) == []


def test_a_reader_that_takes_too_long_is_ended(bundle: dict[str, bytes]) -> None:
    began = time.monotonic()
    dense = trimesh.creation.icosphere(subdivisions=7).export(file_type="stl")  # 330,000 triangles
    meshes = {f"parts/link_{number}.stl": dense for number in range(1, 6)}  # several times the second that is allowed
    [check] = prove_apart({**bundle, **meshes}, episodes=0, seconds=1)
    assert "given up" in check.detail
    assert not check.passed
    assert time.monotonic() - began < 60


def test_a_bundle_that_needs_more_memory_than_is_allowed_is_given_up(bundle: dict[str, bytes]) -> None:
    checks = prove_apart(bundle, episodes=0, memory=64 << 20)
    # whoever meets the limit first says it in its own words; how many readers go on after that depends on the machine
    refused = [check.detail for check in checks if not check.passed and "memory" in check.detail.lower()]
    assert refused, checks
    assert all("can't be read" in detail for detail in refused)


def test_a_bundle_proved_apart_says_what_it_says_here(bundle: dict[str, bytes]) -> None:
    def told(checks: list[Check]) -> dict[str, tuple[bool, str]]:
        return {check.name: (check.passed, check.detail) for check in checks}

    assert told(prove_apart(bundle, episodes=0)) == told(prove(bundle, episodes=0))


# --- archives ---

DESIGN_ZIP = zipped({"design.json": design_json(), "robot.xml": b"<mujoco/>" * 50})


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_any_mutated_archive_is_read_or_refused_with_our_error(data: st.DataObject) -> None:
    content = bytearray(DESIGN_ZIP)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        piece = data.draw(st.sampled_from([b"\xff" * 8, b"\x00" * 8, b"PK\x03\x04", bytes([at % 256])]))
        content[at : at + len(piece)] = piece
    for read in (read_design, unzipped):
        with contextlib.suppress(ExportError):
            read(bytes(content))


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_broken_stream_is_refused_whatever_packed_it(method: int) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        archive.writestr("design.json", json.dumps(list(range(2000))))
    content = bytearray(buffer.getvalue())
    content[60:68] = b"\xff" * 8
    with pytest.raises(ExportError, match=r"no zip that can be read|deflate it"):
        unzipped(bytes(content))


@pytest.mark.parametrize("names", [("robot.xml", "robot.xml/x"), ("a/b", "a"), ("a", "a"), ("x\0y", "z")])
def test_files_that_can_not_lie_beside_one_another_are_refused(names: tuple[str, str]) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive, pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *_, **__: None)
        for name in names:
            archive.writestr(name, b"")
    content = buffer.getvalue()
    if "\0" in names[0]:  # zipfile cuts such a name itself
        assert set(unzipped(content)) == {"x", "z"}
        return
    with pytest.raises(ExportError, match="twice, or as a file and as a folder"):
        unzipped(content)


def test_only_the_design_of_a_bundle_is_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    content = zipped({"design.json": design_json(), "zeros": bytes(20 << 20)})
    read: list[int] = []
    decompress = zlib.decompressobj

    def counted(wbits: int) -> object:
        read.append(1)
        return decompress(wbits)

    monkeypatch.setattr("zipfile.zlib.decompressobj", counted)
    assert read_design(content).task == "reacher"
    assert len(read) == 1
    with pytest.raises(ExportError, match="at most"):
        read_design(zipped({"design.json": bytes(5 << 20)}))


def test_a_bundle_that_is_no_plain_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ExportError, match="no file and no folder"):
        read_files(tmp_path / "pipe")


def test_screening_says_nothing_of_what_readers_are_for() -> None:
    assert all(check.passed for check in screen({"parts/x.stl": b"rubbish", "README.txt": b""}, ROBOT))
