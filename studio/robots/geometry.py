"""The printable parts in millimetres: links with a tang, a clevis or a fingertip, and pin bores; palm and base.

A link hangs from its joint along -z and turns about y. Only its prismatic shaft grows with its length, so that its
mass properties are the polynomials of `morph_core.tasks.printed`, and the shortest link is one body like the longest.
"""

import json
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import get_args

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

from morph_core.tasks.printed import ARM_SCALE, FILE, LAID, LinkKind, LinkMoments, Moments, Servo


@dataclass(frozen=True)
class Sizes:
    """Sizes of the parts in mm, unless a field says otherwise.

    The shortest link has little room: the tests tell when a change needs more.
    """

    wall: float = 4.0
    """Thickness of the material round a pin's bore."""
    pin_diameter: float = 4.0
    """Diameter of a dowel pin, which is pressed into the lugs."""
    pin_play: float = 0.2
    """Difference of the diameters of the tang's bore and of the pin."""
    tang: float = 8.0
    """Thickness of the tang, along the pin."""
    side_play: float = 0.3
    """Distance between the tang and each lug."""
    gap: float = 0.5
    """Distance between a lug's round and the shoulder that turns round it."""
    half_width: float = 11.0
    """Half the width of links and mounts, along the pin."""
    half_depth: float = 6.0
    """Half the depth of a link's shaft, across the pin."""
    corner: float = 3.0
    """Radius of the shaft's edges."""
    chamfer: float = 1.0
    """Width of a shoulder's chamfer."""
    fold: float = 2.2
    """rad: largest angle by which a distal link can be folded against its proximal one, either way."""
    overlap: float = 0.4
    """Length by which pieces reach into each other, to become one body."""
    tip_start: float = 7.4
    """Distance before the end of the link at which the fingertip begins to taper."""
    tip_reach: float = 14.5
    """Length by which the fingertip reaches beyond the end of the link."""
    tip_radii: tuple[float, float, float] = (5.0, 8.5, 6.0)
    """Radii of the fingertip's round end: depth, width, length."""
    segments: int = 48
    """Facets round a pin, a bore or a fingertip (a count)."""
    palm_radius: float = 59.5
    """Radius of the palm."""
    palm_low: float = 8.0
    """Height of the palm's underside above the pins of the fingers, which turn below it."""
    palm_high: float = 27.0
    """Height of the palm's top above the pins of the fingers."""
    palm_chamfer: float = 2.0
    """Width of the chamfer of the palm's edges."""
    palm_segments: int = 120
    """Facets round the palm (a count)."""
    mount_radius: float = 60.0
    """Distance of the fingers' pins from the palm's axis."""
    mount_root: tuple[float, float] = (44.0, 54.0)
    """Distances from the palm's axis between which a mount meets the palm."""
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
    foot_radius: float = 47.5
    """Radius of the arm's foot, before it is enlarged like the links."""
    foot_high: float = -12.0
    """Height of the top of the foot's disc above the axis of the arm, before it is enlarged."""
    foot_low: float = -24.0
    """Height of the foot's underside above the axis of the arm, before it is enlarged."""

    @property
    def joint_radius(self) -> float:
        """Radius of tang and lugs round the pin."""
        return self.pin_diameter / 2 + self.wall

    @property
    def shoulder(self) -> float:
        """Distance from the pin of the shoulders, and of a slot's floor."""
        return self.joint_radius + self.gap

    @property
    def neck(self) -> float:
        """Half-depth of a link at its shoulder, where it can be folded: half the angle belongs to each of two links."""
        half = (math.pi - self.fold) / 2
        return self.shoulder * math.tan(half) - self.gap / 2 / math.cos(half)

    @property
    def relief(self) -> float:
        """Distance from the pin at which a link that can be folded has its full depth."""
        half = (math.pi - self.fold) / 2
        return (self.half_depth + self.gap / 2 / math.cos(half)) / math.tan(half)


SIZES = Sizes()
_LINKS = 16
"""Size of the link caches: one design's worth. A larger cache grew a long-watched studio."""


@lru_cache(_LINKS)
def link(kind: LinkKind, length: float, sizes: Sizes = SIZES) -> Manifold:
    """Return a link of `length` mm in the frame of its joint."""
    if kind == "proximal":
        neck = sizes.half_depth - sizes.chamfer
        return _clevis_shaft(length, sizes) + _eye(sizes, neck, sizes.tang) - _bore(sizes, sizes.pin_play)
    return _tip_shaft(length, sizes) + _eye(sizes, sizes.neck, sizes.tang) - _bore(sizes, sizes.pin_play)


@lru_cache(2)
def palm(angles: tuple[float, ...], servo: Servo = "none", sizes: Sizes = SIZES) -> Manifold:
    """Return the palm with mounts, and pockets for servos above them, at `angles` rad.

    Its origin is on its axis, at the height of the fingers' pins.
    """

    def round_it(piece: Manifold) -> list[Manifold]:
        return [piece.rotate((0, 0, math.degrees(angle))) for angle in angles]

    body = Manifold.batch_boolean([plate(sizes), *round_it(mount(sizes))], OpType.Add)
    return body if servo == "none" else Manifold.batch_boolean([body, *round_it(pocket(sizes))], OpType.Subtract)


@lru_cache(2)
def plate(sizes: Sizes = SIZES) -> Manifold:
    """Return the palm without mounts."""
    radius, low, high, c = sizes.palm_radius, sizes.palm_low, sizes.palm_high, sizes.palm_chamfer
    profile = [
        (sizes.cable_hole / 2, low), (radius - c, low), (radius, low + c), (radius, high - c), (radius - c, high),
        (sizes.cable_hole / 2, high),
    ]  # fmt: skip
    disc = _turned(profile, sizes)
    head, depth = sizes.bolt_head
    bolt = _cylinder(sizes.bolt_diameter / 2, low - 1, high + 1, sizes) + _cylinder(
        head / 2, low - 1, low + depth, sizes
    )
    bolts = [bolt.translate((sizes.bolt_circle / 2, 0, 0)).rotate((0, 0, 45 + 90 * i)) for i in range(4)]
    return disc - Manifold.batch_boolean(bolts, OpType.Add)


@lru_cache(2)
def mount(sizes: Sizes = SIZES, overlap: float = SIZES.overlap) -> Manifold:
    """Return the clevis of a finger at angle 0, reaching into the palm by `overlap`."""
    near, far = sizes.mount_root
    root = _corners((near, far), 2 * sizes.half_width, (sizes.palm_low, sizes.palm_low + 1))
    pin, eye = sizes.mount_radius, _cylinder_y(sizes.joint_radius, 2 * sizes.half_width, sizes)
    # The neck begins above the pin: the shoulder of a finger that bends inward turns below it.
    low = 0.3 * sizes.joint_radius
    half = math.sqrt(sizes.joint_radius**2 - low**2) - 0.1
    neck = _corners((pin - half, pin + half), 2 * sizes.half_width, (low, low + 1))
    block = Manifold.batch_hull([neck, root]).trim_by_plane((0, 0, -1), -sizes.palm_low - overlap)
    block += eye.translate((pin, 0, 0))
    slot = _corners((pin - sizes.shoulder, 1e3), _slot(sizes), (-1e3, sizes.palm_low))
    return block - slot - _bore(sizes).translate((pin, 0, 0))


@lru_cache(2)
def pocket(sizes: Sizes = SIZES) -> Manifold:
    """Return what a servo's pocket, its screws and its tendon take from the palm, for a finger at angle 0."""
    top, radius = sizes.palm_high, sizes.servo_radius
    (along, across, deep), (apart, pilot, screw), (hole, bore) = (
        sizes.servo_pocket, sizes.servo_screws, sizes.tendon_hole
    )  # fmt: skip
    body = _corners((radius - across / 2, radius + across / 2), along, (top - deep, top))
    screws = [_cylinder(pilot / 2, top - screw, top, sizes).translate((radius, y, 0)) for y in (-apart / 2, apart / 2)]
    tendon = _cylinder(bore / 2, sizes.palm_low, top, sizes).translate((hole, 0, 0))
    return Manifold.batch_boolean([body, *screws, tendon], OpType.Add)


@lru_cache(_LINKS)
def arm_link(kind: LinkKind, length: float, sizes: Sizes = SIZES) -> Manifold:
    """Return a link of the arm of `length` mm, which lies along x and turns about z: a finger's, enlarged."""
    return link(kind, length / ARM_SCALE, sizes).transform(np.column_stack([ARM_SCALE * LAID, np.zeros(3)]))


@lru_cache(2)
def arm_base(sizes: Sizes = SIZES) -> Manifold:
    """Return the arm's foot: a disc and a boss, on which the first link turns round its pin."""
    bore, top = sizes.pin_diameter / 2, -sizes.tang / 2 - sizes.side_play
    outline = [
        (bore, sizes.foot_low), (sizes.foot_radius, sizes.foot_low), (sizes.foot_radius, sizes.foot_high),
        (sizes.joint_radius, sizes.foot_high), (sizes.joint_radius, top), (bore, top),
    ]  # fmt: skip
    return _turned(outline, sizes).scale((ARM_SCALE, ARM_SCALE, ARM_SCALE))


def _turned(outline: list[tuple[float, float]], sizes: Sizes) -> Manifold:
    """Return the body of revolution of an outline (radius, z) about z."""
    return Manifold.revolve(CrossSection([np.array(outline)]), sizes.palm_segments)


def _clevis_shaft(length: float, sizes: Sizes) -> Manifold:
    """Return a shaft with a shoulder at its joint and a clevis at its end."""
    h, c, shoulder = sizes.half_depth, sizes.chamfer, sizes.shoulder
    outline = [(h - c, -shoulder), (h, -shoulder - c), (h, sizes.relief - length), (sizes.neck, shoulder - length)]
    end = (0, 0, -length)
    lugs = _eye(sizes, sizes.neck, 2 * sizes.half_width).mirror((0, 0, 1)).translate(end)
    slot = _corners((-1e3, 1e3), _slot(sizes), (-1e3, shoulder)).translate(end)
    return ((_extruded(outline, sizes) + lugs) ^ _prism(length, sizes)) - slot - _bore(sizes).translate(end)


def _tip_shaft(length: float, sizes: Sizes) -> Manifold:
    """Return a shaft that can be folded at its joint, and tapers into a fingertip."""
    taper = [(x, y, z) for x, y in _section(sizes) for z in (-sizes.shoulder, sizes.tip_start - length)]
    radius = sizes.tip_radii[2]
    ball = Manifold.sphere(1.0, sizes.segments).scale(sizes.tip_radii)
    ball = ball.translate((0, 0, radius - sizes.tip_reach - length))
    outline = [
        (sizes.neck, -sizes.shoulder), (sizes.half_depth, -sizes.relief), (sizes.half_depth, -sizes.tip_reach - length),
    ]  # fmt: skip
    return Manifold.batch_hull([Manifold.hull_points(np.array(taper)), ball]) ^ _extruded(outline, sizes)


def _eye(sizes: Sizes, neck: float, width: float) -> Manifold:
    """Return a round lug about y; its neck reaches down into the shaft."""
    foot = _corners((-neck, neck), width, (-sizes.shoulder - sizes.overlap, -sizes.shoulder))
    return Manifold.batch_hull([_cylinder_y(sizes.joint_radius, width, sizes), foot])


def _extruded(outline: list[tuple[float, float]], sizes: Sizes) -> Manifold:
    """Return the convex body between an outline (x, z) and its mirror image, as wide as a link."""
    y = sizes.half_width
    return Manifold.hull_points(np.array([(a * x, b * y, z) for x, z in outline for a in (-1, 1) for b in (-1, 1)]))


def _prism(length: float, sizes: Sizes) -> Manifold:
    """Return the shaft's rounded section from above the joint to below the link's end."""
    ends = (sizes.joint_radius + 1, -length - sizes.joint_radius - 1)
    return Manifold.hull_points(np.array([(x, y, z) for x, y in _section(sizes) for z in ends]))


def _section(sizes: Sizes) -> list[tuple[float, float]]:
    """Return the corners (x, y) of the shaft's section."""
    c, quarter = sizes.corner, sizes.segments // 4
    angles = [math.pi / 2 * i / quarter for i in range(quarter + 1)]
    x, y = sizes.half_depth - c, sizes.half_width - c
    return [(a * (x + c * math.cos(t)), b * (y + c * math.sin(t))) for t in angles for a in (-1, 1) for b in (-1, 1)]


def _corners(x: tuple[float, float], width: float, z: tuple[float, float]) -> Manifold:
    """Return a box, `width` wide about y = 0."""
    return Manifold.cube((x[1] - x[0], width, z[1] - z[0])).translate((x[0], -width / 2, z[0]))


def _slot(sizes: Sizes) -> float:
    return sizes.tang + 2 * sizes.side_play


def _bore(sizes: Sizes, play: float = 0.0) -> Manifold:
    """Return the pin's hole about y; the pin fits inside its facets."""
    radius = (sizes.pin_diameter + play) / 2 / math.cos(math.pi / sizes.segments)
    return _cylinder_y(radius, 4 * sizes.half_width, sizes)


def _cylinder(radius: float, low: float, high: float, sizes: Sizes) -> Manifold:
    return Manifold.cylinder(high - low, radius, radius, sizes.segments).translate((0, 0, low))


def _cylinder_y(radius: float, width: float, sizes: Sizes) -> Manifold:
    return _cylinder(radius, -width / 2, width / 2, sizes).rotate((90, 0, 0))


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


def measured_link(kind: LinkKind, sizes: Sizes = SIZES) -> LinkMoments:
    """Return the polynomials through four drawn links."""
    lengths = np.array([0.02, 0.1, 0.25, 0.4])  # m
    drawn = [moments(*mesh(link(kind, 1e3 * length, sizes))).scaled(1e-3) for length in lengths]

    def through(values: list[float], degree: int) -> tuple[float, ...]:
        return tuple(float(c) for c in np.polynomial.polynomial.polyfit(lengths, values, degree))

    return LinkMoments(
        volume=through([m.volume for m in drawn], 1),
        z=through([m.first[2] for m in drawn], 2),
        xx=through([m.second[0, 0] for m in drawn], 1),
        yy=through([m.second[1, 1] for m in drawn], 1),
        zz=through([m.second[2, 2] for m in drawn], 3),
    )


def measured() -> dict[str, object]:
    """Return what `morph_core.tasks.printed` knows of the parts as they are drawn here, in metres."""
    drawn: dict[str, object] = {"links": {kind: vars(measured_link(kind)) for kind in get_args(LinkKind)}}
    for name, part in (("plate", plate()), ("mount", mount(SIZES, overlap=0.0)), ("pocket", pocket())):
        m = moments(*mesh(part)).scaled(1e-3)
        # All are symmetric about y = 0, the palm's plate in every direction round its axis.
        first = [0.0 if name == "plate" else float(m.first[0]), 0.0, float(m.first[2])]
        second = np.where(np.abs(m.second) > 1e-9 * np.abs(m.second).max(), m.second, 0.0).tolist()
        drawn[name] = {"volume": m.volume, "first": first, "second": second}
    return drawn


if __name__ == "__main__":
    FILE.write_text(json.dumps(measured(), indent=1) + "\n")
