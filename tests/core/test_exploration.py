"""The exploration of z: designs around phi, and the pulls on the proxy."""

import dataclasses
import itertools
import random

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.catalogue import make_task
from morph_core.config import Config
from morph_core.exploration import (
    Relabelled,
    annealed,
    clipped_pull,
    design_sigma,
    episode_advantage,
    explore_designs,
    linearised_pull,
    nearest_buildable,
    relabel_on_hardware,
    run_trajectories,
)
from morph_core.rollout import Rollout
from morph_core.state import State, start
from tests.core.conftest import SMALL

TASK = make_task("reacher")


def explored(config: Config) -> tuple[State, Rollout, Relabelled]:
    state = start(TASK, config, 0)
    designs = explore_designs(state, config.trajectories, 0.5)
    rollout = run_trajectories(TASK, state, TASK.hw_phy(designs), config)
    return state, rollout, relabel_on_hardware(rollout, TASK.hw_phy(state.phi), config.proxy_pairs, state.rng)


def test_designs_come_in_antithetic_pairs_inside_the_box(small: Config) -> None:
    state = start(TASK, small, 0)
    designs = explore_designs(state, 64, 0.3)
    assert np.allclose(designs[:32] + designs[32:], 2 * state.phi)
    wide = explore_designs(state, 64, 30.0)
    assert (wide >= TASK.design_space.lo).all()
    assert (wide <= TASK.design_space.hi).all()


def test_locked_parameters_are_not_explored(small: Config) -> None:
    state = start(TASK, small, 0, TASK.design_space.with_lock("link_3", 1.25))
    assert (explore_designs(state, 64, 0.8)[:, 2] == 1.25).all()


@settings(max_examples=20)
@given(st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_the_parameters_of_a_group_have_the_said_share_of_variance_in_common(share: float, seed: int) -> None:
    task = make_task("pen_press")
    state = start(task, SMALL, seed)
    state.rng = np.random.default_rng(seed)
    half = explore_designs(state, 8000, 0.05, share)[:4000]  # so narrow that no design reaches the box
    unit = (half - state.phi) / (0.05 * task.design_space.scale)
    expected = np.eye(8)
    expected[4:, 4:] += share * (1 - np.eye(4))  # the lengths are a group, the placements are not
    assert np.allclose(unit.T @ unit / len(unit), expected, atol=0.12)


def test_the_antithetic_pairs_stay_pairs_under_correlation() -> None:
    state = start(make_task("pen_press"), SMALL, 0)
    designs = explore_designs(state, 64, 0.1, 0.7)
    assert np.allclose(designs[:32] + designs[32:], 2 * state.phi)
    assert np.array_equal(state.explored, designs)  # pyright: ignore[reportArgumentType] - it is set


def test_sigma_anneals_geometrically_and_then_stays() -> None:
    config = Config(schedule_iterations=11)
    assert design_sigma(1, config) == pytest.approx(config.design_sigma)
    assert design_sigma(6, config) == pytest.approx(np.sqrt(config.design_sigma * config.design_sigma_end))
    assert design_sigma(11, config) == design_sigma(500, config) == pytest.approx(config.design_sigma_end)
    assert annealed(2.0, 2.0, 5, config) == 2.0


@given(st.integers(2, 60), st.floats(0, 0.9), st.floats(0.1, 3), st.floats(0.01, 1))
def test_a_held_sigma_waits_falls_and_arrives(iterations: int, hold: float, first: float, last: float) -> None:
    config = Config(
        schedule_iterations=iterations, schedule_hold=hold, design_sigma=first, design_sigma_end=first * last
    )
    sigmas = [design_sigma(i, config) for i in range(1, iterations + 5)]
    held = [sigma for i, sigma in enumerate(sigmas) if i <= hold * (iterations - 1)]
    assert held == pytest.approx([first] * len(held))
    assert all(later <= sooner * (1 + 1e-12) for sooner, later in itertools.pairwise(sigmas))
    assert sigmas[iterations - 1 :] == pytest.approx([first * last] * 5)


def test_the_policys_noise_is_not_held(small: Config) -> None:
    config = dataclasses.replace(small, schedule_iterations=11, schedule_hold=0.5)
    assert design_sigma(6, config) == config.design_sigma
    assert annealed(1.0, 0.25, 6, config) == pytest.approx(0.5)


def test_episode_advantages_are_standardised_and_limited() -> None:
    config = Config(advantage_limit=3.0)
    advantage = episode_advantage(np.array([0.0] * 99 + [1000.0]), config)
    assert advantage.max() == 3.0
    assert abs(advantage[:99].mean()) < 0.2
    assert (episode_advantage(np.ones(8), config) == 0).all()


@given(st.lists(st.floats(-1e6, 1e6), min_size=4, max_size=60, unique=True), st.randoms(use_true_random=False))
def test_ranks_alone_decide_the_log_rank_utility(returns: list[float], shuffle: random.Random) -> None:
    config = Config(utility="log_rank", advantage_limit=100.0)
    values = np.sort(returns)[::-1]
    advantage = episode_advantage(values, config)
    assert abs(advantage.mean()) < 1e-9
    assert advantage.std(ddof=1) == pytest.approx(1.0)
    assert (np.diff(advantage) <= 1e-12).all()
    worse_half = advantage[(len(values) + 1) // 2 :]
    assert np.allclose(worse_half, worse_half[0])  # CMA-ES gives them no weight
    order = list(range(len(values)))
    shuffle.shuffle(order)
    assert np.allclose(episode_advantage(values[order], config), advantage[order])
    assert np.allclose(episode_advantage(np.arange(len(values))[::-1] ** 3.0, config), advantage)


def test_the_linearised_pull_moves_z_towards_what_good_episodes_did(small: Config) -> None:
    _, rollout, pairs = explored(small)
    gradient = linearised_pull(rollout, pairs, small)(torch.zeros(pairs.z.shape), torch.arange(len(pairs))).numpy()
    rows = pairs.episode == rollout.returns.argmax()
    drift = pairs.z - pairs.z_phi
    assert rows.sum() > 0
    assert ((-gradient[rows] * drift[rows]).sum(-1) > 0).all()


def test_the_optimum_of_pull_and_divergence_is_where_the_docstring_says(small: Config) -> None:
    _, rollout, pairs = explored(small)
    advantage = episode_advantage(rollout.returns, small)[pairs.episode]
    alpha = 1.7
    eta = small.kappa / (2 * alpha * small.z_sigma**2)
    m = torch.from_numpy(pairs.z_phi + eta * advantage[:, None] * (pairs.z - pairs.z_phi)).float()
    g_hw = 2 * (m - torch.from_numpy(pairs.z_phi).float()) / len(pairs)
    g_task = linearised_pull(rollout, pairs, small)(m, torch.arange(len(pairs)))
    assert torch.allclose(g_task + alpha * g_hw, torch.zeros_like(m), atol=1e-6)


@pytest.mark.parametrize("sampled", [0, 100])
def test_the_clipped_pull_vanishes_beyond_the_clip(small: Config, sampled: int) -> None:
    _, rollout, pairs = explored(dataclasses.replace(small, proxy_pairs=sampled))
    m = torch.from_numpy(pairs.z.astype(np.float32))
    advantage, index = torch.ones(rollout.steps), torch.arange(len(pairs))
    assert clipped_pull(pairs, m - 0.05, advantage, small)(m - 0.05, index).abs().sum() > 0
    far_better = clipped_pull(pairs, m - 0.5, advantage, small)  # the ratio at m is far above 1 + clip
    assert far_better(m, index).abs().sum() == 0


@pytest.mark.parametrize("asked", [0, 100, 10**6])
def test_relabelled_pairs_are_those_of_the_rollout(small: Config, asked: int) -> None:
    state, rollout, _ = explored(small)
    pairs = relabel_on_hardware(rollout, TASK.hw_phy(state.phi), asked, state.rng)
    alive = rollout.steps
    assert len(pairs) == pairs.steps == (100 if asked == 100 else alive)
    assert len(set(pairs.row.tolist())) == len(pairs)
    assert np.array_equal(pairs.s, rollout.s[rollout.alive][pairs.row])
    assert np.array_equal(pairs.z, rollout.z[rollout.alive][pairs.row])
    assert np.array_equal(pairs.episode, rollout.alive.nonzero()[1][pairs.row])
    assert np.array_equal(pairs.z_phi, TASK.hw_phy(state.phi)(pairs.s, pairs.a))


def test_what_hw_phy_can_not_simulate_is_left_out_of_the_pairs_but_counted(small: Config) -> None:
    state, rollout, every = explored(small)
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
