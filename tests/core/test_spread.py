"""Designs around phi: their noise, their pairs, their schedule, and what the returns of their episodes count."""

import numpy as np
import pytest

from morph_core.parts import Schedule
from morph_core.spread import HALVINGS, ExploredDesigns, Spread, nearest_buildable
from tests.core.scales import Scales, started


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.9, 1.0])
@pytest.mark.parametrize("grouped", [False, True])
def test_noise_has_variance_1_and_a_group_has_the_said_share_in_common(correlation: float, grouped: bool) -> None:
    space, spread = Scales(grouped=grouped).design_space, Spread(1.0, correlation)
    noise = spread.noise(space, 40000, np.random.default_rng(0))
    assert np.allclose(noise.mean(0), 0, atol=0.02)
    expected = np.eye(2) + correlation * grouped * (1 - np.eye(2))
    assert np.allclose(spread.correlations(space), expected)
    assert np.allclose(np.cov(noise.T), expected, atol=0.02)


def test_designs_are_pairs_around_phi_in_units_of_each_scale() -> None:
    state = started()
    designs = Spread(0.5, 0.0).designs(state, 2000)
    assert np.allclose(designs[:1000] + designs[1000:], 2 * state.phi)
    assert np.allclose((designs - state.phi).std(0), [0.5, 1.0], rtol=0.05)
    assert state.explored is designs


def test_designs_keep_to_box_and_locks() -> None:
    state = started()
    state.design_space = state.design_space.with_bound("first", 1.5, 2.5).with_lock("second", 7.0)
    designs = Spread(3.0, 0.0).designs(state, 64)
    assert {1.5, 2.5} <= set(designs[:, 0])
    assert ((designs[:, 0] >= 1.5) & (designs[:, 0] <= 2.5)).all()
    assert (designs[:, 1] == 7.0).all()


@pytest.mark.parametrize(
    ("iteration", "hold", "sigma"),
    [
        (1, 0.0, 1.6), (6, 0.0, 0.8), (11, 0.0, 0.4), (99, 0.0, 0.4),
        (1, 0.5, 1.6), (6, 0.5, 1.6), (11, 0.5, 0.4), (99, 0.5, 0.4),
        (7, 0.2, 0.8),
    ],
)  # fmt: skip
def test_sigma_falls_geometrically_after_it_was_held(iteration: int, hold: float, sigma: float) -> None:
    explored = ExploredDesigns(sigma=1.6, sigma_end=0.4, hold=hold, correlation=0.25)
    assert explored.spread(Schedule(11), iteration) == Spread(pytest.approx(sigma), 0.25)


def test_while_phi_is_frozen_every_design_is_phi() -> None:
    spread = ExploredDesigns(correlation=0.25).spread(Schedule(11), 3, frozen=True)
    assert spread == Spread(0.0, 0.25)
    state = started()
    assert (spread.designs(state, 8) == state.phi).all()


@pytest.mark.parametrize(
    ("iteration", "share"), [(1, 0.0), (2, 0.1), (6, 0.5), (11, 1.0), (12, 1.0), (1000, 1.0)]
)  # fmt: skip
def test_the_share_of_a_schedule_runs_from_its_first_iteration_to_its_last(iteration: int, share: float) -> None:
    assert Schedule(11).share(iteration) == pytest.approx(share)
    assert Schedule(11).linear(0.3, iteration) == pytest.approx(1 - 0.7 * share)
    assert Schedule(11).geometric(2.0, 0.02, iteration) == pytest.approx(2 * 0.01**share)


def test_a_schedule_of_one_iteration_is_over_in_the_second() -> None:
    assert [Schedule(1).share(i) for i in (1, 2)] == [0.0, 1.0]


def test_returns_are_standardised_with_the_samples_deviation() -> None:
    assert ExploredDesigns().advantage(np.array([1.0, 3.0])).tolist() == pytest.approx([-(0.5**0.5), 0.5**0.5])
    assert ExploredDesigns().advantage(np.array([1.0, 2.0, 3.0])).tolist() == pytest.approx([-1, 0, 1])
    assert ExploredDesigns().advantage(np.array([2.0, 2.0])).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("limit", [0.5, 3.0, 100.0])
def test_what_an_episode_counts_is_limited_on_both_sides(limit: float) -> None:
    counts = ExploredDesigns(advantage_limit=limit).advantage(np.array([1000.0] + [0.0] * 99))
    standardised = 99 / 10  # (x - mean) / std of one among a hundred
    assert counts.max() == pytest.approx(min(limit, standardised))
    assert ExploredDesigns(advantage_limit=limit).advantage(np.array([-1000.0] + [0.0] * 99)).min() == pytest.approx(
        -min(limit, standardised)
    )


def test_by_log_rank_the_better_half_is_weighted_as_in_cma_es() -> None:
    counts = ExploredDesigns(utility="log_rank").advantage(np.array([5.0, -1.0, 70.0, 6.0]))
    weights = np.array([0.0, 0.0, np.log(3), np.log(3) - np.log(2)])  # max(0, log(N / 2 + 1) - log(rank))
    assert counts.tolist() == pytest.approx(((weights - weights.mean()) / weights.std(ddof=1)).tolist())


@pytest.mark.parametrize(("target", "found"), [(9.0, 9.0), (12.0, 7.0), (34.0, 10.0), (1e6, 2.0)])
def test_a_step_to_what_can_not_be_built_is_halved_until_it_can(target: float, found: float) -> None:
    phi = np.array([2.0, 2.0])  # up to 10 a scale can be built
    assert nearest_buildable(Scales(), phi, np.array([target, 2.0])).tolist() == [found, 2.0]


def test_the_last_halving_is_tried_and_no_further_one() -> None:
    phi = np.array([0.0, 0.0])
    assert nearest_buildable(Scales(), phi, np.array([10.0 * 2 ** (HALVINGS - 1), 0.0])).tolist() == [10.0, 0.0]
    assert nearest_buildable(Scales(), phi, np.array([10.0 * 2**HALVINGS, 0.0])).tolist() == [0.0, 0.0]
