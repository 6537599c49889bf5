"""The two explorations by hand: the worlds of line 2, the task's pull on the proxy, and the pairs it pulls on."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from torch import nn

from morph_core.exploration import Notes, Pull, Relabelled, relabel_on_hardware, run_trajectories
from morph_core.explorations.design import Design
from morph_core.explorations.gaussian import EpisodicProxy, Gaussian, HeldNoise, directions, noise_std
from morph_core.explorations.gaussian_iid import GaussianIid, NoisyProxy
from morph_core.parts import Schedule
from morph_core.rollout import Rollout
from morph_core.spread import Spread
from morph_core.state import State
from morph_core.task import HardwareOfEpisodes, Task
from tests.core.scales import TINY, Multiplied, Scales, linear, pairs_of, proxy, replaced, started, trajectories

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
        pull = GaussianIid(noise=1.0, clip_coef=0.6).pull(state, trajectories([[1.0]], [[1]]), pairs, weights)
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
    pull = GaussianIid(noise=0.5).pull(state, trajectories([[1.0]], [[1]]), pairs, advantage)
    m = np.ones((2, 2), dtype=np.float32)  # r = 1
    expected = np.array([[-2 * 0.1, 0], [0, 3 * -0.2]]) / 0.5**2
    assert np.allclose(pull(m, np.arange(2)), expected / 2, atol=1e-5)
    assert np.allclose(pull(m[:1], np.array([1])), expected[1:], atol=1e-5)


def test_a_z_that_the_proxy_has_left_far_behind_neither_overflows_nor_pulls() -> None:
    state = started()
    state.proxy = proxy([[100.0, 0.0], [0.0, 0.0]])
    pairs = pairs_of([[1, 1]], [[0.0, 0.0]], [[0.0, 0.0]])
    plain = GaussianIid(noise=1.0)
    pull = plain.pull(state, trajectories([[1.0]], [[1]]), pairs, np.array([-1.0], dtype=np.float32))
    assert pull(np.array([[0.5, 0.0]], dtype=np.float32), np.array([0])).tolist() == [[0.0, 0.0]]


def test_the_world_of_noise_is_the_proxys_with_noise_on_z() -> None:
    state = started(seed=5)
    world = GaussianIid(noise=0.3).world(Scales(), state, Spread(0.5, 0.0), 4)
    assert isinstance(world, NoisyProxy)
    s, a = np.ones((3, 3)), np.zeros((3, 2))
    noise = np.random.default_rng(5).standard_normal((3, 2))
    assert np.allclose(world(s, a), state.hw_nn(s, a) + 0.3 * noise)


def test_a_task_that_needs_hw_phy_is_not_explored_by_noise() -> None:
    class Contact(Scales):
        runs_on_proxy = False

    Gaussian().check(Scales())
    with pytest.raises(ValueError, match=r'"gaussian(_iid)?": it can\'t be simulated .*choose from: "design"'):
        Gaussian().check(Contact())
    Design().check(Contact())


def test_a_search_that_averages_over_designs_finds_some_under_noise() -> None:
    assert Gaussian().spread(Schedule(11), 1, frozen=False) == Design().spread(Schedule(11), 1)


# --- gaussian: noise that designs could make ---


def layered() -> State:
    """Return a state whose proxy is z = (s_1, 2 s_2), with a last layer of weights [[1, 0, 0], [0, 2, 0]]."""
    state = started()
    state.notes = HeldNoise()
    state.proxy = proxy([[1.0, 0.0], [0.0, 2.0]])
    state.proxy.proxy.net = nn.Sequential(linear([[1.0, 0.0], [0.0, 2.0]], [0.0, 0.0]))
    return state


held = HeldNoise.of
HALF = np.array([[[0.5, 0.0, 0.0], [0.0, 0.0, 0.25]]], dtype=np.float32)
NOISE = np.concatenate([HALF, -HALF])
"""Two episodes: the first adds (s_1 / 2, 1 / 4) to z, the second takes them away."""


def test_each_episode_has_a_last_layer_of_its_own_however_often_it_is_asked() -> None:
    world = EpisodicProxy(layered().hw_nn, NOISE)
    s, a = np.array([[2.0, 1.0, 0.0]] * 2), np.zeros((2, 2))
    expected = [[3.0, 2.25], [1.0, 1.75]]
    assert world(s, a).tolist() == world(s, a).tolist() == expected
    assert world(np.tile(s, (3, 1)), np.tile(a, (3, 1))).tolist() == expected * 3
    assert world.of(np.array([1]))(s, a).tolist() == [expected[1]] * 2
    assert isinstance(world, HardwareOfEpisodes)


def test_the_scale_of_z_is_in_the_last_features() -> None:
    class Tenfold(Scales):
        z_scale = 10.0

    state = layered()
    state.proxy.proxy._task = state.proxy._task = Tenfold()  # pyright: ignore[reportOptionalMemberAccess]
    s, a = np.array([[2.0, 1.0, 0.0]] * 2), np.zeros((2, 2))
    assert state.hw_nn(s, a).tolist() == [[20.0, 20.0]] * 2
    assert EpisodicProxy(state.hw_nn, 0 * NOISE)(s, a).tolist() == [[20.0, 20.0]] * 2


def test_the_noises_standard_deviation_is_that_over_the_episodes_and_never_zero() -> None:
    s = np.array([[2.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    assert np.allclose(noise_std(layered().hw_nn, NOISE, s, np.zeros((2, 2))), [[1.0, 0.25], [0.01, 0.25]])


def test_the_noise_lies_along_what_designs_would_change() -> None:
    state, task = layered(), Scales()
    s, a = task.sample_pairs(64, np.random.default_rng(0))
    found = directions(task, state, Spread(0.5, 0.0), s, a)  # z_i = phi_i s_i, and the last layer sees s
    expected = np.zeros((2, 2, 3))
    expected[0, 0, 0] = expected[1, 1, 1] = 1.0
    assert np.allclose(found, expected, atol=1e-3)
    assert state.relabelled_steps == 4 * 64


def test_at_a_bound_the_difference_is_taken_inwards_and_of_a_lock_there_is_none() -> None:
    state, task = layered(), Scales()
    state.design_space = state.design_space.with_lock("second", 2.0)
    state.phi = np.array([20.0, 2.0])  # the first stands at its upper bound
    s, a = task.sample_pairs(64, np.random.default_rng(0))
    found = directions(task, state, Spread(0.5, 0.0), s, a)
    assert found[0, 0, 0] == pytest.approx(1.0, abs=1e-3)
    assert (found[1] == 0).all()


def test_pairs_that_hw_phy_can_not_simulate_say_nothing_of_directions() -> None:
    class Breaking(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            arm = super().hw_phy(phi)
            return lambda s, a: np.where(s[:, :1] > 1, np.nan, arm(s, a))

    s, a = Scales().sample_pairs(64, np.random.default_rng(0))
    assert (s[:, 0] > 1).any()
    found = directions(Breaking(), layered(), Spread(0.5, 0.0), s, a)
    assert found[0, 0, 0] == pytest.approx(1.0, abs=1e-3)


def test_episodes_come_in_antithetic_pairs_whose_spread_is_that_of_the_designs() -> None:
    state = layered()
    held(state).directions = np.zeros((2, 2, 3))
    held(state).directions[0, 0, 0] = held(state).directions[1, 1, 1] = 1.0
    world = Gaussian().world(Scales(), state, Spread(0.5, 0.0), 4000)
    assert isinstance(world, EpisodicProxy)
    assert held(state).noise is world.noise
    assert np.array_equal(world.noise[:2000], -world.noise[2000:])
    # the scale of the second parameter is 2
    assert world.noise.std(0) == pytest.approx(np.array([[0.5, 0, 0], [0, 1.0, 0]]), rel=0.05)


def test_before_the_first_rollout_directions_come_from_the_whole_workspace() -> None:
    state = layered()
    Gaussian().world(Scales(), state, Spread(0.5, 0.0), 4)
    assert held(state).directions is not None
    assert np.allclose(held(state).directions[0], [[1, 0, 0], [0, 0, 0]], atol=1e-3)


def test_directions_are_fitted_anew_on_the_steps_alive_of_each_rollout() -> None:
    state = layered()
    s = np.zeros((1, 3, 3))
    s[0, :, :2] = [[1, 0], [0, 1], [9, 9]]
    rollout = trajectories([[0.0] * 3], [[1, 1, 0]], s=s)
    Gaussian().prepare(Scales(), state, Spread(0.5, 0.0), rollout)
    assert held(state).directions is not None
    assert state.relabelled_steps == 4 * 2048
    told = held(state).directions.copy()
    state.frozen = True
    Gaussian().prepare(Scales(), state, Spread(0.5, 0.0), trajectories([[1.0]], [[1]]))
    assert np.array_equal(held(state).directions, told)
    # on (1, 0) and (0, 1) alone the bias may stand in for half of each; the values there are what is fitted
    z = state.hw_nn.last_features(np.array([[1.0, 0, 0], [0, 1.0, 0]]), np.zeros((2, 2))) @ told[0, 0]
    assert np.allclose(z, [1, 0], atol=1e-2)


def test_a_world_tested_at_the_end_of_moves_is_the_same_but_for_its_outline() -> None:
    worlds = []
    for contact in ("swept", "end"):
        state = layered()
        worlds.append(Gaussian(contact=contact).world(Scales(), state, Spread(0.5, 0.0), 4))
    s, a = np.ones((4, 3)), np.zeros((4, 2))
    assert np.array_equal(worlds[0](s, a), worlds[1](s, a))
    assert [isinstance(world, HardwareOfEpisodes) for world in worlds] == [True, False]


@pytest.mark.parametrize(("credit", "expected"), [("episode", ROOT_HALF), ("step", 5.0)])
def test_the_pull_is_in_units_of_the_noise_at_each_pair(credit: Any, expected: float) -> None:
    state = layered()
    held(state).noise = NOISE
    pairs = pairs_of([[2, 1]], [[3.0, 2.0]], [[2.0, 2.0]])  # m = (2, 2), sigma = (1, .25)
    gaussian = Gaussian(credit=credit, clip_coef=9.0)
    pull = gaussian.pull(state, trajectories([[1.0, 0.0]], [[1, 1]]), pairs, np.array([5.0, 0.0], dtype=np.float32))
    gradient = pull(np.array([[2.0, 2.0]], dtype=np.float32), np.array([0]))  # r = 1
    assert np.allclose(gradient, [[-expected * (3 - 2) / 1**2, 0.0]], atol=1e-5)
    moved = pull(np.array([[2.0, 2.125]], dtype=np.float32), np.array([0]))  # r = exp(-(.5)^2 / 2)
    assert np.allclose(moved, np.exp(-0.125) * -expected * np.array([[1, -0.125 / 0.25**2]]), atol=1e-4)


@pytest.mark.parametrize(("largest", "flows"), [(1.1, False), (1.3, True)])
def test_where_the_advantage_is_negative_the_ratio_is_clipped_from_above(largest: float, flows: bool) -> None:
    state = layered()
    held(state).noise = NOISE
    pairs = pairs_of([[2, 1]], [[3.0, 2.0]], [[2.0, 2.0]])
    state.hw_nn.proxy.net[0].weight.data[0, 0] = 0.71  # pyright: ignore - m was (1.42, 2), so that log r = 1.248
    gaussian = Gaussian(credit="step", largest_log_ratio=largest)
    pull = gaussian.pull(state, trajectories([[1.0]], [[1]]), pairs, np.array([-1.0], dtype=np.float32))
    gradient = pull(np.array([[3.0, 2.0]], dtype=np.float32) - [[0.001, 0]], np.array([0]))
    assert bool(np.abs(gradient).sum() > 0) == flows


@pytest.mark.parametrize(
    ("m", "advantage", "flows"),
    [(2.9, 1.0, False), (2.5, 1.0, True), (2.9, -1.0, True), (1.0, -1.0, False), (1.0, 1.0, True)],
)
def test_the_ratio_under_the_held_noise_is_clipped_as_ppo_does(m: float, advantage: float, flows: bool) -> None:
    state = layered()
    held(state).noise = NOISE
    pairs = pairs_of([[2, 1]], [[3.0, 2.0]], [[2.0, 2.0]])  # m was (2, 2), and the noise's std there is (1, 1/4)
    pull = Gaussian(credit="step", clip_coef=0.6).pull(
        state, trajectories([[1.0]], [[1]]), pairs, np.array([advantage], dtype=np.float32)
    )
    ratio = np.exp((1 - (3 - m) ** 2) / 2)
    gradient = pull(np.array([[m, 2.0]], dtype=np.float32), np.array([0]))
    assert np.allclose(gradient, [[-ratio * advantage * (3 - m) if flows else 0.0, 0.0]], rtol=1e-3, atol=1e-4)


def test_under_the_held_noise_each_pair_has_its_own_ratio() -> None:
    state = layered()
    held(state).noise = NOISE
    pairs = pairs_of([[2, 1]] * 2, [[3.0, 2.0], [2.5, 2.0]], [[2.0, 2.0]] * 2)
    pairs = dataclasses.replace(pairs, row=np.array([0, 1]))
    advantage = np.array([1.0, 3.0], dtype=np.float32)
    pull = Gaussian(credit="step").pull(state, trajectories([[1.0]], [[1]]), pairs, advantage)
    gradient = pull(np.array([[2.0, 2.0]], dtype=np.float32), np.array([1]))  # r = 1
    assert np.allclose(gradient, [[-3 * 0.5, 0.0]], atol=1e-4)


@pytest.mark.parametrize(
    ("settings", "frozen", "weight"),
    [({}, False, [[0.5, 8.0]]), ({"divergence": "plain"}, False, None), ({}, True, None)],
)
def test_d_is_measured_in_units_of_the_noise(settings: dict[str, Any], frozen: bool, weight: Any) -> None:
    state = layered()
    held(state).noise = None if frozen else NOISE
    pairs = pairs_of([[2, 1]], [[3.0, 2.0]], [[2.0, 2.0]])
    metric = Gaussian(spread_pairs=6, **settings).metric(Scales(), state, pairs, Multiplied(np.array([3.0, 5.0])))
    assert metric.weight == (None if weight is None else pytest.approx(np.array(weight)))
    assert metric.further is not None
    assert np.array_equal(metric.further.z_phi, metric.further.s[:, :2] * [3, 5])
    assert len(metric.further) == state.relabelled_steps == 6
    if weight is None:
        assert metric.further_weight is None
    else:
        std = np.maximum(0.01, np.stack([np.abs(metric.further.s[:, 0]) / 2, np.full(6, 0.25)], 1))
        assert metric.further_weight == pytest.approx(0.5 / std**2, rel=1e-3)


def test_without_spread_pairs_d_is_that_of_the_rollout() -> None:
    state = layered()
    metric = Gaussian(spread_pairs=0).metric(Scales(), state, pairs_of([[2, 1]], [[3, 2]], [[2, 2]]), Multiplied(TWO))
    assert (metric.weight, metric.further, state.relabelled_steps) == (None, None, 0)
    broken = Gaussian(spread_pairs=5).metric(
        Scales(), state, pairs_of([[2, 1]], [[3, 2]], [[2, 2]]), lambda s, _: s[:, :2] * np.nan
    )
    assert broken.further is None


TWO = np.array([2.0, 2.0])


@pytest.mark.parametrize(
    ("level", "frozen", "told", "tried"),
    [
        (0.5, False, 0.75, True),  # on Hw-Phy three of four end
        (0.6, False, 0.5, False),  # the world has not reached the level
        (0.0, False, 0.5, False),  # phi never freezes
        (0.5, True, 0.5, False),
    ],
)
def test_phi_freezes_on_the_success_on_hw_phy(level: float, frozen: bool, told: float, tried: bool) -> None:
    state, task = layered(), Scales(ends=2, succeeding=0.75)
    state.frozen = frozen
    successes = np.array([True, True, False, False])
    rollout = trajectories(np.zeros((1, 4)), np.ones((1, 4)), successes=successes)
    rollout = dataclasses.replace(rollout, kept=np.ones(4, dtype=bool))
    assert Gaussian().success(task, state, rollout, level) == told
    assert state.env_steps == (3 * 2 + 1 * 3 if tried else 0)


def test_the_gaussian_exploration_needs_its_notes() -> None:
    state = layered()
    state.notes = Notes()
    with pytest.raises(ValueError, match="the exploration gaussian needs the notes that it made"):
        Gaussian().world(Scales(), state, Spread(0.5, 0.0), 4)


@pytest.mark.parametrize("finish", ["hw_phy", "proxy"])
def test_once_phi_is_frozen_nothing_is_explored_and_nothing_pulls(finish: Any) -> None:
    state = layered()
    state.frozen, state.phi, held(state).noise = True, np.array([3.0, 5.0]), NOISE
    gaussian = Gaussian(finish=finish)
    world = gaussian.world(Scales(), state, Spread(0.0, 0.0), 2)
    z = world(np.array([[2.0, 1.0, 0.0]] * 2), np.zeros((2, 2)))
    assert z.tolist() == [[6.0, 5.0] if finish == "hw_phy" else [2.0, 2.0]] * 2
    assert held(state).noise is None
    pairs = pairs_of([[2, 1]], [[3.0, 2.0]], [[2.0, 2.0]])
    pull = gaussian.pull(state, trajectories([[1.0]], [[1]]), pairs, np.array([1.0], dtype=np.float32))
    assert pull(np.ones((1, 2), dtype=np.float32), np.array([0])).tolist() == [[0.0, 0.0]]


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
