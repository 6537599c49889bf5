"""A MuJoCo model as MJCF text with exact numbers, in words that old versions read too, and the meshes it refers to."""

import json
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import mujoco
import numpy as np

from studio.export.errors import ExportError
from studio.robots.stl import stl

OLD = "3.2"
"""The oldest MuJoCo whose words are known: the file below has those of 3.2.7, as its `mj_printSchema` gives them."""
_WORDS = Path(__file__).parent / "shipped" / "mjcf_3_2.json"
_ONE_NUMBER = frozenset(f"{kind}/{name}" for kind in ("joint", "fixed", "spatial") for name in ("damping", "stiffness"))
_KEYWORDS = {"mesh/inertia": frozenset(("convex", "exact", "legacy"))}
"""Attributes, behind their elements, of which MuJoCo 3.2 takes one number, or fewer keywords than newer versions."""
_BODIES = ("worldbody", "body", "frame", "replicate")
_STAND_IN = stl(np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), "stand-in")


def write_mjcf(
    spec: mujoco.MjSpec, name: str, folder: str, files: Mapping[str, bytes] | None = None
) -> dict[str, bytes]:
    """Return {`name`: XML, `folder`/...: meshes} and leave the spec alone. Raise ExportError if it can't be built.

    Meshes that are in `files` already stay where they are.
    """
    spec, shared = spec.copy(), dict(files or {})
    # Numbers as authored (exact when read again); the compiled form is printed with seven digits.
    spec.compiler.savecompiled = False
    own: dict[str, bytes] = {}
    for i, mesh in enumerate(spec.meshes):
        if mesh.file and mesh.file not in shared:
            path = f"{folder}/{i}_{PurePosixPath(mesh.file).name}"
            own[path] = _mesh_file(spec, mesh.file)
            mesh.file = path
    spec.meshdir = ""
    try:
        # What is written is the meshes' names: to compile them all would take long, and the proof reads them.
        spec.assets = {**dict.fromkeys(shared, _STAND_IN), **own}
        spec.compile()
        return {name: in_old_words(spec.to_xml()), **own}
    except (ValueError, mujoco.FatalError) as error:
        raise ExportError(f"MuJoCo can't build this design: {error}") from error


def in_old_words(text: str) -> bytes:
    """Return MJCF with position servos called so, and without sensors that MuJoCo 3.2 lacks, which move nothing."""
    root = ElementTree.fromstring(text)
    for actuator in root.findall("actuator/general"):
        _name_servo(actuator)
    for actuator in root.iter("general"):
        actuator.attrib.pop("input", None)  # it says what a command means, and moves nothing
    for sensors in root.findall("sensor"):
        for sensor in [*sensors]:
            if f"sensor/{sensor.tag}" not in _old_words():
                sensors.remove(sensor)
        if not len(sensors):
            root.remove(sensors)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8") + b"\n"


def oldest_reader(texts: Iterable[bytes]) -> str:
    """Return the oldest MuJoCo that knows every word of some MJCF files: 3.2, or the one that wrote them."""
    new = any(new_words(ElementTree.fromstring(text)) for text in texts)
    return mujoco.__version__ if new else OLD


def new_words(root: ElementTree.Element) -> list[str]:
    """Return the elements, attributes and values of MJCF that MuJoCo 3.2 does not know."""
    known, new, todo = _old_words(), list[str](), [("", root)]
    while todo:
        parent, element = todo.pop()
        word = f"{'body' if parent in _BODIES else parent}/{element.tag}"
        if word not in known:
            new.append(word)
            continue
        new += [f"{word} {name}" for name in element.attrib if name not in known[word]]
        new += [f"{word} {name}={value}" for name, value in element.attrib.items() if _is_new(element.tag, name, value)]
        todo += [(element.tag, child) for child in element]
    return new


def _is_new(element: str, name: str, value: str) -> bool:
    where = f"{element}/{name}"
    return (where in _ONE_NUMBER and len(value.split()) > 1) or value not in _KEYWORDS.get(where, {value})


def _name_servo(actuator: ElementTree.Element) -> None:
    """Turn the general form in which MuJoCo writes a position servo into the word for it."""
    gain, bias = actuator.get("gainprm", "1").split(), [*actuator.get("biasprm", "0").split(), "0", "0"]
    kp, kv = float(gain[0]), -float(bias[2])
    plain = {"dyntype", "dynprm", "gaintype", "actdim"}.isdisjoint(actuator.keys())
    servo = len(gain) == 1 and [float(x) for x in bias[:2]] == [0.0, -kp] and kv >= 0 and not any(map(float, bias[3:]))
    if actuator.get("biastype") != "affine" or not servo or not plain or actuator.get("input", "pos") != "pos":
        return
    for name in ("input", "biastype", "gainprm", "biasprm"):
        actuator.attrib.pop(name, None)
    actuator.tag = "position"
    actuator.attrib |= {"kp": gain[0], "kv": bias[2].removeprefix("-")}


@cache
def _old_words() -> dict[str, frozenset[str]]:
    """Return the attributes of each element that MuJoCo 3.2 knows, by "parent/element"."""
    words: dict[str, str] = json.loads(_WORDS.read_bytes())
    return {word: frozenset(names.split()) for word, names in words.items()}


def _mesh_file(spec: mujoco.MjSpec, file: str) -> bytes:
    if file in spec.assets:
        return spec.assets[file]
    try:
        return (Path(spec.modelfiledir) / spec.meshdir / file).read_bytes()
    except OSError as error:
        raise ExportError(f"the mesh {file} can't be read: {error.strerror}") from error
