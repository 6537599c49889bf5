"""The test coupon: a bar with bores for a pin, printed first, which tells how tight this printer's bores are."""

import numpy as np
from manifold3d import Manifold, OpType

from studio.export.pieces import Piece

NAME = "pin_coupon"
STEPS = (0.0, 0.1, 0.2, 0.3, 0.4)
"""Play of the pin in each of the bores, as differences of diameters in mm."""
_WALL = 4.0  # mm round a bore, as in the parts
_WIDER = 2.0  # mm by which the bar is wider than high, so that it lies on its widest side with its bores level
_PITCH = 3.0  # mm between bores beside their diameter and a wall
_GROOVE = (1.0, 0.6)  # width and depth in mm of the marks: as many beside a bore as its place in the row
_FACETS = 48


def coupon(pin: float) -> Piece:
    """Return a bar with a bore for each of `STEPS`, whose axis lies level as in the parts, for a pin of `pin` mm.

    The bores are marked by one to five grooves on top.
    """
    width, depth = _GROOVE
    pitch = max(pin + _WALL, 2 * width * len(STEPS)) + _PITCH
    length, height = pitch * len(STEPS), pin + 2 * _WALL
    along = height + _WIDER
    cuts = []
    for i, play in enumerate(STEPS):
        middle = (i + 0.5) * pitch
        radius = (pin + play) / 2 / np.cos(np.pi / _FACETS)
        bore = Manifold.cylinder(2 * along, radius, circular_segments=_FACETS).rotate((90, 0, 0))
        cuts.append(bore.translate((middle, 1.5 * along, height / 2)))
        groove = Manifold.cube((width, along, 2 * depth)).translate((middle - width / 2, 0, height - depth))
        cuts += [groove.translate((2 * width * (k - i / 2), 0, 0)) for k in range(i + 1)]
    bar = Manifold.cube((length, along, height)) - Manifold.batch_boolean(cuts, OpType.Add)
    return Piece(NAME, NAME, bar, np.eye(3), 1)
