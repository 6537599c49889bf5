"""Whether print files are fit to print: each part as often as needed, inside the printer, and none over another."""

import csv
import io
import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from manifold3d import Manifold, Mesh64

from studio.export.check import Check, worst
from studio.export.coupon import NAME as COUPON
from studio.export.design_file import PartEntry
from studio.export.pieces import piece_names
from studio.export.plates import FOLDER, PIECES
from studio.export.printers import printer_of
from studio.robots.parts import MILLIMETRE

Surface = tuple[np.ndarray, np.ndarray]
"""A closed surface: vertices (V, 3) m and faces (F, 3)."""
OFF_ALLOWED = 1e-6
"""Largest distance (mm) by which a body may reach out of the printer, and area (mm^2) that may lie over another."""
SIZES_ALLOWED = 0.051
"""mm: how far a size in the table of pieces, which has tenths, may be from that of the piece."""
BENT_ALLOWED = 1e-9
"""Largest difference between what a body is turned by and a rotation: nothing on a plate is stretched or mirrored."""


def check_part_file(path: str, scene: Any, part: PartEntry) -> tuple[dict[str, Surface], Check]:
    """Return the surfaces of a part's 3MF, read as a `scene`, and the check of what else that says of it.

    There is one, whose name is the path, or one for each piece of a part that is printed in several.
    """
    names = piece_names(part.name, len(scene.geometry))
    copies = Counter(scene.graph[node][1] for node in scene.graph.nodes_geometry)
    sound = copies == dict.fromkeys(names, len(part.links)) and scene.units == "millimeter"
    said = f"{', '.join(f'{count} x {name}' for name, count in copies.items())} in {scene.units}"
    surfaces = {
        path if len(names) == 1 else f"{path} {name}": (mesh.vertices * MILLIMETRE, np.asarray(mesh.faces))
        for name, mesh in scene.geometry.items()
    }
    return surfaces, Check(f"{path}: quantity, name and unit", float(not sound), 0.0, said)


def check_plates(files: Mapping[str, bytes], parts: Sequence[PartEntry], read: Callable[[str], Any]) -> list[Check]:
    """Check the plates of a bundle, and how the parts lie in their own files; a part with a problem is on no plate.

    `read` returns a 3MF by its path as a scene.
    """
    rows = {row["piece"]: row for row in csv.DictReader(io.StringIO(files[PIECES].decode()))}
    checks: list[Check] = []
    found: Counter[str] = Counter()
    size = printer_of(next(iter(rows.values()))["printer"]).size
    own = {part.name: read(path) for part in parts if (path := f"3mf/{part.name}.3mf") in files}
    shapes = {name: mesh for scene in own.values() for name, mesh in scene.geometry.items()}
    for path in sorted(path for path in files if path.startswith(f"{FOLDER}/") and path.endswith(".3mf")):
        scene = read(path)
        bodies = _placed(scene)
        found.update(name for name, _ in bodies)
        checks.append(Check(f"{path}: bodies as in their own files (mm)", _unlike(scene, shapes), OFF_ALLOWED))
        checks.append(Check(f"{path}: turned and moved alone", _bent(scene), BENT_ALLOWED))
        checks.append(Check(f"{path}: inside the printer (mm)", _outside([b for _, b in bodies], size), OFF_ALLOWED))
        checks.append(Check(f"{path}: none over another (mm^2)", _covered([b for _, b in bodies]), OFF_ALLOWED))
    for part in parts:
        if part.name in own:
            path, scene = f"3mf/{part.name}.3mf", own[part.name]
            out = _outside([body for _, body in _placed(scene)], (math.inf,) * 3)
            checks.append(Check(f"{path}: lies on the bed (mm)", out, OFF_ALLOWED))
            checks.append(Check(f"{path}: turned and moved alone", _bent(scene), BENT_ALLOWED))
    off = {name: _missized(rows[name], mesh.extents) for name, mesh in shapes.items() if name in rows}
    checks.append(worst(f"{PIECES}: sizes (mm)", SIZES_ALLOWED, off))
    wrong = list(_miscounted(rows, found, parts))
    checks.append(Check("plates: each piece as often as needed", float(len(wrong)), 0.0, ", ".join(wrong[:3])))
    return checks


def _missized(row: Mapping[str, str], extents: np.ndarray) -> float:
    """Return how far (mm) the size that a row tells is from the extents (3,) of a piece, however it lies."""
    said = [float(row[side]) for side in ("length_mm", "width_mm", "height_mm")]
    return float(np.abs(np.sort(said) - np.sort(extents)).max())


def _miscounted(
    rows: Mapping[str, Mapping[str, str]], found: Mapping[str, int], parts: Sequence[PartEntry]
) -> Iterator[str]:
    """Yield the bodies of which there are more or fewer on the plates than the robot needs."""
    expected = {COUPON: 1} if COUPON in rows else {}
    for part in parts:
        own = [name for name in rows if re.fullmatch(rf"{re.escape(part.name)}(_\d+of\d+)?", name)]
        if own != piece_names(part.name, len(own)):
            yield f"{part.name} is not in {PIECES} as one part or as its pieces"
        expected |= {name: 0 if rows[name]["problem"] else len(part.links) for name in own}
    for name in sorted(expected.keys() | found.keys()):
        if found.get(name, 0) != expected.get(name, 0):
            yield f"{found.get(name, 0)} x {name} instead of {expected.get(name, 0)}"


def read_3mf(content: bytes) -> Any:
    """Return a 3MF as a scene of trimesh."""
    import trimesh  # slow to load, and a server must start fast

    return trimesh.load_scene(io.BytesIO(content), file_type="3mf")


def _placed(scene: Any) -> list[tuple[str, Manifold]]:
    """Return the bodies of a 3MF as they lie on the bed, in mm, with their names."""
    bodies = []
    for node in scene.graph.nodes_geometry:
        pose, name = scene.graph[node]
        mesh = scene.geometry[name]
        solid = Manifold(Mesh64(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.uint64)))
        bodies.append((name, solid.transform(pose[:3])))
    return bodies


def _unlike(scene: Any, shapes: Mapping[str, Any]) -> float:
    """Return how far (mm) corners of bodies lie from where they are in the bodies' own files; infinity where there are
    others. The coupon has no file of its own."""
    off = 0.0
    for name, mesh in scene.geometry.items():
        same = shapes.get(name, mesh if name == COUPON else None)
        if same is None or mesh.vertices.shape != same.vertices.shape or not np.array_equal(mesh.faces, same.faces):
            return math.inf
        off = max(off, float(np.abs(mesh.vertices - same.vertices).max(initial=0.0)))
    return off


def _bent(scene: Any) -> float:
    """Return how far what the bodies of a 3MF are turned by is from a rotation."""
    turns = np.array([scene.graph[node][0][:3, :3] for node in scene.graph.nodes_geometry]).reshape(-1, 3, 3)
    off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    return float(off) if np.all(np.linalg.det(turns) > 0) else math.inf


def _outside(bodies: Sequence[Manifold], size: Sequence[float]) -> float:
    """Return how far (mm) bodies reach out of the room above a bed, or begin above it."""
    out = 0.0
    for body in bodies:
        low, high = np.array(body.bounding_box()).reshape(2, 3)
        out = max(out, float((high - size).max()), float(-low.min()), float(low[2]))
    return out


def _covered(bodies: Sequence[Manifold]) -> float:
    """Return the area (mm^2) of the bed that is under more than one body."""
    shadows = [body.project() for body in bodies]
    return sum((one ^ other).area() for one, other in itertools.combinations(shadows, 2))
