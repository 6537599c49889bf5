"""Bodies on the plates of a printer: inside the border of the bed, none over another."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from manifold3d import Manifold

from studio.export.pieces import Piece
from studio.export.printers import BORDER, Printer

GAP = 4.0
"""Distance between bodies on a plate, in mm."""
_ORDERS = 40
"""Number of orders in which bodies are put on a plate; the one that fills it best is kept."""


@dataclass(frozen=True)
class Item:
    """A body on a plate."""

    piece: Piece
    pose: np.ndarray  # (3, 4)
    """Rotation and place (mm) that take the body from its link's frame onto the plate."""

    @cached_property
    def solid(self) -> Manifold:
        """The body as it lies on the plate, in mm from the plate's corner."""
        return self.piece.solid.transform(self.pose)


@dataclass(frozen=True)
class Plate:
    """What is printed together."""

    printer: Printer
    items: list[Item]


def arrange(bodies: Sequence[Piece], printer: Printer) -> list[Plate]:
    """Return all copies of bodies that fit the bed, each on one of as few plates as are found, none over another.

    What lies on the bed only at an angle lies side by side across a plate, with what else finds room there.
    """
    straight: list[Piece] = []
    slanted: list[Piece] = []
    for body in bodies:
        angle = printer.angle_of(float(body.size[0]), float(body.size[1]))
        (straight if angle == 0 or angle == np.pi / 2 else slanted).extend([body] * body.copies)
    across: list[Plate] = []
    slanted.sort(key=lambda body: -body.size[0])
    while slanted:
        items, slanted, straight = _across(slanted, straight, printer)
        across.append(Plate(printer, items))
    plates: list[Plate] = []
    while straight:
        items, straight = _filled(straight, printer)
        plates.append(Plate(printer, items))
    return plates + across


def _filled(bodies: Sequence[Piece], printer: Printer) -> tuple[list[Item], list[Piece]]:
    """Return a plate's items, along the sides of the bed, and the bodies that found no place on it."""
    from trimesh.path.packing import rectangles_single  # slow to load, and a server must start fast

    sizes = np.array([body.size[:2] for body in bodies])
    best, placed, most = np.empty((0, 2, 2)), np.empty(0, bool), -1.0
    for order in range(_ORDERS):
        bounds, inserted = rectangles_single(
            sizes + GAP, size=np.add(printer.room, GAP), shuffle=order > 0, rotate=True, random=order
        )
        area = float(sizes[inserted].prod(axis=1).sum())
        if area > most:
            best, placed, most = bounds, inserted, area
        if placed.all():
            break
    items = []
    for body, (low, high) in zip(np.array(bodies, object)[placed], best, strict=True):
        turned = not np.allclose(high - low, body.size[:2] + GAP)
        items.append(put(body, np.pi / 2 if turned else 0.0, low + BORDER))
    return items, [body for body, there in zip(bodies, placed, strict=True) if not there]


def _across(
    slanted: Sequence[Piece], straight: Sequence[Piece], printer: Printer
) -> tuple[list[Item], list[Piece], list[Piece]]:
    """Return a plate of as many bodies as lie side by side across it, and those of both kinds that are left.

    The longest of the slanted ones come first.
    """
    count = next(n for n in range(len(slanted), 0, -1) if printer.angle_of(*_block(slanted[:n])) is not None)
    row, left = list(slanted[:count]), list[Piece]()
    for body in sorted(straight, key=lambda body: -body.size[0]):
        fits = printer.angle_of(*_block([*row, body])) is not None
        (row if fits else left).append(body)
    length, width = _block(row)
    angle = printer.angle_of(length, width)
    assert angle is not None
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    items, y = [], -width / 2
    for body in row:
        middle = np.array(printer.size[:2]) / 2 + (y + body.size[1] / 2) * across
        corners = np.array([x * along + z * across for x in (0.0, body.size[0]) for z in (0.0, body.size[1])])
        low = middle - (corners.max(0) + corners.min(0)) / 2 + corners.min(0)
        items.append(put(body, angle, low))
        y += body.size[1] + GAP
    return items, list(slanted[count:]), left


def _block(bodies: Sequence[Piece]) -> tuple[float, float]:
    """Return length and width (mm) of bodies side by side."""
    width = sum(float(body.size[1]) for body in bodies) + GAP * (len(bodies) - 1)
    return max(float(body.size[0]) for body in bodies), width


def put(body: Piece, angle: float, low: np.ndarray) -> Item:
    """Return a body turned by an angle (rad) as it lies, with the box round its length and width beginning at `low`."""
    quarter = angle == np.pi / 2  # exact: 3MF numbers stay those of the mesh
    cos, sin = (0.0, 1.0) if quarter else (float(np.cos(angle)), float(np.sin(angle)))
    round_z = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    turn = round_z @ body.turn
    start = np.array(body.solid.transform(np.column_stack([body.turn, np.zeros(3)])).bounding_box()[:3])
    corner = np.array([-float(body.size[1]) * sin, 0.0, 0.0])  # of the turned box
    place = np.array([*low, 0.0]) - corner - round_z @ start
    return Item(body, np.column_stack([turn, place]))
