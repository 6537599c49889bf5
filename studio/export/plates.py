"""The prints of a design: its parts on the plates of a printer, their files, and what was measured of them.

A report shows `plates` by `plate_picture(plate, title)`, `measured` and `fits` as tables, and `problems` as sentences.
"""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from studio.export.coupon import NAME as COUPON
from studio.export.coupon import coupon
from studio.export.gauge import THINNEST, Fit, fits_of, overhang, thinnest_wall, tightest
from studio.export.layout import GAP, Item, Plate, arrange, put
from studio.export.meshes import Body, three_mf
from studio.export.pieces import Piece, Pieces, lay, pieces_of
from studio.export.plate_picture import plate_picture
from studio.export.printers import BORDER, PRINTERS, Printer
from studio.robots.parts import Part

FOLDER = "plates"
PIECES = f"{FOLDER}/pieces.csv"
"""Path of the table of what is printed."""


@dataclass(frozen=True)
class Measured:
    """What was measured of a piece, on its mesh, as it lies."""

    size: tuple[float, float, float]  # mm
    first_layer: float  # mm^2
    thinnest_wall: float  # mm
    overhang: float  # mm^2


@dataclass(frozen=True)
class Prints:
    """How a design is printed on a printer."""

    printer: Printer
    parts: dict[str, Pieces]
    """Pieces of each part, by the part's name."""
    problems: dict[str, str]
    """Sentences on the parts that can't be printed, by their names: they are on no plate."""
    plates: list[Plate]
    fits: list[Fit]
    measured: dict[str, Measured]
    """What was measured of each piece, by its name."""


def plan_prints(parts: Sequence[Part], printer: Printer, model: mujoco.MjModel | None = None) -> Prints:
    """Lay the parts on plates; with the `model` of a printed robot, measure its joints and add a coupon for pins."""
    made: dict[str, Pieces] = {}
    problems: dict[str, str] = {}
    for part in parts:
        try:
            made[part.name] = pieces_of(part, printer)
        except ValueError as error:
            problems[part.name] = str(error)
            made[part.name] = Pieces([lay(part.name, part.name, part.solid, part.quantity)])
    measured = {piece.name: _measured(piece) for each in made.values() for piece in each.pieces}
    for each in made.values():
        for piece in each.pieces:
            wall = measured[piece.name].thinnest_wall
            if wall < THINNEST and piece.part not in problems:
                problems[piece.part] = f"{piece.name} has a wall of {wall:.2g} mm: {THINNEST:g} mm or more are allowed"
    fits = fits_of(model, parts) if model is not None else []
    bodies = [piece for name, each in made.items() if name not in problems for piece in each.pieces]
    if bored := tightest(fits):
        bodies.append(coupon(round(bored["pin"], 1)))
        measured[COUPON] = _measured(bodies[-1])
    plates = arrange(bodies, printer)
    return Prints(printer, made, problems, plates, fits, measured)


def printers_for(parts: Sequence[Part]) -> list[str]:
    """Return the names of the printers in the table that are large enough for all parts."""
    return [name for name, printer in PRINTERS.items() if all(_fits(part, printer) for part in parts)]


def _fits(part: Part, printer: Printer) -> bool:
    try:
        pieces_of(part, printer)
    except ValueError:
        return False
    return True


def print_files(prints: Prints) -> dict[str, bytes]:
    """Return a 3MF for each part and each plate, a picture of each plate, and tables of what was measured."""
    files = {f"3mf/{name}.3mf": _part_file(name, each, prints) for name, each in prints.parts.items()}
    for number, plate in enumerate(prints.plates, start=1):
        title = plate_title(prints, number)
        files[f"{FOLDER}/plate_{number}.3mf"] = three_mf(title, _listed(plate), _bodies(plate.items))
        files[f"{FOLDER}/plate_{number}.svg"] = plate_picture(plate, title).encode()
    files[PIECES] = _table(_PIECE_COLUMNS, list(_piece_rows(prints)))
    if prints.fits:
        files[f"{FOLDER}/joints.csv"] = _table(_JOINT_COLUMNS, list(_joint_rows(prints)))
    return files


def plate_title(prints: Prints, number: int) -> str:
    """Return a few words on a plate, by its number from 1."""
    return f"plate {number} of {len(prints.plates)}, printer {prints.printer}"


def _part_file(name: str, pieces: Pieces, prints: Prints) -> bytes:
    """Return the 3MF of one part: all copies of its pieces; what needs a second plate lies beside the first."""
    printer = prints.printer
    if name in prints.problems:
        items = [put(piece, 0.0, np.full(2, BORDER)) for piece in pieces.pieces for _ in range(piece.copies)]
        step = np.array([0.0, float(pieces.pieces[0].size[1]) + GAP, 0.0])
        items = [_moved(item, i * step) for i, item in enumerate(items)]
        said = prints.problems[name]
    else:
        step = np.array([printer.size[0], 0.0, 0.0])
        plates = arrange(pieces.pieces, printer)
        items = [_moved(item, i * step) for i, plate in enumerate(plates) for item in plate.items]
        said = ", ".join(_listed(plate) for plate in plates)
    return three_mf(name, said, _bodies(items))


def _moved(item: Item, by: np.ndarray) -> Item:
    pose = item.pose.copy()
    pose[:, 3] += by
    return Item(item.piece, pose)


def _bodies(items: Sequence[Item]) -> list[Body]:
    """Return the objects of a 3MF, each once however many copies of it there are."""
    poses: dict[str, list[np.ndarray]] = {}
    for item in items:
        poses.setdefault(item.piece.name, []).append(item.pose)
    pieces = {item.piece.name: item.piece for item in items}
    return [Body(name, pieces[name].shape, poses[name]) for name in pieces]


def _listed(plate: Plate) -> str:
    """Return the names of what is on a plate, with the number of copies."""
    names = [item.piece.name for item in plate.items]
    return ", ".join(f"{names.count(name)} x {name}" for name in dict.fromkeys(names))


_PIECE_COLUMNS = (
    "piece", "copies", "plate", "length_mm", "width_mm", "height_mm", "first_layer_mm2", "thinnest_wall_mm",
    "overhang_mm2", "printer", "problem",
)  # fmt: skip
_JOINT_COLUMNS = ("joint", "carries", "turns", "bore_of_carrier_mm", "bore_of_turning_mm", "play_of_pin_mm", "gap_mm")


def _piece_rows(prints: Prints) -> Iterator[Sequence[object]]:
    """Yield what is known of each piece."""
    where: dict[str, list[str]] = {}
    for number, plate in enumerate(prints.plates, start=1):
        for name in dict.fromkeys(item.piece.name for item in plate.items):
            where.setdefault(name, []).append(str(number))
    copies = {piece.name: piece.copies for each in prints.parts.values() for piece in each.pieces}
    owners = {piece.name: piece.part for each in prints.parts.values() for piece in each.pieces}
    for name, found in prints.measured.items():
        yield [
            name, copies.get(name, 1), " ".join(where.get(name, [])), *(f"{s:.1f}" for s in found.size),
            f"{found.first_layer:.0f}", f"{found.thinnest_wall:.2f}", f"{found.overhang:.0f}",
            prints.printer.name, prints.problems.get(owners.get(name, ""), ""),
        ]  # fmt: skip


def _joint_rows(prints: Prints) -> Iterator[Sequence[object]]:
    """Yield what is known of each joint."""
    for fit in prints.fits:
        yield [fit.joint, *fit.links, *(f"{b:.2f}" for b in fit.bores), f"{fit.play:.2f}", f"{fit.gap:.2f}"]


def _table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> bytes:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return out.getvalue().encode()


def dowels_bought(prints: Prints) -> list[tuple[str, int, str, str]]:
    """Return what the parts in several pieces need of dowels: item, quantity, names of the parts, and a note."""
    counts: dict[tuple[float, float], int] = {}
    names: dict[tuple[float, float], list[str]] = {}
    for name, each in prints.parts.items():
        if each.dowel is not None:
            counts[each.dowel] = counts.get(each.dowel, 0) + each.dowels * each.pieces[0].copies
            names.setdefault(each.dowel, []).append(name)
    note = "glue into the cut faces; not in the masses, nor are their holes"
    return [
        (f"dowel pin {diameter:g} x {length:g} mm", count, " ".join(names[diameter, length]), note)
        for (diameter, length), count in counts.items()
    ]


def note_of(prints: Prints, part: str) -> str:
    """Return what BOM.csv says of how a part is printed: "" for one in one piece."""
    count = len(prints.parts[part].pieces)
    return prints.problems.get(part, f"in {count} pieces, with {prints.parts[part].dowels} dowels" if count > 1 else "")


def _measured(piece: Piece) -> Measured:
    length, width, height = (float(s) for s in piece.size)
    return Measured((length, width, height), piece.first_layer, thinnest_wall(piece.solid), overhang(piece.laid))
