"""The exploration of z: designs around phi, and the pulls on the proxy."""

import numpy as np
import pytest
import torch

from morph_core.config import Config
from morph_core.exploration import (
    annealed,
    clipped_pull,
    design_sigma,
    episode_advantage,
    explore_designs,
    linearised_pull,
)
from morph_core.rollout import Rollout, collect
from morph_core.state import State, start
from morph_core.tasks import make_task

TASK = make_task("reacher")


def explored(config: Config) -> tuple[State, np.ndarray, Rollout]:
    state = start(TASK, config, 0)
    designs = explore_designs(state, config.trajectories, 0.5)
    hw_phy = TASK.hw_phy(designs)
    s = TASK.reset(hw_phy, config.trajectories, state.rng)
    return state, designs, collect(TASK, lambda o: state.learner.policy.act(o, state.rng), hw_phy, s)


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


def test_sigma_anneals_geometrically_and_then_stays() -> None:
    config = Config(schedule_iterations=11)
    assert design_sigma(1, config) == pytest.approx(config.design_sigma)
    assert design_sigma(6, config) == pytest.approx(np.sqrt(config.design_sigma * config.design_sigma_end))
    assert design_sigma(11, config) == design_sigma(500, config) == pytest.approx(config.design_sigma_end)
    assert annealed(2.0, 2.0, 5, config) == 2.0


def test_episode_advantages_are_standardised_and_limited() -> None:
    advantage = episode_advantage(np.array([0.0] * 99 + [1000.0]), 3.0)
    assert advantage.max() == 3.0
    assert abs(advantage[:99].mean()) < 0.2
    assert (episode_advantage(np.ones(8), 3.0) == 0).all()


def test_the_linearised_pull_moves_z_towards_what_good_episodes_did(small: Config) -> None:
    state, _, rollout = explored(small)
    s, a = rollout.s[rollout.alive], rollout.a[rollout.alive]
    z_phi = TASK.hw_phy(state.phi)(s, a)
    pull = linearised_pull(rollout, z_phi, small)
    gradient = pull(torch.zeros(len(s), TASK.z_size), torch.arange(len(s))).numpy()
    best = np.zeros_like(rollout.alive)
    best[:, rollout.returns.argmax()] = True
    rows = best[rollout.alive]
    drift = rollout.z[rollout.alive] - z_phi
    assert ((-gradient[rows] * drift[rows]).sum(-1) > 0).all()


def test_the_optimum_of_pull_and_divergence_is_where_the_docstring_says(small: Config) -> None:
    state, _, rollout = explored(small)
    s, a = rollout.s[rollout.alive], rollout.a[rollout.alive]
    z_phi = TASK.hw_phy(state.phi)(s, a)
    index = torch.arange(len(s))
    advantage = np.broadcast_to(episode_advantage(rollout.returns, 3.0), rollout.alive.shape)[rollout.alive]
    alpha = 1.7
    eta = small.kappa / (2 * alpha * small.z_sigma**2)
    m = torch.from_numpy(z_phi + eta * advantage[:, None] * (rollout.z[rollout.alive] - z_phi)).float()
    g_hw = 2 * (m - torch.from_numpy(z_phi).float()) / len(s)
    g_task = linearised_pull(rollout, z_phi, small)(m, index)
    assert torch.allclose(g_task + alpha * g_hw, torch.zeros_like(m), atol=1e-6)


def test_the_clipped_pull_vanishes_beyond_the_clip(small: Config) -> None:
    _, _, rollout = explored(small)
    count = rollout.steps
    m = torch.from_numpy(rollout.z[rollout.alive].astype(np.float32))
    advantage, index = torch.ones(count), torch.arange(count)
    assert clipped_pull(rollout, m - 0.05, advantage, small)(m - 0.05, index).abs().sum() > 0
    far_better = clipped_pull(rollout, m - 0.5, advantage, small)  # the ratio at m is far above 1 + clip
    assert far_better(m, index).abs().sum() == 0
