"""Mass, centre of mass and inertia of the links: polynomials in a link's length, a sum over a palm's mounts.

They were measured on solid links of PLA, 12 mm x 22 mm thick, and a palm with small mounts. The prints that
`studio.robots.geometry` draws are as thick as the collision shapes; with their infill they have the masses here. Pins,
bolts and servos are not in them.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

DENSITY = 1240.0  # kg/m^3: PLA
ARM_SCALE = 2.5
"""Factor by which the arm's links are larger than a finger's, from which they are made."""

Servo = Literal["none", "mg90s"]
"""The servo for which the palm has pockets, one for each finger."""
LinkKind = Literal["proximal", "distal"]
"""Kind of a link: a proximal one ends in a clevis, a distal one in a fingertip."""


@dataclass(frozen=True)
class Inertial:
    """Mass properties of a body in its own frame, as MuJoCo and URDF want them."""

    mass: float
    """kg: the mass."""
    com: np.ndarray
    """(3,) m: the centre of mass."""
    inertia: np.ndarray
    """(3, 3) kg m^2: the inertia about the centre of mass."""


@dataclass(frozen=True)
class Moments:
    """Integrals over a body's volume, about its frame's origin; they add up."""

    volume: float  # m^3
    first: np.ndarray  # (3,) m^4
    second: np.ndarray  # (3, 3) m^5: of the products of coordinates

    def __sub__(self, other: "Moments") -> "Moments":
        return Moments(self.volume - other.volume, self.first - other.first, self.second - other.second)

    def __add__(self, other: "Moments") -> "Moments":
        return Moments(self.volume + other.volume, self.first + other.first, self.second + other.second)

    def turned(self, rotation: np.ndarray) -> "Moments":
        """Return the moments after the body was turned by `rotation` (3, 3)."""
        return Moments(self.volume, rotation @ self.first, rotation @ self.second @ rotation.T)

    def scaled(self, factor: float) -> "Moments":
        """Return the moments after all lengths were multiplied by `factor`."""
        return Moments(factor**3 * self.volume, factor**4 * self.first, factor**5 * self.second)

    def inertial(self, density: float = DENSITY) -> Inertial:
        """Return the mass properties of a body of `density` kg/m^3."""
        com = self.first / self.volume
        central = self.second - self.volume * np.outer(com, com)
        return Inertial(density * self.volume, com, density * (np.trace(central) * np.eye(3) - central))


@dataclass(frozen=True)
class LinkMoments:
    """A link that hangs along -z: moments as polynomials in its length (m), lowest power first."""

    volume: tuple[float, ...]
    z: tuple[float, ...]
    xx: tuple[float, ...]
    yy: tuple[float, ...]
    zz: tuple[float, ...]

    def at(self, length: float) -> Moments:
        """Return the moments of a link of `length` m."""
        powers = length ** np.arange(4)

        def value(coefficients: tuple[float, ...]) -> float:
            return float(np.dot(coefficients, powers[: len(coefficients)]))

        first = np.array([0.0, 0.0, value(self.z)])
        return Moments(value(self.volume), first, np.diag([value(self.xx), value(self.yy), value(self.zz)]))


def _moments(drawn: dict[str, Any]) -> Moments:
    return Moments(drawn["volume"], np.array(drawn["first"]), np.array(drawn["second"]))


FILE = Path(__file__).with_name("printed.json")
"""What was measured on the solid links. All results rest on it: it stays as it is."""
_MEASURED = json.loads(FILE.read_bytes())
LINKS = {
    kind: LinkMoments(**{name: tuple(coefficients) for name, coefficients in drawn.items()})
    for kind, drawn in _MEASURED["links"].items()
}
PLATE, MOUNT, POCKET = (_moments(_MEASURED[part]) for part in ("plate", "mount", "pocket"))
"""The palm without mounts, a finger's mount, and what a servo's pocket takes from the palm."""

LAID = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""The rotation from a hanging link, which turns about y, to one of the arm, which lies along x and turns about z."""


def set_inertial(body: mujoco.MjsBody, inertial: Inertial) -> None:
    """Give a body these mass properties instead of those of its geoms."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertial.inertia
    body.explicitinertial = True
    body.mass, body.ipos, body.fullinertia = inertial.mass, inertial.com, [xx, yy, zz, xy, xz, yz]


def link_inertial(kind: LinkKind, length: float) -> Inertial:
    """Return a finger's link of `length` m; its frame is at its joint, it hangs along -z."""
    return LINKS[kind].at(length).inertial()


def palm_inertial(angles: np.ndarray, servo: Servo = "none") -> Inertial:
    """Return the palm with mounts at `angles` (n,) rad; its origin is on its axis, level with the fingers' joints.

    Mounts or pockets that overlap count twice: such a hand can't be assembled, and its episodes count as diverged.
    """
    total, each = PLATE, MOUNT if servo == "none" else MOUNT - POCKET
    for cos, sin in zip(np.cos(angles), np.sin(angles), strict=True):
        total += each.turned(np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]))
    return total.inertial()


def arm_link_inertial(kind: LinkKind, length: float) -> Inertial:
    """Return a link of the arm of `length` m; its frame is at its joint, it lies along x."""
    return LINKS[kind].at(length / ARM_SCALE).scaled(ARM_SCALE).turned(LAID).inertial()
