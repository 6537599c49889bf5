"""The exploration of z: designs around phi, and the pulls on the proxy."""

import itertools
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.catalogue import make_task
from morph_core.divergence import divergence_gradient
from morph_core.exploration import Relabelled, relabel_on_hardware, run_trajectories
from morph_core.explorations.design import Design
from morph_core.explorations.gaussian_iid import GaussianIid
from morph_core.parts import Schedule
from morph_core.rollout import Rollout
from morph_core.spread import ExploredDesigns, Spread, nearest_buildable
from morph_core.state import State, start
from tests.core.conftest import SMALL

TASK = make_task("reacher")
DESIGN = Design()


def explored(pairs: int = 0) -> tuple[State, Rollout, Relabelled]:
    state = start(TASK, SMALL, 0)
    designs = Spread(0.5, 0.0).designs(state, SMALL.trajectories)
    rollout = run_trajectories(TASK, state, TASK.hw_phy(designs), SMALL.trajectories)
    return state, rollout, relabel_on_hardware(rollout, TASK.hw_phy(state.phi), pairs, state.rng)


def test_designs_come_in_antithetic_pairs_inside_the_box() -> None:
    state = start(TASK, SMALL, 0)
    designs = Spread(0.3, 0.0).designs(state, 64)
    assert np.allclose(designs[:32] + designs[32:], 2 * state.phi)
    wide = Spread(30.0, 0.0).designs(state, 64)
    assert (wide >= TASK.design_space.lo).all()
    assert (wide <= TASK.design_space.hi).all()


def test_locked_parameters_are_not_explored() -> None:
    state = start(TASK, SMALL, 0, TASK.design_space.with_lock("link_3", 1.25))
    assert (Spread(0.8, 0.0).designs(state, 64)[:, 2] == 1.25).all()


@settings(max_examples=20)
@given(st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_the_parameters_of_a_group_have_the_said_share_of_variance_in_common(share: float, seed: int) -> None:
    task = make_task("pen_press")
    state = start(task, SMALL, seed)
    state.rng = np.random.default_rng(seed)
    half = Spread(0.05, share).designs(state, 8000)[:4000]  # so narrow that no design reaches the box
    unit = (half - state.phi) / (0.05 * task.design_space.scale)
    expected = np.eye(8)
    expected[4:, 4:] += share * (1 - np.eye(4))  # the lengths are a group, the placements are not
    assert np.allclose(unit.T @ unit / len(unit), expected, atol=0.12)


def test_the_antithetic_pairs_stay_pairs_under_correlation() -> None:
    state = start(make_task("pen_press"), SMALL, 0)
    designs = Spread(0.1, 0.7).designs(state, 64)
    assert np.allclose(designs[:32] + designs[32:], 2 * state.phi)
    assert np.array_equal(state.explored, designs)  # pyright: ignore[reportArgumentType] - it is set


def test_sigma_anneals_geometrically_and_then_stays() -> None:
    designs, schedule = ExploredDesigns(correlation=0.3), Schedule(iterations=11)
    first, middle, last, beyond = (designs.spread(schedule, i) for i in (1, 6, 11, 500))
    assert first.sigma == pytest.approx(designs.sigma)
    assert middle.sigma == pytest.approx(np.sqrt(designs.sigma * designs.sigma_end))
    assert last.sigma == beyond.sigma == pytest.approx(designs.sigma_end)
    assert first.correlation == beyond.correlation == 0.3
    assert schedule.geometric(2.0, 2.0, 5) == 2.0


@given(st.integers(2, 60), st.floats(0, 0.9), st.floats(0.1, 3), st.floats(0.01, 1))
def test_a_held_sigma_waits_falls_and_arrives(iterations: int, hold: float, first: float, last: float) -> None:
    designs, schedule = ExploredDesigns(sigma=first, sigma_end=first * last, hold=hold), Schedule(iterations)
    sigmas = [designs.spread(schedule, i).sigma for i in range(1, iterations + 5)]
    held = [sigma for i, sigma in enumerate(sigmas) if i <= hold * (iterations - 1)]
    assert held == pytest.approx([first] * len(held))
    assert all(later <= sooner * (1 + 1e-12) for sooner, later in itertools.pairwise(sigmas))
    assert sigmas[iterations - 1 :] == pytest.approx([first * last] * 5)


def test_the_policys_noise_is_not_held() -> None:
    designs, schedule = ExploredDesigns(hold=0.5), Schedule(iterations=11)
    assert designs.spread(schedule, 6).sigma == designs.sigma
    assert schedule.geometric(1.0, 0.25, 6) == pytest.approx(0.5)


def test_episode_advantages_are_standardised_and_limited() -> None:
    designs = ExploredDesigns(advantage_limit=3.0)
    advantage = designs.advantage(np.array([0.0] * 99 + [1000.0]))
    assert advantage.max() == 3.0
    assert abs(advantage[:99].mean()) < 0.2
    assert (designs.advantage(np.ones(8)) == 0).all()


@given(st.lists(st.floats(-1e6, 1e6), min_size=4, max_size=60, unique=True), st.randoms(use_true_random=False))
def test_ranks_alone_decide_the_log_rank_utility(returns: list[float], shuffle: random.Random) -> None:
    designs = ExploredDesigns(utility="log_rank", advantage_limit=100.0)
    values = np.sort(returns)[::-1]
    advantage = designs.advantage(values)
    assert abs(advantage.mean()) < 1e-9
    assert advantage.std(ddof=1) == pytest.approx(1.0)
    assert (np.diff(advantage) <= 1e-12).all()
    worse_half = advantage[(len(values) + 1) // 2 :]
    assert np.allclose(worse_half, worse_half[0])  # CMA-ES gives them no weight
    order = list(range(len(values)))
    shuffle.shuffle(order)
    assert np.allclose(designs.advantage(values[order]), advantage[order])
    assert np.allclose(designs.advantage(np.arange(len(values))[::-1] ** 3.0), advantage)


def test_the_linearised_pull_moves_z_towards_what_good_episodes_did() -> None:
    state, rollout, pairs = explored()
    pull = DESIGN.pull(state, rollout, pairs, np.zeros(rollout.steps, np.float32))
    gradient = pull(np.zeros(pairs.z.shape, np.float32), np.arange(len(pairs)))
    rows = pairs.episode == rollout.returns.argmax()
    drift = pairs.z - pairs.z_phi
    assert rows.sum() > 0
    assert ((-gradient[rows] * drift[rows]).sum(-1) > 0).all()


def test_the_optimum_of_pull_and_divergence_is_where_the_docstring_says() -> None:
    state, rollout, pairs = explored()
    advantage = DESIGN.advantage(rollout.returns)[pairs.episode]
    alpha = 1.7
    eta = DESIGN.kappa / (2 * alpha * DESIGN.z_sigma**2)
    m = (pairs.z_phi + eta * advantage[:, None] * (pairs.z - pairs.z_phi)).astype(np.float32)
    g_hw = divergence_gradient(m, pairs.z_phi.astype(np.float32))
    pull = DESIGN.pull(state, rollout, pairs, np.zeros(rollout.steps, np.float32))
    g_task = pull(m, np.arange(len(pairs)))
    assert np.abs(g_hw).max() > 1e-5
    assert np.allclose(g_task + alpha * g_hw, 0, atol=1e-6)


@pytest.mark.parametrize("sampled", [0, 100])
def test_the_clipped_pull_vanishes_beyond_the_clip(sampled: int, monkeypatch: pytest.MonkeyPatch) -> None:
    state, rollout, pairs = explored(sampled)
    z, index = pairs.z.astype(np.float32), np.arange(len(pairs))

    def pull_at(m_before: np.ndarray, m: np.ndarray) -> np.ndarray:
        monkeypatch.setattr(state, "proxy", lambda *_: m_before)
        return GaussianIid().pull(state, rollout, pairs, np.ones(rollout.steps, np.float32))(m, index)

    assert np.abs(pull_at(z - 0.05, z - 0.05)).sum() > 0
    assert np.abs(pull_at(z - 0.5, z)).sum() == 0  # far better: the ratio at z is far above 1 + clip


@pytest.mark.parametrize("asked", [0, 100, 10**6])
def test_relabelled_pairs_are_those_of_the_rollout(asked: int) -> None:
    state, rollout, _ = explored()
    pairs = relabel_on_hardware(rollout, TASK.hw_phy(state.phi), asked, state.rng)
    alive = rollout.steps
    assert len(pairs) == pairs.steps == (100 if asked == 100 else alive)
    assert len(set(pairs.row.tolist())) == len(pairs)
    assert np.array_equal(pairs.s, rollout.s[rollout.alive][pairs.row])
    assert np.array_equal(pairs.a, rollout.a[rollout.alive][pairs.row])
    assert np.array_equal(pairs.z, rollout.z[rollout.alive][pairs.row])
    assert np.array_equal(pairs.episode, rollout.alive.nonzero()[1][pairs.row])
    assert np.array_equal(pairs.z_phi, TASK.hw_phy(state.phi)(pairs.s, pairs.a))


def test_what_hw_phy_can_not_simulate_is_left_out_of_the_pairs_but_counted() -> None:
    state, rollout, every = explored()
    arm = TASK.hw_phy(state.phi)
    bad = np.arange(rollout.steps) % 7 == 3

    def brittle(s: np.ndarray, a: np.ndarray) -> np.ndarray:
        z = arm(s, a)
        z[bad, 0] = np.nan
        return z

    pairs = relabel_on_hardware(rollout, brittle, 0, state.rng)
    assert pairs.steps == rollout.steps
    assert np.array_equal(pairs.row, np.flatnonzero(~bad))
    for array, whole in ((pairs.s, every.s), (pairs.a, every.a), (pairs.z, every.z), (pairs.z_phi, every.z_phi)):
        assert np.array_equal(array, whole[~bad])
    assert np.array_equal(pairs.episode, every.episode[~bad])


def test_a_step_to_what_cannot_be_built_is_halved_back() -> None:
    task = make_task("pen_press")
    phi = task.design_space.initial
    onto_its_neighbour = phi + np.r_[np.pi / 2, np.zeros(len(phi) - 1)]
    reached = nearest_buildable(task, phi, onto_its_neighbour)
    assert task.buildable(reached)
    assert reached[0] == pytest.approx(np.pi / 4)
    assert nearest_buildable(task, phi, phi + 0.01).tolist() == (phi + 0.01).tolist()
