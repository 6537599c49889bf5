"""Mass, centre of mass and inertia of the printed parts: polynomials in a link's length, a sum over a palm's mounts.

The parts themselves are drawn in `studio.robots.geometry`, whose tests compare them with the numbers here. They are printed
solid, so that mass is spread evenly; pins, bolts and servos are not in it.
"""

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

DENSITY = 1240.0  # kg/m^3: PLA
ARM_SCALE = 2.5
"""How many times larger the arm's links are than a finger's, from which they are made."""

Servo = Literal["none", "mg90s"]
"""The servo for which the palm has pockets, one for each finger."""
LinkKind = Literal["proximal", "distal"]
"""A proximal link ends in a clevis, a distal one in a fingertip."""


@dataclass(frozen=True)
class Inertial:
    """What MuJoCo and URDF want to know of a body, in its own frame."""

    mass: float
    """kg."""
    com: np.ndarray
    """(3,) m."""
    inertia: np.ndarray
    """(3, 3) kg m^2 about the centre of mass."""


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
        powers = length ** np.arange(4)

        def value(coefficients: tuple[float, ...]) -> float:
            return float(np.dot(coefficients, powers[: len(coefficients)]))

        first = np.array([0.0, 0.0, value(self.z)])
        return Moments(value(self.volume), first, np.diag([value(self.xx), value(self.yy), value(self.zz)]))


# Printed by `python -m studio.robots.geometry`.
LINKS = {
    "proximal": LinkMoments(
        volume=(-1.3708064232412148e-06, 0.00025619365751953116),
        z=(-2.877262988849767e-09, 6.056233155863044e-07, -0.00012809682875976626),
        xx=(-2.446518186738158e-11, 2.9440737916367488e-09),
        yy=(-4.9222100280838794e-11, 9.813185030258263e-09),
        zz=(-4.44724260780961e-11, 1.5476090801156417e-08, -6.056233155860652e-07, 8.539788583984341e-05),
    ),
    "distal": LinkMoments(
        volume=(6.009792533397556e-07, 0.0002561936575195312),
        z=(-3.938387689455077e-09, -1.7608012439787348e-06, -0.00012809682875976518),
        xx=(-9.712431232928208e-12, 2.9440737916367434e-09),
        yy=(-4.5002220264243514e-11, 9.813185030258238e-09),
        zz=(5.3134050015651227e-11, 2.3824558118261415e-08, 1.7608012439789377e-06, 8.539788583984307e-05),
    ),
}
PLATE = Moments(
    0.00019948681028137349,
    np.array([0.0, 0.0, 3.5012079918361684e-06]),
    np.array(
        [[1.8278754471699623e-07, 0.0, 0.0], [0.0, 1.827875447169965e-07, 0.0], [0.0, 0.0, 6.736255072616585e-08]]
    ),
)
MOUNT = Moments(
    2.1788899492730503e-06,
    np.array([1.2389866308732644e-07, 0.0, 4.995691343020779e-09]),
    np.array(
        [
            [7.10127031054526e-09, 0.0, 2.5770607804712645e-10],
            [0.0, 1.2265651817679777e-10, 0.0],
            [2.5770607804712645e-10, 0.0, 4.483171949540902e-11],
        ]
    ),
)
POCKET = Moments(
    4.91901313042186e-06,
    np.array([2.370347987234091e-07, 0.0, 9.23110023096151e-08]),
    np.array(
        [
            [1.1491026249084196e-08, 0.0, 4.448934540724991e-09],
            [0.0, 2.2335829532199313e-10, 0.0],
            [4.448934540724991e-09, 0.0, 1.8444809938455888e-09],
        ]
    ),
)
"""What a servo's pocket takes from the palm."""

LAID = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""From a hanging link, which turns about y, to one of the arm, which lies along x and turns about z."""


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
