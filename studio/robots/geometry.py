"""The printable parts in millimetres: links with a tang, a clevis or a fingertip, and pin bores; palm and base.

They follow the collision shapes of `morph_core.tasks.hand` and `morph_core.tasks.arm`, so that what is printed touches
where what is simulated touches. A link hangs from its joint along -z and turns about y; positive x is its back.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import repeat
from typing import Literal

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

from morph_core.tasks.arm import FOOT_CLEARANCE, FOOT_RADIUS, FOOT_THICKNESS, LINK_RADIUS
from morph_core.tasks.hand import DISTAL_RANGE, FINGER_RADIUS, PALM_RADIUS, PALM_THICKNESS, PROXIMAL_RANGE
from morph_core.tasks.printed import LAID, LinkKind, Moments, Servo


@dataclass(frozen=True)
class Sizes:
    """Sizes of links and joints in mm, unless a field says otherwise."""

    radius: float = 1e3 * FINGER_RADIUS
    """Radius of a link and of the balls at its joints and tip: that of its collision shape."""
    flat: float = 0.4
    """Depth of the flats along a link, on one of which it is printed."""
    wall: float = 4.0
    """Least thickness of the material round a pin's bore."""
    rim: float = 0.6
    """Thickness of the rim of a socket, which would end in a knife's edge without it."""
    pin_diameter: float = 4.0
    """Diameter of a dowel pin, which is pressed into the lugs."""
    pin_length: float = 28.0
    """Length of a dowel pin."""
    pin_play: float = 0.2
    """Difference of the diameters of the tang's bore and of the pin."""
    tang: float = 8.0
    """Thickness of the tang, along the pin."""
    side_play: float = 0.3
    """Distance between the tang and each lug."""
    gap: float = 0.3
    """Distance between a ball and the socket that turns round it, and between two links that are folded."""
    web: float = 5.0
    """Least distance between the sockets at both ends of a link."""
    back: float = -DISTAL_RANGE[0]
    """rad: largest angle by which a link can be bent backward against the one before it."""
    fold: float = DISTAL_RANGE[1]
    """rad: largest angle by which a link can be folded inward against the one before it."""
    segments: int = 48
    """Facets round a ball, a pin or a bore (a count)."""

    @property
    def joint_radius(self) -> float:
        """Least radius of tang and lugs round the pin."""
        return self.pin_diameter / 2 + self.wall

    @property
    def half_width(self) -> float:
        """Half the width of links and mounts, along the pin: to the flats."""
        return self.radius - self.flat

    @property
    def stretched(self) -> float:
        """Length of a link from which on only its shaft grows, in the middle between its joints."""
        return 5 * self.radius

    @property
    def socket(self) -> float:
        """Distance from the pin at which the wall of a socket begins, as thick as `rim` at the flats."""
        return math.sqrt((self.radius + self.gap) ** 2 - (self.half_width - self.rim) ** 2)

    @property
    def roomy(self) -> float:
        """Length of the shortest link whose joints are as thick as itself."""
        return 2 * (self.radius + self.gap) + self.web

    def joint(self, length: float) -> float:
        """Return the radius of the joints of a link of `length` mm: its own, or that for which a short one has room."""
        return min(max((length - self.web) / 2 - self.gap, self.joint_radius), self.radius)


@dataclass(frozen=True)
class PalmSizes:
    """Sizes of the palm in mm, unless a field says otherwise; its origin is level with the fingers' pins."""

    radius: float = 1e3 * PALM_RADIUS
    """Radius of the palm, on which the fingers' pins are: that of its collision shape."""
    low: float = 1e3 * (FINGER_RADIUS - PALM_THICKNESS / 2)
    """Height of the palm's underside above the pins of the fingers."""
    high: float = 1e3 * (FINGER_RADIUS + PALM_THICKNESS / 2)
    """Height of the palm's top above the pins of the fingers."""
    chamfer: float = 1.0
    """Width of the chamfer of the palm's edges."""
    segments: int = 120
    """Facets round the palm (a count)."""
    bolt_circle: float = 50.0
    """Diameter of the circle on which the bolts are: with four M6 bolts it fits the flange ISO 9409-1-50-4-M6."""
    bolt_diameter: float = 6.6
    """Diameter of the holes for the bolts."""
    bolt_head: tuple[float, float] = (11.0, 7.0)
    """Diameter and depth of the counterbores for the bolts' heads."""
    cable_hole: float = 20.0
    """Diameter of the hole in the middle of the palm."""
    servo_pocket: tuple[float, float, float] = (23.2, 12.6, 16.5)
    """Size of a pocket for an MG90S below its flange, with room: along the flange, across it, and deep."""
    servo_radius: float = 48.3
    """Distance of a pocket's middle from the palm's axis: outside the flange on which the palm is bolted."""
    servo_screws: tuple[float, float, float] = (27.8, 1.7, 8.0)
    """Distance, diameter and depth of the pilot holes of a servo's two screws."""
    tendon_hole: tuple[float, float] = (39.0, 2.0)
    """Distance from the palm's axis and diameter of the hole from a servo to the inner side of its finger."""
    servo_joint: float = 10.5
    """Largest radius of the joints under servos: a larger tang would turn into their pockets."""
    swing: tuple[float, float] = PROXIMAL_RANGE
    """rad: angles between which a finger turns on the palm; positive is outward."""


SIZES, PALM = Sizes(), PalmSizes()
ARM = replace(
    SIZES, radius=1e3 * LINK_RADIUS, rim=0.4, wall=10.0, pin_diameter=10.0, pin_length=100.0, tang=20.0, web=12.5,
    back=2.2, fold=2.2, segments=72,
)  # fmt: skip
"""Sizes of the arm's links, whose joints have no limits: they turn as far as links of their thickness can."""
NECK = 0.6
"""Radius of the neck between the arm's foot and its joint, as a share of the joint's."""
_LINKS = 16
"""Size of the link caches: one design's worth. A larger cache grew a long-watched studio."""
_FAR = 1e3
"""mm: beyond every palm."""
MARGIN = 0.01
"""rad: what links are free to turn beyond their limits, which a servo overshoots."""
SHORTEST = 0.01
"""mm: shorter edges are left out: files of single precision would tear the surface there."""


@dataclass(frozen=True, eq=False)
class Drilled:
    """A body, and the tools that make room in it for pins, bolts, cables and servos."""

    body: Manifold
    tools: tuple[Manifold, ...]

    @cached_property
    def solid(self) -> Manifold:
        """The part as it is printed."""
        return Manifold.batch_boolean([self.body, *self.tools], OpType.Subtract).simplify(SHORTEST)

    def changed(self, change: Callable[[Manifold], Manifold]) -> "Drilled":
        """Return the part after `change` was done to body and tools."""
        return Drilled(change(self.body), tuple(change(tool) for tool in self.tools))


Root = Literal["palm", "foot", "link"]
"""What a link is mounted on."""


@lru_cache(_LINKS)
def link(kind: LinkKind, length: float, start: float, end: float, root: Root, sizes: Sizes = SIZES) -> Drilled:
    """Return a link of `length` mm in the frame of its joint.

    `start` and `end` are the radii of its joints; both links of a joint are drawn with the same.
    """
    shaft = length - sizes.stretched
    if shaft <= 0:
        return drawn(kind, length, start, end, root, sizes)

    def stretch(points: np.ndarray) -> np.ndarray:
        return points - [0, 0, shaft] * (points[:, 2:] < -sizes.stretched / 2)

    return drawn(kind, sizes.stretched, start, end, root, sizes).changed(lambda solid: solid.warp_batch(stretch))


@lru_cache(_LINKS)
def drawn(kind: LinkKind, length: float, start: float, end: float, root: Root, sizes: Sizes) -> Drilled:
    """Return a link as `link` does, of any length without stretching it."""
    bottom = (0, 0, -length)
    ball, profile = Manifold.sphere(sizes.radius, sizes.segments), _profile(length, sizes)
    body = Manifold.batch_hull([ball, ball.translate(bottom)]) ^ profile
    if root != "foot":
        body ^= _room(length, sizes, folds=root == "link")
    body = (body - _socket(start, root, sizes)) + (_disc(start, sizes.tang, sizes) ^ profile)
    tools = [_bore(sizes, sizes.pin_play)]
    if kind == "proximal":
        body ^= _room(length, sizes, folds=True).mirror((0, 0, 1)).translate(bottom)
        body += _disc(end, 2 * sizes.half_width, sizes).translate(bottom) ^ profile
        body -= _cylinder_y(end + sizes.gap, _slot(sizes), sizes).translate(bottom)
        tools.append(_bore(sizes).translate(bottom))
    return Drilled(body, tuple(tools))


@lru_cache(2)
def palm(angles: tuple[float, ...], joints: tuple[float, ...], servo: Servo = "none") -> Drilled:
    """Return the palm with mounts at `angles` rad, whose joints have the radii `joints`, and pockets for servos."""
    sizes = PALM
    outline = [
        (0, sizes.low), (sizes.radius - sizes.chamfer, sizes.low), (sizes.radius, sizes.low + sizes.chamfer),
        (sizes.radius, sizes.high - sizes.chamfer), (sizes.radius - sizes.chamfer, sizes.high), (0, sizes.high),
    ]  # fmt: skip
    degrees = [math.degrees(angle) for angle in angles]

    def round_it(pieces: Iterable[Manifold]) -> Manifold:
        turned = [piece.rotate((0, 0, angle)) for piece, angle in zip(pieces, degrees, strict=False)]
        return Manifold.batch_boolean(turned, OpType.Add)

    body = _turned(outline, sizes.segments) - round_it(repeat(_swept()))
    body = body + round_it(map(_mount, joints)) - round_it(map(_slot_of_mount, joints))
    pin = _bore(SIZES).translate((sizes.radius, 0, 0))
    tools = [pin.rotate((0, 0, angle)) for angle in degrees]
    if servo != "none":
        tools += [pocket().rotate((0, 0, angle)) for angle in degrees]
    return Drilled(body, (*tools, *_bolts(sizes)))


@lru_cache(_LINKS)
def arm_link(kind: LinkKind, length: float, start: float, end: float, root: Root) -> Drilled:
    """Return a link of the arm of `length` mm; it lies along x and turns about z."""
    turn = np.column_stack([LAID, np.zeros(3)])
    return link(kind, length, start, end, root, ARM).changed(lambda solid: solid.transform(turn))


@lru_cache(2)
def arm_base(joint: float) -> Drilled:
    """Return the arm's foot: a disc, a neck and a lug, round whose pin the first link turns."""
    sizes, top = ARM, -1e3 * (LINK_RADIUS + FOOT_CLEARANCE)
    disc = _cylinder(1e3 * FOOT_RADIUS, top - 1e3 * FOOT_THICKNESS, top, PALM.segments)
    under = -sizes.tang / 2 - sizes.side_play
    neck = _cylinder(NECK * joint, top - 1, under, sizes.segments)
    lug = _cylinder(joint, -sizes.half_width, under, sizes.segments) ^ Manifold.sphere(sizes.radius, sizes.segments)
    return Drilled(disc + neck + lug, (_bore(sizes).rotate((90, 0, 0)),))


def _profile(length: float, sizes: Sizes) -> Manifold:
    """Return a square prism, whose sides are the flats of a link, from above its joint to below its end."""
    side, beyond = sizes.half_width, 2 * sizes.radius
    return _corners((-side, side), 2 * side, (-length - beyond, beyond))


def _room(length: float, sizes: Sizes, *, folds: bool) -> Manifold:
    """Return what a link may fill beside the one before it: half of what is between both where they are folded."""
    far, width = 4 * (length + sizes.radius), 2 * sizes.radius
    if not folds:
        return _corners((-far, far), 2 * width, (-far, 0))
    inward, back = ((math.pi - angle) / 2 - MARGIN for angle in (sizes.fold, sizes.back))
    planes = np.array([[math.cos(inward), -math.sin(inward)], [-math.cos(back), -math.sin(back)]])
    apex = np.linalg.solve(planes, np.full(2, sizes.gap / 2))
    sides = apex + far * np.array([[-math.sin(inward), -math.cos(inward)], [math.sin(back), -math.cos(back)]])
    return Manifold.hull_points(np.array([(x, y, z) for x, z in (apex, *sides) for y in (-width, width)]))


def _socket(joint: float, root: Root, sizes: Sizes) -> Manifold:
    """Return what is taken from a link for the lugs between which its tang turns, and for the neck of a foot."""
    wide = 2 * sizes.radius
    ball = Manifold.sphere(sizes.radius + sizes.gap, sizes.segments)
    lugs = ball if joint == sizes.radius else ball ^ _cylinder_y(joint + sizes.gap, 2 * wide, sizes)
    above = _corners((-wide, wide), 2 * wide, (-sizes.socket, wide))
    if root == "foot":  # it has a lug on one side only
        neck = _cylinder_y(NECK * joint + sizes.gap, 2 * wide, sizes)
        return (lugs + above + neck).trim_by_plane((0, -1, 0), sizes.tang / 2)
    return (lugs - _corners((-wide, wide), sizes.tang, (-wide, wide))) + above


@lru_cache(_LINKS)
def _swept() -> Manifold:
    """Return what a finger at angle 0 needs of the palm to swing inward."""
    reach, far, start = SIZES.radius + SIZES.gap, 3 * SIZES.radius, SIZES.socket - SIZES.gap
    shaft = _cylinder(reach, -start - far, -start)
    swing = np.linspace(PALM.swing[0] - MARGIN, 0, 5)
    turned = [shaft.rotate((0, -math.degrees(angle), 0)) for angle in swing]
    return Manifold.batch_hull(turned).translate((PALM.radius, 0, 0))


@lru_cache(_LINKS)
def _mount(joint: float) -> Manifold:
    """Return what carries the pin of a finger at angle 0, without its slot."""
    return _disc(joint, 2 * SIZES.half_width, SIZES).translate((PALM.radius, 0, 0))


@lru_cache(_LINKS)
def _slot_of_mount(joint: float) -> Manifold:
    """Return what the tang of a finger at angle 0 needs of the palm."""
    return _cylinder_y(joint + SIZES.gap, _slot(SIZES), SIZES).translate((PALM.radius, 0, 0))


def _bolts(sizes: PalmSizes) -> list[Manifold]:
    """Return the holes with which the palm is mounted: for bolts with their heads, and for cables."""
    head, depth = sizes.bolt_head
    bolt = _cylinder(sizes.bolt_diameter / 2, sizes.low - 1, sizes.high + 1) + _cylinder(
        head / 2, sizes.low - 1, sizes.low + depth
    )
    cables = _cylinder(sizes.cable_hole / 2, sizes.low - 1, sizes.high + 1)
    return [cables, *(bolt.translate((sizes.bolt_circle / 2, 0, 0)).rotate((0, 0, 45 + 90 * i)) for i in range(4))]


@lru_cache(_LINKS)
def pocket() -> Manifold:
    """Return the holes for a servo, its screws and its tendon, for a finger at angle 0."""
    top, radius = PALM.high, PALM.servo_radius
    (along, across, deep), (apart, pilot, screw), (hole, bore) = (
        PALM.servo_pocket, PALM.servo_screws, PALM.tendon_hole
    )  # fmt: skip
    body = _corners((radius - across / 2, radius + across / 2), along, (top - deep, top + 1))
    screws = [_cylinder(pilot / 2, top - screw, top + 1).translate((radius, y, 0)) for y in (-apart / 2, apart / 2)]
    tendon = _cylinder(bore / 2, PALM.low - 1, top + 1).translate((hole, 0, 0))
    return Manifold.batch_boolean([body, *screws, tendon], OpType.Add)


def _disc(joint: float, width: float, sizes: Sizes) -> Manifold:
    """Return what of a joint's ball is within its radius of the pin, and `width` wide along it."""
    wide = 2 * sizes.radius
    whole = joint == sizes.radius
    slab = _corners((-wide, wide), width, (-wide, wide)) if whole else _cylinder_y(joint, width, sizes)
    return Manifold.sphere(sizes.radius, sizes.segments) ^ slab


def _turned(outline: list[tuple[float, float]], segments: int) -> Manifold:
    """Return the body of revolution of an outline (radius, z) about z."""
    return Manifold.revolve(CrossSection([np.array(outline)]), segments)


def _corners(x: tuple[float, float], width: float, z: tuple[float, float]) -> Manifold:
    """Return a box, `width` wide about y = 0."""
    return Manifold.cube((x[1] - x[0], width, z[1] - z[0])).translate((x[0], -width / 2, z[0]))


def _slot(sizes: Sizes) -> float:
    return sizes.tang + 2 * sizes.side_play


def _bore(sizes: Sizes, play: float = 0.0) -> Manifold:
    """Return the pin's hole about y; the pin fits inside its facets."""
    radius = (sizes.pin_diameter + play) / 2 / math.cos(math.pi / sizes.segments)
    return _cylinder_y(radius, 4 * sizes.radius, sizes)


def _cylinder(radius: float, low: float, high: float, segments: int = SIZES.segments) -> Manifold:
    return Manifold.cylinder(high - low, radius, radius, segments).translate((0, 0, low))


def _cylinder_y(radius: float, width: float, sizes: Sizes) -> Manifold:
    return _cylinder(radius, -width / 2, width / 2, sizes.segments).rotate((90, 0, 0))


def mesh(part: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) float64 and faces (F, 3) int64."""
    flat = part.to_mesh64()
    return np.array(flat.vert_properties)[:, :3], np.array(flat.tri_verts).astype(np.int64)


def moments(vertices: np.ndarray, faces: np.ndarray) -> Moments:
    """Return the moments of a closed surface about the origin, by tetrahedra from there; in the vertices' unit."""
    corners = vertices[faces]  # (F, 3, 3)
    volumes = np.linalg.det(corners) / 6  # signed
    sums = corners.sum(1)
    squares = np.einsum("fci,fcj->fij", corners, corners) + np.einsum("fi,fj->fij", sums, sums)
    return Moments(float(volumes.sum()), volumes @ sums / 4, np.einsum("f,fij->ij", volumes, squares) / 20)
