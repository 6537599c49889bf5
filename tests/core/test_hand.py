"""The hand: its kinematics from phi alone, its box, and what may stand beside what."""

import itertools

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.tasks.hand import (
    FINGER_RADIUS,
    LENGTH_BOX,
    PALM_RADIUS,
    PALM_RANGE,
    PLACEMENT_BOX,
    START_CLEARANCE,
    Hand,
)
from morph_core.tasks.pen_press import PenPress
from morph_core.tasks.printed import LINKS, Moments, link_inertial

HAND = Hand(4, 0.12)
TASK = PenPress()
placements = st.lists(st.floats(*PLACEMENT_BOX), min_size=4, max_size=4)
lengths = st.lists(st.floats(*LENGTH_BOX), min_size=4, max_size=4)
designs = st.tuples(placements, lengths).map(lambda parts: np.concatenate(parts))
seeds = st.integers(0, 2**32 - 1)


def fingertips(phi: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the tips (4, 3) of the hand in posture q (9,): in its own plane a finger is an arm of two links."""
    angle, length = np.arange(4) * np.pi / 2 + phi[:4], phi[4:]
    first, second = q[1::2], q[1::2] - q[2::2]  # from straight down, outward
    out = PALM_RADIUS + length * (np.sin(first) + np.sin(second))
    down = length * (np.cos(first) + np.cos(second))
    return np.stack([out * np.cos(angle), out * np.sin(angle), q[0] - down], 1)


def posture(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(*HAND.joint_range.T)


def simulated_tips(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[: len(qpos)] = qpos
    mujoco.mj_kinematics(model, data)
    distal = [model.geom(f"finger_{i}_distal").id for i in range(1, 5)]
    half = model.geom_size[distal, 1]
    ends = [data.geom_xpos[distal] + sign * half[:, None] * data.geom_xmat[distal][:, 2::3] for sign in (-1, 1)]
    joints = data.xpos[[model.body(f"finger_{i}_distal").id for i in range(1, 5)]]
    far = np.linalg.norm(ends[0] - joints, axis=1) > np.linalg.norm(ends[1] - joints, axis=1)
    return np.where(far[:, None], ends[0], ends[1])


@settings(max_examples=25)
@given(designs, seeds)
def test_the_fingertips_are_where_two_links_in_a_plane_have_them(phi: np.ndarray, seed: int) -> None:
    q = posture(np.random.default_rng(seed))
    for model in (HAND.spec(phi, "hand").compile(), TASK.scene(phi).compile()):
        assert np.allclose(simulated_tips(model, q), fingertips(phi, q), atol=1e-9)


@settings(max_examples=15)
@given(designs)
def test_a_design_compiled_again_is_the_same_model_to_the_last_bit(phi: np.ndarray) -> None:
    def compiled() -> np.ndarray:
        model = TASK.scene(phi).compile()
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        return buffer

    assert np.array_equal(compiled(), compiled())


@given(designs)
def test_the_start_spreads_the_fingers_above_the_table(phi: np.ndarray) -> None:
    q = HAND.start(phi)
    assert (q >= HAND.joint_range[:, 0]).all()
    assert (q <= HAND.joint_range[:, 1]).all()
    lowest = fingertips(phi, q)[:, 2].min()
    assert lowest == pytest.approx(START_CLEARANCE, abs=1e-9) or q[0] == PALM_RANGE[1]
    assert lowest > FINGER_RADIUS


def test_the_start_of_many_designs_is_that_of_each() -> None:
    many = np.random.default_rng(0).uniform(HAND.design_space.lo, HAND.design_space.hi, (16, 8))
    assert np.array_equal(HAND.start(many), np.stack([HAND.start(phi) for phi in many]))
    assert np.array_equal(HAND.interpenetrates(many), [HAND.interpenetrates(phi) for phi in many])


@given(placements)
def test_fingers_interpenetrate_where_their_bases_overlap(changes: list[float]) -> None:
    angle = np.arange(4) * np.pi / 2 + changes
    base = PALM_RADIUS * np.stack([np.cos(angle), np.sin(angle)], 1)
    nearest = min(np.linalg.norm(p - q) for p, q in itertools.combinations(base, 2))
    assert HAND.interpenetrates(np.array([*changes, *[0.1] * 4])) == (nearest < 2 * FINGER_RADIUS)


def test_a_finger_turned_by_a_quarter_stands_in_its_neighbour() -> None:
    phi = HAND.design_space.initial
    assert not HAND.interpenetrates(phi)
    phi[0] = np.pi / 2
    assert HAND.interpenetrates(phi)
    phi[1] = np.pi / 2
    assert HAND.interpenetrates(phi)  # now the second stands in the third
    phi[:4] = np.pi / 2
    assert not HAND.interpenetrates(phi)


def test_every_corner_of_the_box_can_be_simulated() -> None:
    sets = [
        [0.0] * 4, [np.pi] * 4, [-np.pi] * 4, [0.9, 0, 0, -0.9], [0, 0.5, -0.5, 0], [0.5, -0.5, 0.5, -0.5],
        [1.0, 1.0, -1.0, -1.0],  # the second stands in the third
    ]  # fmt: skip
    corners = np.array([[*where, *long] for where in sets for long in itertools.product(LENGTH_BOX, repeat=4)])
    apart = ~HAND.interpenetrates(corners)
    assert apart.reshape(len(sets), -1)[:6].all()
    hw_phy = TASK.hw_phy(corners)
    s = TASK.reset(hw_phy, len(corners), np.random.default_rng(0))
    for _ in range(20):  # 200 steps of physics
        step = TASK.step(hw_phy, s, np.zeros((len(s), TASK.action_size)))
        assert np.array_equal(step.diverged, ~apart)
        assert np.isfinite(step.s).all()
        assert np.isfinite(step.z).all()
        s = step.s
    assert np.abs(TASK.split(s)[1]).max() < 3.0  # m/s or rad/s: at rest, or falling onto the pen


@settings(max_examples=20)
@given(designs)
def test_a_finger_is_as_long_and_as_heavy_as_its_design_says(phi: np.ndarray) -> None:
    model = HAND.spec(phi, "hand").compile()
    for i, length in enumerate(phi[4:], 1):
        for part in LINKS:
            assert 2 * model.geom(f"finger_{i}_{part}").size[1] == pytest.approx(length)
            body, inertial = model.body(f"finger_{i}_{part}"), link_inertial(part, float(length))
            assert body.mass == pytest.approx(inertial.mass)
            assert body.ipos == pytest.approx(inertial.com)
    mass = [model.body(f"finger_{i}_distal").mass[0] for i in range(1, 5)]
    assert np.array_equal(np.argsort(mass, kind="stable"), np.argsort(phi[4:], kind="stable"))
    assert min(mass) > 0


def test_the_inertia_of_a_box_is_that_of_the_textbook_wherever_it_stands() -> None:
    side, middle, density = np.array([0.1, 0.2, 0.3]), np.array([1.0, -2.0, 3.0]), 1000.0
    volume = float(np.prod(side))
    second = volume * (np.diag(side**2 / 12) + np.outer(middle, middle))
    box = Moments(volume, volume * middle, second)
    for factor in (1.0, 2.0):
        found = box.scaled(factor).inertial(density)
        mass = density * volume * factor**3
        assert found.mass == pytest.approx(mass)
        assert found.com == pytest.approx(factor * middle)
        expected = np.diag((side**2).sum() - side**2) * factor**2 * mass / 12
        assert found.inertia == pytest.approx(expected, abs=1e-9 * mass)
