"""CMA-ES on the divergence without the variance of contact, on a Hw-Phy of which it is known where it must end."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from morph_core.checkpoint import load_checkpoint, save_checkpoint
from morph_core.design import DesignSpace
from morph_core.protocol import RunRecord
from morph_core.run_folder import create_run
from morph_core.search import Dataset, Memory, Physics, Problem
from morph_core.searches.cma_debiased import CmaDebiased, Ended, split_halves
from morph_core.spread import Spread
from morph_core.state import start
from morph_core.task import Task
from tests.core.scales import Scales, proxy, replaced, weights_of

SPACE = Scales().design_space
START = np.array([2.0, 2.0])
SIGMA = 0.5
UNIT = SIGMA * SPACE.scale


class Noted(Physics):
    """Physics that notes every design it is asked about."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.asked: list[np.ndarray] = []

    def z_each(self, s: np.ndarray, a: np.ndarray, designs: np.ndarray) -> np.ndarray:
        self.asked.append(designs)
        return super().z_each(s, a, designs)


def dataset_of(phi: Any, pairs: int = 64) -> Dataset:
    """Return pairs with s = 1, so that z is phi."""
    return Dataset(np.ones((pairs, 3)), np.zeros((pairs, 2)), np.tile(np.asarray(phi, dtype=float), (pairs, 1)))


def ended(**settings: Any) -> Ended:
    return CmaDebiased(**settings).memory(proxy([[2.0, 0.0], [0.0, 2.0]]))


def problem(dataset: Dataset, space: DesignSpace = SPACE, task: Task | None = None, **others: Any) -> Problem:
    given = {"start": START, "spread": Spread(SIGMA, 0.0), "memory": ended(), "seed": 1} | others
    return Problem(Noted(task or Scales()), space, dataset, **given)


def asked_of(asked: Problem) -> list[np.ndarray]:
    return asked.physics.asked  # pyright: ignore[reportAttributeAccessIssue]


def long(**settings: Any) -> CmaDebiased:
    """Return a search that arrives."""
    return CmaDebiased(**{"generations": 40, "limit": 100.0, "smear": 0.01} | settings)


# --- the two halves ---


def test_two_halves_count_their_product_in_the_units_of_each_component() -> None:
    first, second = np.array([[[1.0, 2.0], [3.0, 0.0]]]), np.array([[[3.0, -4.0], [1.0, 5.0]]])
    assert split_halves(first, second, np.array([1.0, 0.5])).tolist() == [((3 - 4) + 3) / 2]


@given(
    mean=st.lists(st.floats(-2, 2), min_size=2, max_size=2),
    deviation=st.floats(0, 3),
    weight=st.lists(st.floats(0.1, 2), min_size=2, max_size=2),
    seed=st.integers(0, 2**31),
)
def test_of_two_noisy_differences_the_square_of_the_mean_is_left(
    mean: list[float], deviation: float, weight: list[float], seed: int
) -> None:
    pairs, rng = 20_000, np.random.default_rng(seed)
    first, second = (mean + deviation * rng.standard_normal((1, pairs, 2)) for _ in range(2))
    (cost,) = split_halves(first, second, np.array(weight))
    variance = np.sum(np.square(weight) * (deviation**4 + 2 * np.square(mean) * deviation**2)) / pairs
    assert cost == pytest.approx(np.sum(weight * np.square(mean)), abs=6 * np.sqrt(variance) + 1e-9)


def test_where_a_simulation_diverges_a_design_costs_as_much_as_the_farthest_that_did_not() -> None:
    first = np.array([[[1.0, 1.0], [2.0, 0.0]], [[np.nan, 1.0], [1.0, 0.0]]])
    assert split_halves(first, first, np.ones(2)).tolist() == [(2 + 4) / 2, (4 + 1) / 2]


# --- where the search ends ---


def test_the_search_ends_where_hw_phy_matches() -> None:
    (found,) = long().candidates(problem(dataset_of([3.0, 1.5])))
    assert np.allclose(found, [3.0, 1.5], atol=0.01)


def test_contact_that_shakes_larger_designs_more_draws_phi_nowhere() -> None:
    class Rough(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return lambda s, _: phi * (s[:, :2] + contact.standard_normal((len(s), 2)))

    contact = np.random.default_rng(0)
    found = long().candidates(problem(dataset_of([3.0, 3.0], 1024), task=Rough()))[0]
    assert np.allclose(found, [3.0, 3.0], atol=0.2)  # the divergence is least at phi = 3 / (1 + 1)


def test_no_entry_of_phi_changes_by_more_than_the_limit_in_sigmas() -> None:
    asked = problem(dataset_of([9.0, -9.0]))
    found = long(limit=0.5).candidates(asked)[0]
    assert np.allclose((found - START) / UNIT, [0.5, -0.5], atol=0.01)
    near = CmaDebiased(limit=0.5, smear=1e-9).candidates(asked := problem(dataset_of([9.0, -9.0])))[0]
    designs = np.concatenate([designs.reshape(-1, 2) for designs in asked_of(asked)[2:]])
    assert np.abs((designs - START) / UNIT).max() <= 0.5 + 1e-6
    assert np.abs((near - START) / UNIT).max() <= 0.5


def test_cma_begins_at_phi_with_the_step_of_its_settings_in_sigmas() -> None:
    asked = problem(dataset_of([5.0, 6.0]))
    CmaDebiased(population=1000, generations=1, sigma0=0.25, smear=1e-9, limit=100.0).candidates(asked)
    first = asked_of(asked)[2][:, 0]
    assert np.allclose(first.mean(0), START, atol=0.05)
    assert np.allclose(first.std(0), 0.25 * UNIT, rtol=0.1)


def test_the_pull_weighs_a_step_of_one_sigma_in_the_units_of_the_cost() -> None:
    wanted = START + np.array([1.0, 0.0]) * UNIT
    free = long().costs(asked := problem(dataset_of(wanted)), ended(), UNIT)
    held = long(pull=0.7).costs(asked, ended(), UNIT)
    for steps, length in ([[0, 0], 0], [[1, 0], 1], [[2, 1], 5], [[0, -3], 9]):
        at = (START + steps * UNIT)[None]
        assert held(at) - free(at) == pytest.approx(0.7 * length, abs=0.05 * (1 + length))


def test_each_component_counts_in_units_of_what_the_explored_designs_change() -> None:
    cost = CmaDebiased(draws=2000, smear=1e-9).costs(problem(dataset_of(START, 2000)), ended(), UNIT)
    for steps, length in ([[1, 0], 1], [[0, 1], 1], [[3, 0], 9]):  # a variance of one Sigma each
        assert cost((START + steps * UNIT)[None]) == pytest.approx(length, rel=0.15)


@pytest.mark.parametrize(("clip", "cost"), [(0.0, 9.0), (1.0, 1.0), (0.5, 0.25)])
def test_differences_count_up_to_the_clip(clip: float, cost: float) -> None:
    given = problem(dataset_of([5.0, 2.0], 2000), spread=Spread(0.1, 0.0))
    of = CmaDebiased(draws=2000, smear=1e-9, drift_clip=clip).costs(given, ended(), 0.1 * SPACE.scale)
    assert of(START[None]) == pytest.approx(cost / 0.1**2, rel=0.15)


def test_what_the_proxy_does_not_fit_is_no_drift() -> None:
    memory = ended()
    memory.reference = proxy([[2.5, 0.0], [0.0, 2.0]])  # Hw-Phy says 2
    wanted = dataset_of([2.5 + 0.4, 2.0])
    for target, found in ("proxy", 2.9), ("drift", 2.4):
        asked = problem(wanted, memory=memory)
        assert np.allclose(long(target=target).candidates(asked)[0], [found, 2.0], atol=0.01)


def test_locks_hold() -> None:
    space = SPACE.with_bound("first", 0.0, 2.1).with_lock("second", 2.0)
    asked = problem(dataset_of([3.0, 1.0]), space)
    assert np.allclose(long().candidates(asked)[0], [2.1, 2.0], atol=0.01)
    assert (np.concatenate([designs.reshape(-1, 2) for designs in asked_of(asked)])[:, 1] == 2.0).all()


def test_designs_that_can_not_be_simulated_change_nothing() -> None:
    class Brittle(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return lambda s, _: np.where(phi[:, :1] > 2.4, np.nan, phi * s[:, :2])

    assert np.isfinite(CmaDebiased().candidates(problem(dataset_of([3.0, 1.5]), task=Brittle()))).all()


# --- the designs that are asked ---


def test_all_candidates_of_a_generation_share_the_designs_around_them_and_no_two_halves_do() -> None:
    asked = problem(dataset_of(START, pairs=12))
    CmaDebiased(population=4, generations=2, draws=4, sigma0=0.1).candidates(asked)
    halves = asked_of(asked)
    assert [designs.shape for designs in halves] == [(1, 12, 2)] * 2 + [(4, 12, 2)] * 4
    assert asked.physics.steps == (2 * 1 + 2 * 2 * 4) * 12
    changes = [designs - designs.mean(1, keepdims=True) for designs in halves]
    for around in changes:
        assert np.allclose(around, around[:1])  # each candidate the same
        assert np.allclose(around[0, :4], around[0, 4:8])  # dealt out in turn
        assert np.allclose(around[0, :2], -around[0, 2:4])  # antithetic
    drawn = [around[0, 0].round(6).tolist() for around in changes]
    assert len({tuple(one) for one in drawn}) == len(drawn)


@pytest.mark.parametrize(("smear", "width"), [(0.5, 0.5), (2.0, 2.0)])
def test_a_candidate_is_smeared_by_a_share_of_sigma(smear: float, width: float) -> None:
    asked = problem(dataset_of(START, pairs=2000))
    CmaDebiased(population=4, generations=1, draws=2000, smear=smear).candidates(asked)
    explored, candidate = asked_of(asked)[0][0], asked_of(asked)[2][0]
    assert np.allclose(explored.std(0), UNIT, rtol=0.1)
    assert np.allclose(candidate.std(0), width * UNIT, rtol=0.1)


def test_the_same_seed_finds_the_same_phi() -> None:
    once, again, other = (
        CmaDebiased().candidates(problem(dataset_of([3.0, 1.5]), seed=seed))[0].tolist() for seed in (1, 1, 2)
    )
    assert once == again != other


# --- what it keeps ---


def test_a_warm_search_begins_as_wide_as_the_last_one_ended_and_never_wider_than_sigma0() -> None:
    memory, search = ended(), CmaDebiased(population=1000, generations=1, sigma0=0.5, smear=1e-9, limit=100.0)
    for start_as, before, width in (
        ("fresh", [0.2, 0.3], [0.5, 0.5]),
        ("warm", [0.2, 0.3], [0.2, 0.3]),
        ("warm", [9.0, 0.001], [0.5, 0.05]),
        ("warm", None, [0.5, 0.5]),
    ):
        memory.stds = None if before is None else np.array(before)
        asked = problem(dataset_of([3.0, 1.5]), memory=memory)
        dataclasses.replace(search, start=start_as).candidates(asked)
        assert np.allclose(asked_of(asked)[2][:, 0].std(0), width * UNIT, rtol=0.1)


def test_how_wide_it_ended_is_kept_in_sigmas() -> None:
    memory = ended()
    for generations in (1, 30):
        long(generations=generations, sigma0=0.4).candidates(problem(dataset_of(START), memory=memory))
        assert memory.stds is not None
        wide = memory.stds.max() > 0.2
        assert wide == (generations == 1)


def test_after_the_search_the_proxy_settles_where_it_is_asked_to() -> None:
    for settle, weights in ("proxy", [[2.0, 0.0], [0.0, 2.0]]), ("nothing", [[3.0, 0.0], [0.0, 2.0]]):
        memory, hw_nn = ended(settle=settle), proxy([[3.0, 0.0], [0.0, 2.0]])
        memory.phi_was_found(hw_nn)
        assert weights_of(hw_nn) == weights


def test_it_needs_its_own_memory() -> None:
    with pytest.raises(ValueError, match="the search cma_debiased needs the memory"):
        CmaDebiased().candidates(problem(dataset_of(START), memory=Memory()))


def test_a_warm_run_that_was_stopped_goes_on_as_one_that_was_not(tmp_path: Path) -> None:
    method = replaced(search=CmaDebiased(pairs=8, population=4, generations=2, start="warm"))
    record = RunRecord(
        id="run", task="scales", method="morph", seed=3, iterations=6, config={},
        parameters=list(SPACE.parameters), versions={}, created=0.0,
    )  # fmt: skip
    whole = start(Scales(), method, 3)
    run = method.iterations(Scales(), whole)
    for _ in range(3):
        next(run)
    folder = create_run(tmp_path, record)
    save_checkpoint(folder, whole, 1.0)
    resumed, _ = load_checkpoint(folder, 3, Scales(), method)
    assert resumed.memory.facts == whole.memory.facts != {}
    going_on = method.iterations(Scales(), resumed)
    for _ in range(3):
        assert next(going_on) == next(run)
    assert resumed.memory.facts == whole.memory.facts


def test_a_checkpoint_before_the_first_search_knows_no_width() -> None:
    memory = ended()
    assert memory.facts == {}
    memory.recall({})
    assert memory.stds is None
