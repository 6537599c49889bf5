"""What hand and arm share: links of PLA that turn round dowel pins, driven from outside."""

import math
from collections.abc import Sequence

from morph_core.tasks.printed import DENSITY
from studio.robots.geometry import SIZES, Sizes
from studio.robots.parts import MILLIMETRE, SKIN, Part
from studio.robots.robot import Bought

STEEL = 7850.0  # kg/m^3

ABOUT_PARTS = f"""<p>PLA ({DENSITY:g} kg/m&sup3;), with walls, top and bottom of {SKIN:g} mm and the infill of the \
table, with which a part weighs what is simulated. Pin bores: {SIZES.pin_diameter:g} mm, pressed in the lugs, \
{SIZES.pin_play:g} mm play in the tang; {SIZES.side_play:g} mm between tang and lug. The links hold no motor, and pins \
and bolts are not in the masses: BOM.csv."""


def joints_of(parts: Sequence[Part]) -> int:
    """Return how many links turn round a pin: all but the one that carries the others."""
    return sum(part.quantity for part in parts) - 1


def pins(parts: Sequence[Part], sizes: Sizes = SIZES) -> Bought:
    """Return the pins of links of these sizes."""
    mass = STEEL * math.pi / 4 * sizes.pin_diameter**2 * sizes.pin_length * MILLIMETRE**3
    name = f"dowel pin {sizes.pin_diameter:g} x {sizes.pin_length:g} mm"
    note = "press into the lugs; not in the masses that were simulated"
    return Bought(name, joints_of(parts), material="steel", mass=mass, note=note)


def drives(parts: Sequence[Part]) -> Bought:
    """Return the drives of the joints."""
    note = "not part of the design: control.json says which torque and gains were simulated"
    return Bought("servo or tendon drive", joints_of(parts), note=note)
