"""The two explorations by hand: the worlds of line 2, the task's pull on the proxy, and the pairs it pulls on."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from morph_core.exploration import Pull, Relabelled, relabel_on_hardware, run_trajectories
from morph_core.explorations.design import Design
from morph_core.explorations.gaussian import Gaussian, NoisyProxy
from morph_core.parts import Schedule
from morph_core.rollout import Rollout
from morph_core.spread import Spread
from morph_core.task import Task
from tests.core.scales import TINY, Multiplied, Scales, pairs_of, proxy, replaced, started, trajectories

ROOT_HALF = 1 / np.sqrt(2)
"""The standardised return of the better one of two episodes."""


# --- design ---


def design_pull(design: Design, pairs: Relabelled, rollout: Rollout) -> Pull:
    return design.pull(started(), rollout, pairs, np.zeros(9, dtype=np.float32))


@pytest.mark.parametrize(("kappa", "z_sigma"), [(1.0, 1.0), (0.3, 1.0), (1.0, 0.5), (0.3, 0.5)])
def test_the_pull_of_designs_is_their_z_weighted_by_their_return(kappa: float, z_sigma: float) -> None:
    rollout = trajectories([[5.0, 1.0], [2.0, 1.0]], np.ones((2, 2)))  # returns 7 and 2
    pairs = pairs_of([[1, 1]] * 4, [[3, 0], [0, 1], [1, 1], [0, 0]], [[1, 0], [0, 0], [1, 0], [0, 2]], [0, 1, 0, 1])
    pull = design_pull(Design(kappa=kappa, z_sigma=z_sigma), pairs, rollout)
    slope = -kappa / z_sigma**2 * ROOT_HALF * np.array([[2, 0], [0, -1], [0, 1], [0, 2]])
    every = pull(np.zeros((4, 2), dtype=np.float32), np.arange(4))
    assert np.allclose(every, slope / 4)
    assert every.dtype == np.float32
    # the mean is over the minibatch, and m does not matter: the pull is linear
    assert np.allclose(pull(np.full((2, 2), 7, dtype=np.float32), np.array([3, 0])), slope[[3, 0]] / 2)


@pytest.mark.parametrize(("clip", "expected"), [(0.0, [3.0, -0.2]), (0.5, [0.5, -0.2]), (0.1, [0.1, -0.1])])
def test_differences_of_z_pull_up_to_the_clip(clip: float, expected: list[float]) -> None:
    rollout = trajectories([[1.0, 0.0]], np.ones((1, 2)))
    pairs = pairs_of([[1, 1]], [[4.0, 0.0]], [[1.0, 0.2]], [0])
    pull = design_pull(Design(kappa=1.0, z_sigma=1.0, drift_clip=clip), pairs, rollout)
    assert np.allclose(pull(np.zeros((1, 2), dtype=np.float32), np.array([0])), -ROOT_HALF * np.array([expected]))


def test_the_pull_of_designs_uses_the_utility_that_is_set() -> None:
    rollout = trajectories([[9.0, 8.0, 1.0, 0.0]], np.ones((1, 4)))
    pairs = pairs_of([[1, 1]] * 4, np.ones((4, 2)), np.zeros((4, 2)))
    design = Design(kappa=1.0, z_sigma=1.0, utility="log_rank")
    pull = design_pull(design, pairs, rollout)(np.zeros((4, 2), dtype=np.float32), np.arange(4))
    assert np.allclose(pull[:, 0], -design.advantage(rollout.returns) / 4)


def test_at_the_optimum_of_pull_and_divergence_m_is_where_good_designs_would_take_it() -> None:
    kappa, z_sigma, alpha = 0.3, 0.5, 1.7
    rollout = trajectories([[1.0, 0.0]], np.ones((1, 2)))
    pairs = pairs_of([[1, 1]], [[4.0, 0.0]], [[1.0, 0.0]], [0])
    eta = kappa / (2 * alpha * z_sigma**2)
    m = pairs.z_phi + eta * ROOT_HALF * (pairs.z - pairs.z_phi)
    g_task = design_pull(Design(kappa=kappa, z_sigma=z_sigma), pairs, rollout)(m.astype(np.float32), np.array([0]))
    assert np.allclose(g_task + alpha * 2 * (m - pairs.z_phi), 0, atol=1e-6)


def test_every_episode_runs_on_its_own_design() -> None:
    state = started()
    world: Any = Design().world(Scales(), state, Spread(0.5, 0.0), 4)
    assert np.array_equal(world.phi, state.explored)  # pyright: ignore[reportArgumentType]
    assert len(np.unique(world.phi, axis=0)) == 4


def test_sigma_is_shown_of_designs_alone() -> None:
    assert Design().sigma_shown(Spread(0.7, 0.0)) == 0.7
    assert Gaussian().sigma_shown(Spread(0.7, 0.0)) is None


# --- gaussian ---


@pytest.mark.parametrize(
    ("m", "flows"),
    [
        (1.2, {-2.0: True, 2.0: True}),  # r = 1
        (1.0, {-2.0: True, 2.0: True}),  # log r = (1.2^2 - m^2) / 2 = 0.22: inside the clip
        (0.5, {-2.0: True, 2.0: False}),  # r = 1.81, more likely than the clip lets pay
        (1.9, {-2.0: False, 2.0: True}),  # r = 0.34
    ],
)
def test_the_pull_of_noise_is_that_of_ppo_on_z(m: float, flows: dict[float, bool]) -> None:
    state = started()
    state.proxy = proxy([[1.2, 0.0], [0.0, 0.0]])  # before the step m is (1.2, 0)
    pairs = pairs_of([[1, 1]], [[0.0, 0.0]], [[9.0, 9.0]])
    ratio = np.exp((1.2**2 - m**2) / 2)
    for advantage, expected in flows.items():
        weights = np.array([advantage], dtype=np.float32)
        pull = Gaussian(noise=1.0, clip_coef=0.6).pull(state, trajectories([[1.0]], [[1]]), pairs, weights)
        gradient = pull(np.array([[m, 0.0]], dtype=np.float32), np.array([0]))
        # d(-r A)/dm = -r A (z - m) / sigma^2
        assert np.allclose(gradient, [[ratio * advantage * m, 0.0] if expected else [0.0, 0.0]], rtol=1e-4)


def test_the_noise_scales_the_pull_and_each_pair_has_the_advantage_of_its_row() -> None:
    state = started()
    state.proxy = proxy([[1.0, 0.0], [0.0, 1.0]])
    pairs = dataclasses.replace(
        pairs_of([[1, 1]] * 2, [[1.1, 1.0], [1.0, 0.8]], np.zeros((2, 2))), row=np.array([1, 4])
    )
    advantage = np.array([100, 2, 100, 100, -3], dtype=np.float32)
    pull = Gaussian(noise=0.5).pull(state, trajectories([[1.0]], [[1]]), pairs, advantage)
    m = np.ones((2, 2), dtype=np.float32)  # r = 1
    expected = np.array([[-2 * 0.1, 0], [0, 3 * -0.2]]) / 0.5**2
    assert np.allclose(pull(m, np.arange(2)), expected / 2, atol=1e-5)
    assert np.allclose(pull(m[:1], np.array([1])), expected[1:], atol=1e-5)


def test_a_z_that_the_proxy_has_left_far_behind_neither_overflows_nor_pulls() -> None:
    state = started()
    state.proxy = proxy([[100.0, 0.0], [0.0, 0.0]])
    pairs = pairs_of([[1, 1]], [[0.0, 0.0]], [[0.0, 0.0]])
    pull = Gaussian(noise=1.0).pull(state, trajectories([[1.0]], [[1]]), pairs, np.array([-1.0], dtype=np.float32))
    assert pull(np.array([[0.5, 0.0]], dtype=np.float32), np.array([0])).tolist() == [[0.0, 0.0]]


def test_the_world_of_noise_is_the_proxys_with_noise_on_z() -> None:
    state = started(seed=5)
    world = Gaussian(noise=0.3).world(Scales(), state, Spread(0.5, 0.0), 4)
    assert isinstance(world, NoisyProxy)
    s, a = np.ones((3, 3)), np.zeros((3, 2))
    noise = np.random.default_rng(5).standard_normal((3, 2))
    assert np.allclose(world(s, a), state.hw_nn(s, a) + 0.3 * noise)


def test_a_task_that_needs_hw_phy_is_not_explored_by_noise() -> None:
    class Contact(Scales):
        runs_on_proxy = False

    Gaussian().check(Scales())
    with pytest.raises(ValueError, match=r'"gaussian": it can\'t be simulated .*choose from: "design"'):
        Gaussian().check(Contact())
    Design().check(Contact())


def test_a_search_that_averages_over_designs_finds_some_under_noise() -> None:
    assert Gaussian().spread(Schedule(11), 1, frozen=False) == Design().spread(Schedule(11), 1)


# --- pairs ---


def sampled(pairs: int, hw_phy: Any = None, seed: int = 0) -> tuple[Rollout, Relabelled]:
    rng = np.random.default_rng(1)
    alive = np.ones((3, 4), dtype=bool)
    alive[1:, 2] = False
    numbers = {name: rng.standard_normal((3, 4, size)) for name, size in (("s", 3), ("a", 2), ("z", 2))}
    rollout = trajectories(np.zeros((3, 4)), alive, **numbers)
    return rollout, relabel_on_hardware(
        rollout, hw_phy or Multiplied(np.array([2.0, 3.0])), pairs, np.random.default_rng(seed)
    )


@pytest.mark.parametrize(("asked", "got"), [(0, 10), (4, 4), (9, 9), (10, 10), (99, 10)])
def test_pairs_are_steps_alive_each_once_with_both_words_on_them(asked: int, got: int) -> None:
    rollout, pairs = sampled(asked)
    assert len(pairs) == pairs.steps == got
    assert sorted(set(pairs.row.tolist())) == pairs.row.tolist()
    assert np.array_equal(pairs.s, rollout.s[rollout.alive][pairs.row])
    assert np.array_equal(pairs.a, rollout.a[rollout.alive][pairs.row])
    assert np.array_equal(pairs.z, rollout.z[rollout.alive][pairs.row])
    assert np.array_equal(pairs.episode, rollout.alive.nonzero()[1][pairs.row])
    assert np.array_equal(pairs.z_phi, pairs.s[:, :2] * [2.0, 3.0])


def test_pairs_are_drawn_from_all_steps() -> None:
    assert {row for seed in range(30) for row in sampled(4, seed=seed)[1].row.tolist()} == set(range(10))


def test_pairs_that_hw_phy_can_not_simulate_are_left_out_and_yet_counted() -> None:
    def brittle(s: np.ndarray, _: np.ndarray) -> np.ndarray:
        return np.where((s[:, :1] > 0) & [[True, False]], np.nan, s[:, :2])

    rollout, pairs = sampled(0, brittle)
    sound = rollout.s[rollout.alive][:, 0] <= 0
    assert 0 < len(pairs) == sound.sum() < pairs.steps == 10
    assert np.array_equal(pairs.row, np.flatnonzero(sound))
    assert np.array_equal(pairs.z_phi, rollout.s[rollout.alive][sound][:, :2])
    assert np.array_equal(pairs.episode, rollout.alive.nonzero()[1][sound])


def test_trajectories_are_those_of_the_present_policy() -> None:
    state = started(replaced(TINY))
    state.control.policy.act = lambda observation, rng: np.full(  # pyright: ignore[reportAttributeAccessIssue]
        (len(observation), 2), 0.25 if rng is state.rng else np.nan, dtype=np.float32
    )
    task: Task = Scales()
    rollout = run_trajectories(task, state, task.hw_phy(state.phi), 6)
    assert rollout.action.shape == (3, 6, 2)
    assert (rollout.action == 0.25).all()
