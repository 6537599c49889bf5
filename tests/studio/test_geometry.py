"""The printable parts: whole for every length, free to move, inside the collision shapes, as heavy as the core says."""

import json
import math
from collections.abc import Iterable
from typing import get_args

import numpy as np
import pytest
import trimesh
from hypothesis import example, given
from hypothesis import strategies as st
from manifold3d import Manifold

from morph_core.tasks import arm, hand
from morph_core.tasks.printed import (
    DENSITY,
    FILE,
    Inertial,
    LinkKind,
    Servo,
    arm_link_inertial,
    link_inertial,
    palm_inertial,
)
from studio.robots.geometry import SIZES, arm_base, arm_link, link, mesh, moments, palm, pocket
from studio.robots.geometry import measured as measured_parts

LENGTHS = st.one_of(st.sampled_from([0.02, 0.4]), st.floats(*hand.LENGTH_BOX))  # m
MG90S_FLANGE = (32.6, 12.4)  # mm, along and across: what the servo covers of the palm's top
KINDS: tuple[LinkKind, ...] = ("proximal", "distal")


def measured(part: Manifold) -> Inertial:
    """Return a part's mass properties as trimesh sees them."""
    solid = trimesh.Trimesh(*mesh(part), process=False)
    solid.apply_scale(1e-3)
    solid.density = DENSITY
    return Inertial(float(solid.mass), np.asarray(solid.center_mass), np.asarray(solid.moment_inertia))


def agree(one: Inertial, other: Inertial) -> None:
    assert one.mass == pytest.approx(other.mass, rel=1e-9)
    np.testing.assert_allclose(one.com, other.com, atol=1e-11)
    np.testing.assert_allclose(one.inertia, other.inertia, rtol=0, atol=1e-9 * np.abs(other.inertia).max())


def test_the_core_knows_the_parts_as_they_are_drawn_today() -> None:
    """If not: `python -m studio.robots.geometry`."""

    def numbers(node: object) -> list[float]:
        children = node.values() if isinstance(node, dict) else node
        return [x for child in children for x in numbers(child)] if isinstance(children, Iterable) else [node]

    drawn, known = measured_parts(), json.loads(FILE.read_text())
    assert list(drawn) == list(known)
    np.testing.assert_allclose(numbers(known), numbers(drawn), rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@given(length=LENGTHS)
@example(length=0.02)
@example(length=0.12)
@example(length=0.4)
def test_a_link_of_any_length_is_one_watertight_body_as_heavy_as_simulated(kind: LinkKind, length: float) -> None:
    part = link(kind, 1e3 * length)
    solid = trimesh.Trimesh(*mesh(part), process=False)
    assert solid.is_watertight
    assert solid.is_volume
    assert len(part.decompose()) == 1
    agree(link_inertial(kind, length), measured(part))


@pytest.mark.parametrize("servo", get_args(Servo))
@given(angles=st.lists(st.floats(-math.pi, math.pi), min_size=1, max_size=5))
@example([0.0, 2 * math.asin(hand.FINGER_RADIUS / hand.PALM_RADIUS)])
@example([0.0, 2 * math.asin(hand.SPACING["mg90s"] / 2 / hand.PALM_RADIUS), -math.pi / 4, math.pi])
def test_a_palm_is_one_watertight_body_as_heavy_as_simulated(servo: Servo, angles: list[float]) -> None:
    part = palm(tuple(angles), servo)
    solid = trimesh.Trimesh(*mesh(part), process=False)
    assert solid.is_volume
    assert len(part.decompose()) == 1
    simulated = palm_inertial(np.array(angles), servo)
    pins = hand.PALM_RADIUS * np.exp(1j * np.array(angles))
    apart = np.abs(pins[:, None] - pins)[np.triu_indices(len(angles), 1)]
    if (apart >= hand.SPACING[servo] - 1e-12).all():
        agree(simulated, measured(part))
    elif servo == "none":  # such a hand can't be assembled
        assert simulated.mass >= measured(part).mass * (1 - 1e-9)


def test_servos_of_neighbours_stand_beside_each_other_and_beside_the_flange_that_holds_the_palm() -> None:
    (along, across), radius = MG90S_FLANGE, SIZES.servo_radius
    flange = Manifold.cube((across, along, 20.0)).translate((radius - across / 2, -along / 2, SIZES.palm_high))
    angle = 2 * math.degrees(math.asin(hand.SPACING["mg90s"] / 2 / hand.PALM_RADIUS))
    assert (flange ^ flange.rotate((0, 0, angle))).volume() == 0
    assert (pocket() ^ pocket().rotate((0, 0, angle))).volume() == 0
    corner = math.hypot(radius + across / 2, along / 2)
    assert corner <= SIZES.palm_radius - SIZES.palm_chamfer  # it lies on the palm
    iso_9409_1_50 = 63.0 / 2  # mm
    assert radius - across / 2 > iso_9409_1_50


@pytest.mark.parametrize("kind", KINDS)
@given(length=st.floats(0.05, 5.0))
@example(length=0.05)
@example(length=5.0)
def test_the_arms_links_lie_along_x_inside_their_capsules_as_heavy_as_simulated(kind: LinkKind, length: float) -> None:
    part = arm_link(kind, 1e3 * length)
    vertices, _ = mesh(part)
    along = np.clip(vertices[:, 0], 0.0, 1e3 * length)
    away = np.linalg.norm(vertices - np.stack([along, 0 * along, 0 * along], 1), axis=1)
    assert away.max() <= 1e3 * arm.LINK_RADIUS
    agree(arm_link_inertial(kind, length), measured(part))


def test_the_arm_turns_on_its_foot_which_its_collision_shape_encloses() -> None:
    vertices, _ = mesh(arm_base())
    assert np.hypot(vertices[:, 0], vertices[:, 1]).max() <= 2e3 * arm.LINK_RADIUS
    assert np.abs(vertices[:, 2]).max() <= 1e3 * arm.LINK_RADIUS
    assert (arm_base() ^ arm_link("proximal", 50.0)).volume() == 0


def test_a_finger_moves_through_its_whole_range_without_its_parts_touching() -> None:
    low, high = hand.DISTAL_RANGE
    proximal, distal, base = link("proximal", 20.0), link("distal", 20.0), palm((0.0,))
    for angle in np.linspace(low, high, 29):
        turned = distal.rotate((0, math.degrees(angle), 0)).translate((0, 0, -20))
        assert (turned ^ proximal).volume() == 0, f"distal at {angle} rad"
    low, high = hand.PROXIMAL_RANGE
    for angle in np.linspace(low, high, 29):
        turned = proximal.rotate((0, -math.degrees(angle), 0)).translate((1e3 * hand.PALM_RADIUS, 0, 0))
        assert (turned ^ base).volume() == 0, f"proximal at {angle} rad"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("length", [20.0, 400.0])
def test_the_collision_capsule_encloses_a_link(kind: LinkKind, length: float) -> None:
    vertices, _ = mesh(link(kind, length))
    along = np.clip(vertices[:, 2], -length, 0.0)
    away = np.linalg.norm(vertices - np.stack([0 * along, 0 * along, along], 1), axis=1)
    assert away.max() <= 1e3 * hand.FINGER_RADIUS


def test_the_palms_disc_and_the_ends_of_the_fingers_enclose_the_palm() -> None:
    vertices, _ = mesh(palm((0.0,)))
    radius, middle, half = 1e3 * hand.PALM_RADIUS, 1e3 * hand.FINGER_RADIUS, 1e3 * hand.PALM_THICKNESS / 2
    disc = (np.hypot(vertices[:, 0], vertices[:, 1]) <= radius) & (np.abs(vertices[:, 2] - middle) <= half)
    finger = np.linalg.norm(vertices - [radius, 0, 0], axis=1) <= 1e3 * hand.FINGER_RADIUS
    assert (disc | finger).all()


def test_moments_of_a_box_are_those_of_the_textbook() -> None:
    box = trimesh.creation.box((2.0, 3.0, 4.0))
    box.apply_translation((1.0, 0.0, 0.0))
    found = moments(np.asarray(box.vertices), np.asarray(box.faces))
    assert found.volume == pytest.approx(24)
    np.testing.assert_allclose(found.first, [24, 0, 0], atol=1e-12)
    np.testing.assert_allclose(np.diag(found.second), [24 * (4 / 12 + 1), 24 * 9 / 12, 24 * 16 / 12])
