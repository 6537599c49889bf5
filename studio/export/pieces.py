"""How a part is printed: turned onto its widest side, and cut into dowelled pieces where no bed is long enough."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

from studio.export.meshes import Shape
from studio.export.printers import BORDER, Printer
from studio.robots import geometry
from studio.robots.geometry import SHORTEST
from studio.robots.parts import Part

LAYER = 0.2
"""Height above the bed (mm) at which the first layer is measured."""
MOST_PIECES = 4
"""Largest number of pieces of a part: a link of more would bend at its joints."""
SLENDER = 2.0
"""Least ratio of a part's length to its width with which it is cut across its length."""
DOWELS = ((12.0, 60.0), (10.0, 50.0), (8.0, 40.0), (6.0, 30.0), (4.0, 20.0), (3.0, 16.0))
"""Diameter and length (mm) of the dowel pins (ISO 2338) that join pieces, the stoutest first."""
DOWEL_PLAY = 0.2
"""Difference of the diameters of a dowel's hole and of the dowel (mm), for glue."""
DOWEL_END = 0.5
"""Length (mm) by which a dowel's hole is deeper than half the dowel."""
DOWEL_WALL = 3.0
"""Least thickness of the material round a dowel's hole (mm)."""
_FACETS = 48
_QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@dataclass(frozen=True)
class Piece:
    """A body that is printed in one go."""

    name: str
    part: str
    """Name of the part that it is, or is a piece of."""
    solid: Manifold
    """The body in the frame of its link, in mm."""
    turn: np.ndarray  # (3, 3)
    """Rotation from the link's frame with which the body lies on its widest side, its length along x."""
    copies: int

    @cached_property
    def laid(self) -> Manifold:
        """The body as it lies, in the positive octant and at its corner."""
        turned = self.solid.transform(np.column_stack([self.turn, np.zeros(3)]))
        return turned.translate(-np.array(turned.bounding_box()[:3]))

    @cached_property
    def shape(self) -> Shape:
        """The body's mesh in the frame of its link."""
        return Shape(*geometry.mesh(self.solid))

    @property
    def size(self) -> np.ndarray:
        """Size (3,) of the box round the body as it lies, in mm."""
        low, high = np.array(self.laid.bounding_box()).reshape(2, 3)
        return high - low

    @property
    def first_layer(self) -> float:
        """Area of the body's first layer, in mm^2."""
        return self.laid.slice(LAYER).area()


@dataclass(frozen=True)
class Pieces:
    """The pieces that a part is printed in: itself, or several with dowels between them."""

    pieces: list[Piece]
    dowel: tuple[float, float] | None = None
    """Diameter and length (mm) of the dowels of a part in several pieces."""

    @property
    def dowels(self) -> int:
        """Number of dowels for one part: two for each cut."""
        return 2 * (len(self.pieces) - 1)


def piece_names(part: str, count: int) -> list[str]:
    """Return the names of the pieces that a part is printed in."""
    return [part] if count == 1 else [f"{part}_{i}of{count}" for i in range(1, count + 1)]


def lay(name: str, part: str, solid: Manifold, copies: int) -> Piece:
    """Return a body turned onto that of the six sides of its link's frame on which its first layer is the largest."""
    best, largest = None, 0.0
    for turn in _turns():
        piece = Piece(name, part, solid, turn, copies)
        area = piece.first_layer
        if best is None or area > largest * (1 + 1e-6):
            best, largest = piece, area
    assert best is not None
    if best.size[1] > best.size[0]:
        best = Piece(name, part, solid, _QUARTER @ best.turn, copies)
    return best


def _turns() -> Iterator[np.ndarray]:
    """Yield the rotations (3, 3) that turn one of six sides down."""
    for axis, sign in itertools.product(range(3), (1, -1)):
        up, along = sign * np.eye(3)[axis], np.eye(3)[(axis + 1) % 3]
        yield np.stack([along, np.cross(up, along), up])


def pieces_of(part: Part, printer: Printer) -> Pieces:
    """Return the part whole, or cut where the bed is too short; ValueError with its length and what is allowed."""
    whole = lay(part.name, part.name, part.solid, part.quantity)
    if printer.takes(whole.size):
        return Pieces([whole])
    length, width, height = (float(s) for s in whole.size)
    if length >= SLENDER * max(width, height):
        for count in range(2, MOST_PIECES + 1):
            cut = _cut(whole, int(part.size.argmax()), count)
            if cut is not None and all(printer.takes(piece.size) for piece in cut.pieces):
                return cut
    raise ValueError(_too_large(part.name, whole.size, printer))


def _too_large(name: str, size: np.ndarray, printer: Printer) -> str:
    """Return a sentence on a part of `size` (3,) mm that a printer can't print, and on what is allowed."""
    length, width, height = (float(s) for s in size)
    x, y = printer.room
    said = (
        f"{name} is {length:.0f} x {width:.0f} x {height:.0f} mm as it lies, and the printer {printer} has "
        f"{x:g} x {y:g} mm inside its border"
    )
    if height > printer.size[2]:
        return f"{said}: {printer.size[2]:g} mm of height are allowed"
    longest = printer.longest(width)
    if length < SLENDER * max(width, height) or longest == 0.0:
        wide, deep = (math.ceil(side + 2 * BORDER) for side in (length, width))
        return f"{said}, and it is not slender enough to be cut: a bed of {wide} x {deep} mm or more is needed"
    return (
        f"{said}: {longest:.0f} mm of length are allowed in one piece, {MOST_PIECES * longest:.0f} mm in {MOST_PIECES}"
    )


def _cut(whole: Piece, axis: int, count: int) -> Pieces | None:
    """Return a body in pieces of equal length along an axis of its link; None where dowels find no room."""
    low, high = np.array(whole.solid.bounding_box()).reshape(2, 3)[:, axis]
    places = np.linspace(low, high, count + 1)[1:-1]
    for diameter, length in DOWELS:
        holes = [_holes(whole.solid, axis, float(place), diameter, length) for place in places]
        if any(hole is None for hole in holes):
            continue
        rest, pieces = whole.solid - Manifold.batch_boolean([h for h in holes if h is not None], OpType.Add), []
        for place in places:
            above, below = rest.split_by_plane(np.eye(3)[axis], float(place))
            pieces.append(below)
            rest = above
        solids = [solid.simplify(SHORTEST) for solid in (*pieces, rest)]
        if all(len(solid.decompose()) == 1 for solid in solids):
            named = zip(piece_names(whole.part, count), solids, strict=True)
            laid = [lay(name, whole.part, solid, whole.copies) for name, solid in named]
            return Pieces(laid, (diameter, length))
    return None


def _holes(solid: Manifold, axis: int, place: float, diameter: float, length: float) -> Manifold | None:
    """Return what two dowels across a cut take from a body; None where the material round them would be too thin.

    The room for them is what all sections have in common along the dowels.
    """
    to_z = np.roll(np.eye(3), -axis - 1, axis=0)  # rotates the axis onto z
    upright = solid.transform(np.column_stack([to_z, np.zeros(3)]))
    depth, radius = length / 2 + DOWEL_END, (diameter + DOWEL_PLAY) / 2
    room = upright.slice(place)
    for share in (-1.0, -0.5, 0.5, 1.0):
        room ^= upright.slice(place + share * depth)
    inner = room.offset(-(radius + DOWEL_WALL))
    if inner.is_empty():
        return None
    low, high = np.array(inner.bounds()).reshape(2, 2)
    along = int((high - low).argmax())
    spots = np.tile((low + high) / 2, (2, 1))
    spots[:, along] = low[along], high[along]
    around = CrossSection.circle(0.99 * (radius + DOWEL_WALL), _FACETS)
    if high[along] - low[along] < diameter + 2 * DOWEL_WALL or any(
        (around.translate(spot) - room).area() > 1e-6 for spot in spots
    ):
        return None
    hole = Manifold.cylinder(2 * depth, radius / np.cos(np.pi / _FACETS), circular_segments=_FACETS)
    both = Manifold.batch_boolean([hole.translate((*spot, place - depth)) for spot in spots], OpType.Add)
    return both.transform(np.column_stack([to_z.T, np.zeros(3)]))
