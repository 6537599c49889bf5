"""A bundle beside what this version makes of its design: every number by which a robot moves, is driven and touches.

What nothing depends on may differ: comments, the order of what goes by names, colours, cameras, lights, shapes and
sensors that are added. MuJoCo reads both files beside the same meshes, so that a mesh is compared elsewhere, once.
"""

import csv
import hashlib
import io
import json
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import mujoco
import numpy as np
from manifold3d import Manifold, Mesh64

from morph_core.task import Task
from studio.export.archive import unpack
from studio.export.check import Check, relative, worst
from studio.export.check_prints import Surface
from studio.export.design_file import Design, PartEntry
from studio.export.mjcf import oldest_reader
from studio.export.plates import PIECES
from studio.export.provenance import Provenance
from studio.export.ros import FOLDER, in_packages, plain_urdf
from studio.export.simulated import simulated_files
from studio.robots.parts import MILLIMETRE, STL_FOLDER, Part
from studio.robots.robot import Program

NUMBERS_ALLOWED = 1e-9
"""Largest difference of two numbers that mean the same; relative in JSON, in the units of MuJoCo in a model."""
UNLIKE_ALLOWED = 1e-4
"""Share of a part's volume in which its file may differ from the drawing: STL is single precision."""
PART_FOLDERS = (f"{STL_FOLDER}/", "3mf/", "step/")
"""Folders with one file for each part, as far as there are any."""
_SAME_CORNER = 1e-6
"""mm: two corners nearer to each other are one, which need not be compared as solids."""
_MATERIAL = (
    "body_", "jnt_", "dof_", "geom_", "site_", "tendon_", "wrap_", "actuator_", "sensor_", "eq_", "pair_", "exclude_",
    "key_", "flex_", "qpos0", "qpos_spring", "plugin",
)  # fmt: skip
"""How the names of a model's fields begin on which its physics, or what is read from it by name, depends."""
_LOOKS = (
    "_rgba", "_matid", "_group", "_user", "_castshadow", "_bvhadr", "_bvhnum", "adr", "_geomnum", "_dataid", "_width",
)  # fmt: skip
"""How those of them end that only tell how it looks, or where MuJoCo keeps something."""
_BY_NAME = {"site": "site_", "sensor": "sensor_", "key": "key_"}
"""Kinds of which a file may have more than the export has: sites anywhere, others at the end, as they go by number."""
_NAMED = ("body", "jnt", "tendon", "actuator", "eq")
"""Kinds that go by their names, in their order."""


def check_anew(
    files: Mapping[str, bytes], task: Task, phi: np.ndarray, design: Design, parts: Sequence[Part]
) -> list[Check]:
    """Compare the robot's files with those that are made here of the `parts` of a design (d,)."""
    robot = design.robot
    kinds = {"mjcf": (f"{robot}.xml", "scene.xml"), "urdf": (f"{robot}.urdf",), "ros": in_packages(files, robot)}
    formats = [kind for kind, paths in kinds.items() if any(path in files for path in paths)]
    known = {part.name for part in design.parts}
    anew = simulated_files(task, phi, [part for part in parts if part.name in known], [*formats, "ros2_control"])
    checks: list[Check] = []
    for path in kinds["mjcf"]:
        if path in files:
            checks += check_model(path, anew[path], files)
    for path in (f"{robot}.urdf", *kinds["ros"]):
        if path in files:
            checks += _check_urdf(path, anew.get(path), files[path])
    if "control.json" in files:
        checks.append(check_json("control.json", json.loads(anew["control.json"]), files["control.json"]))
    return checks


def check_model(path: str, anew: bytes, files: Mapping[str, bytes]) -> list[Check]:
    """Compare what MuJoCo reads in an MJCF file with what it reads in one that was made `anew`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        unpack({**files, "anew.xml": anew}, folder)
        known, found = (mujoco.MjModel.from_xml_path(str(folder / file)) for file in ("anew.xml", path))
    fields = worst(f"{path}: physics options and what there is", NUMBERS_ALLOWED, model_differences(known, found))
    return [fields, _counted(f"{path}: names", list(_other_names(known, found)))]


def model_differences(known: mujoco.MjModel, found: mujoco.MjModel) -> dict[str, float]:
    """Return the largest difference of two models by field; infinity where one has more of something."""
    off: dict[str, float] = {}
    for option in (option for option in dir(known.opt) if not option.startswith("_")):
        off[option] = _apart(getattr(known.opt, option), getattr(found.opt, option))
    rows = {kind: _rows_by_name(known, found, kind) for kind in _BY_NAME}
    touching = [np.flatnonzero((m.geom_contype != 0) | (m.geom_conaffinity != 0)) for m in (known, found)]
    for field in dir(known):
        one = getattr(known, field, None)
        if not isinstance(one, np.ndarray) or not field.startswith(_MATERIAL) or field.endswith(_LOOKS):
            continue
        other = np.asarray(getattr(found, field))
        if field.startswith("geom_"):
            one, other = one[touching[0]], other[touching[1]]
        for kind, begins in _BY_NAME.items():
            if field.startswith(begins):
                one, other = one[rows[kind][0]], other[rows[kind][1]]
        off[field] = _apart(one, other)
    return off | _shown_differences(known, found)


def _rows_by_name(known: mujoco.MjModel, found: mujoco.MjModel, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of a kind of things in two models: those of the first, and those of the same names."""
    count = int(getattr(known, f"n{kind}"))
    names = _names(found, kind)
    same = [names.index(name) for name in _names(known, kind) if name in names]
    return np.arange(count), np.array(same, dtype=int)


def _shown_differences(known: mujoco.MjModel, found: mujoco.MjModel) -> dict[str, float]:
    """Return how far the shapes that are only shown are from their places and sizes; others may be added."""
    off: dict[str, float] = {}
    names = _names(found, "geom")
    for g in np.flatnonzero((known.geom_contype == 0) & (known.geom_conaffinity == 0)):
        name = known.geom(g).name
        if not name:
            continue
        where = names.index(name) if name in names else -1
        fields = ("geom_bodyid", "geom_type", "geom_pos", "geom_quat", "geom_size", "geom_aabb")
        apart = [_apart(getattr(known, field)[g], getattr(found, field)[where]) for field in fields]
        off[f"{name}, which is shown"] = max(apart) if where >= 0 else math.inf
    return off


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    count = model.njnt if kind == "jnt" else getattr(model, f"n{'u' if kind == 'actuator' else kind}")
    return [getattr(model, kind)(i).name for i in range(count)]


def _other_names(known: mujoco.MjModel, found: mujoco.MjModel) -> Iterator[str]:
    for kind in _NAMED:
        for one, other in zip(_names(known, kind), _names(found, kind), strict=False):
            if one != other:
                yield f"the {kind.replace('jnt', 'joint')} {one} is called {other or 'nothing'}"
    for kind in _BY_NAME:
        own, there = _names(known, kind), _names(found, kind)
        if (not set(own) <= set(there)) if kind == "site" else there[: len(own)] != own:
            yield f"it has not first of all the {kind}s {', '.join(own)}"


def _apart(one: Any, other: Any) -> float:
    one, other = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    if one.shape != other.shape:
        return math.inf
    with np.errstate(invalid="ignore"):
        return float(np.where(one == other, 0.0, np.abs(one - other)).max(initial=0.0))


def _check_urdf(path: str, anew: bytes | None, content: bytes) -> list[Check]:
    """Compare the shapes that a URDF shows, by their files, scales, sizes and places, and how its links are joined."""
    if anew is None:
        return [Check(f"{path}: what is shown", math.inf, 0.0, "no export has it under this name")]
    if path.startswith(f"{FOLDER}/"):
        anew, content = plain_urdf(path, anew), plain_urdf(path, content)
    known, found = (ElementTree.fromstring(text) for text in (anew, content))
    shown, joined = ((tell(known), tell(found)) for tell in (_shown, _joined))
    return [
        _compare_tables(f"{path}: what is shown", *shown),
        _compare_tables(f"{path}: how links are joined", *joined),
    ]


def _compare_tables(name: str, known: Mapping[str, object], found: Mapping[str, object]) -> Check:
    return _counted(name, [key for key in known.keys() | found.keys() if known.get(key) != found.get(key)])


def _joined(root: ElementTree.Element) -> dict[str, object]:
    """Return the type, parent and child of each joint of a URDF."""
    ends = {joint: [joint.find(end) for end in ("parent", "child")] for joint in root.findall("joint")}
    return {
        joint.get("name", ""): [joint.get("type"), *("" if end is None else end.get("link") for end in found)]
        for joint, found in ends.items()
    }


def _shown(root: ElementTree.Element) -> dict[str, list[object]]:
    """Return what each link of a URDF shows, without its colours, with numbers of nine digits."""
    shown: dict[str, list[object]] = {}
    for link in root.findall("link"):
        entries = []
        for visual in link.findall("visual"):
            origin = visual.find("origin")
            place = {} if origin is None else origin.attrib
            shapes = [(shape.tag, sorted((k, _plain(v)) for k, v in shape.attrib.items()))
                      for shape in visual.findall("geometry/*")]  # fmt: skip
            entries.append((_plain(place.get("xyz", "0 0 0")), _plain(place.get("rpy", "0 0 0")), shapes))
        shown[link.get("name", "")] = sorted(entries)
    return shown


def _plain(words: str) -> str:
    """Return numbers in the same words whoever has written them; other words as they are."""
    try:
        return " ".join(f"{round(float(word), 9) + 0.0:.9g}" for word in words.split())
    except ValueError:
        return words


def check_json(path: str, known: Any, content: bytes) -> Check:
    """Compare a JSON file with what it must hold, entry by entry."""
    try:
        found = msgspec.json.decode(content)
    except (ValueError, RecursionError) as error:
        return Check(f"{path}: what it says", math.inf, 0.0, f"can't be read: {error}")
    return _counted(f"{path}: what it says", list(_other_entries(known, found, "")))


def _other_entries(known: Any, found: Any, where: str) -> Iterator[str]:
    """Yield where two JSON documents differ."""
    if isinstance(known, dict) and isinstance(found, dict):
        for key in known.keys() | found.keys():
            if key not in known or key not in found:
                yield f"{where} {key}".strip()[:80]
            else:
                yield from _other_entries(known[key], found[key], f"{where} {key}")
    elif isinstance(known, list) and isinstance(found, list) and len(known) == len(found):
        for i, (one, other) in enumerate(zip(known, found, strict=True)):
            yield from _other_entries(one, other, f"{where} {i + 1}")
    elif not _same(known, found):
        yield where.strip()[:80]


def _same(known: object, found: object) -> bool:
    if isinstance(known, bool | str) or not isinstance(known, int | float) or not isinstance(found, int | float):
        return type(known) is type(found) and known == found
    return math.isclose(known, found, rel_tol=NUMBERS_ALLOWED, abs_tol=1e-12)


def check_parts(files: Mapping[str, bytes], design: Design, parts: Sequence[Part]) -> list[Check]:
    """Compare the list of parts with what is drawn of the design, and with the files that there are."""
    listed = {part.name: part for part in design.parts}
    drawn = {part.name: PartEntry(part.name, list(part.links), part.inertial.mass, part.density) for part in parts}
    faults = [f"{name} is drawn, and not listed" for name in sorted(drawn.keys() - listed.keys())] if listed else []
    for name, entry in listed.items():
        if name not in drawn:
            faults.append(f"{name[:60]} is no part of this design")
        elif entry.links != drawn[name].links:
            faults.append(f"{name} is not made for {', '.join(entry.links)[:60]}")
        elif relative({"": (drawn[name].mass, drawn[name].density)}, {"": (entry.mass, entry.density)})[""] > 1e-6:
            faults.append(f"{name} does not weigh what it says")
    for folder in PART_FOLDERS:
        there = {Path(path).stem for path in files if path.startswith(folder)}
        odd = sorted(there ^ listed.keys()) if there else []
        faults += [f"{folder}{name[:60]} is {'missing' if name in listed else 'of no part'}" for name in odd]
    return [_counted("design.json: parts", faults)]


def unlike(surface: Surface, part: Part) -> float:
    """Return the share of a part's volume in which a surface (m) differs from its drawing; infinity for no solid."""
    vertices, faces = surface[0] / MILLIMETRE, surface[1]
    if np.array_equal(faces, part.faces) and np.allclose(vertices, part.vertices, rtol=0, atol=_SAME_CORNER):
        return 0.0
    return _volume_between(vertices, faces, part, both=True)


def beyond(surface: Surface, part: Part) -> float:
    """Return the share of a part's volume by which one of its pieces (m) reaches out of its drawing."""
    return _volume_between(surface[0] / MILLIMETRE, surface[1], part, both=False)


def _volume_between(vertices: np.ndarray, faces: np.ndarray, part: Part, *, both: bool) -> float:
    solid = Manifold(Mesh64(np.ascontiguousarray(vertices, dtype=float), faces.astype(np.uint64)))
    if solid.is_empty():
        return math.inf
    volume = (solid - part.solid).volume() + ((part.solid - solid).volume() if both else 0.0)
    return volume / part.solid.volume()


def check_program_arrays(content: bytes, program: Program, horizon: int, layers: int) -> Check:
    """Compare what policy.npz tells the program that runs it, beside the policy, with what this version writes."""
    orientation = -1 if program.orientation is None else program.orientation
    known = {**program.units, **program.arrays, "horizon": np.array(horizon), "orientation": np.array(orientation)}
    own = {"std", *(f"{name}_{i}" for name in ("weight", "bias") for i in range(layers))}
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        faults = [f"{name[:60]} belongs to no policy" for name in sorted(set(arrays) - known.keys() - own)]
        for name, array in known.items():
            if name not in arrays:
                faults.append(f"{name} is missing")
            elif array.dtype.kind == "U":
                faults += [name] * (arrays[name].tolist() != array.tolist())
            elif not _apart(array, arrays[name]) <= NUMBERS_ALLOWED:
                faults.append(f"{name} is another")
    return _counted("policy.npz: what the program is told", faults)


def check_provenance(files: Mapping[str, bytes], design: Design, content: bytes) -> Check:
    """Compare what provenance.json says with what can be seen in the other files."""
    try:
        said = msgspec.json.decode(content, type=Provenance)
    except (ValueError, RecursionError) as error:
        return Check("provenance.json: of this design", math.inf, 0.0, f"can't be read: {error}")
    known = {"run": design.run, "iteration": design.iteration, "task": design.task, "task_options": design.task_options}
    texts = [text for path, text in files.items() if path.endswith(".xml") and "/" not in path]
    known["commands_sha256"] = hashlib.sha256(msgspec.json.encode(said.commands)).hexdigest()
    known["oldest_mujoco"] = oldest_reader(texts) if texts else ""
    if PIECES in files:
        rows = csv.DictReader(io.StringIO(files[PIECES].decode()))
        known["printer"] = ", ".join(sorted({row["printer"] for row in rows}))
    return _counted("provenance.json: of this design", [key for key in known if getattr(said, key) != known[key]])


def _counted(name: str, faults: list[str]) -> Check:
    return Check(name, float(len(faults)), 0.0, f"differ: {'; '.join(sorted(faults)[:3])}" if faults else "")
