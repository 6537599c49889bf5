"""CMA-ES on the divergence without the variance of contact, on a Hw-Phy of which it is known where it must end."""

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
from morph_core.search import Dataset, Physics, Problem
from morph_core.searches import cma_debiased
from morph_core.searches.cma_debiased import DRAWS, SMALLEST_VARIANCE, CmaDebiased, split_halves
from morph_core.spread import Spread
from morph_core.state import State, start
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


def problem(dataset: Dataset, space: DesignSpace = SPACE, task: Task | None = None, **others: Any) -> Problem:
    memory = CmaDebiased().memory(proxy([[2.0, 0.0], [0.0, 2.0]]))
    given = {"start": START, "spread": Spread(SIGMA, 0.0), "memory": memory, "seed": 1} | others
    return Problem(Noted(task or Scales()), space, dataset, **given)


def asked_of(asked: Problem) -> list[np.ndarray]:
    return asked.physics.asked  # pyright: ignore[reportAttributeAccessIssue]


def learnt(state: State) -> tuple[list[Any], list[Any]]:
    """Return all weights of proxy and twin."""
    of_twin = state.memory.learners["reference"]
    proxy, twin = ([weight.tolist() for weight in net.proxy.parameters()] for net in (state.hw_nn, of_twin))
    return proxy, twin


@pytest.fixture
def many_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every pair (s, a) have a design of its own, so that means over pairs are those over designs."""
    monkeypatch.setattr(cma_debiased, "DRAWS", 1000)


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


@pytest.mark.parametrize("limit", [0.5, 2.0])
def test_a_step_is_at_most_as_long_as_the_limit_in_sigmas(limit: float) -> None:
    far, near = dataset_of([9.0, -9.0]), dataset_of(START + 0.1 * UNIT)
    found = (long(limit=limit).candidates(problem(far))[0] - START) / UNIT
    assert np.linalg.norm(found) == pytest.approx(limit)
    assert found[0] > 0 > found[1]
    found = (long(limit=limit).candidates(problem(near))[0] - START) / UNIT
    assert np.allclose(found, 0.1, atol=0.02)


def test_the_limit_counts_a_change_that_designs_have_in_common_as_a_shorter_one() -> None:
    space = Scales(grouped=True).design_space
    for change, length in ([1.0, 1.0], np.sqrt(2 / 1.8)), ([1.0, -1.0], np.sqrt(2 / 0.2)):
        towards = problem(dataset_of(START + np.array(change) * 3 * UNIT), space, spread=Spread(SIGMA, 0.8))
        found = (long(limit=1.0).candidates(towards)[0] - START) / UNIT
        assert found == pytest.approx(np.array(change) / length, abs=0.05)


def test_cma_begins_at_phi_with_the_step_of_its_settings_in_sigmas() -> None:
    asked = problem(dataset_of([5.0, 6.0]))
    CmaDebiased(population=1000, generations=1, sigma0=0.25, smear=1e-9).candidates(asked)
    first = asked_of(asked)[2][:, 0]
    assert np.allclose(first.mean(0), START, atol=0.05)
    assert np.allclose(first.std(0), 0.25 * UNIT, rtol=0.1)


def test_a_candidate_is_asked_for_along_the_axes_in_which_the_explored_designs_vary() -> None:
    space = Scales(grouped=True).design_space
    asked = problem(dataset_of([5.0, 6.0]), space, spread=Spread(SIGMA, 0.8))
    CmaDebiased(population=1000, generations=1, smear=1e-9).candidates(asked)
    assert np.corrcoef(asked_of(asked)[2][:, 0].T)[0, 1] == pytest.approx(0.8, abs=0.05)


@pytest.mark.usefixtures("many_draws")
def test_each_component_counts_in_units_of_what_the_explored_designs_change() -> None:
    cost = CmaDebiased(smear=1e-9).costs(problem(dataset_of(START, 2000)))
    for steps, length in ([[1, 0], 1], [[0, 1], 1], [[3, 0], 9]):  # a variance of one Sigma each
        assert cost((START + steps * UNIT)[None]) == pytest.approx(length, rel=0.15)


@pytest.mark.parametrize(("clip", "cost"), [(0.0, 9.0), (1.0, 1.0), (0.5, 0.25)])
@pytest.mark.usefixtures("many_draws")
def test_differences_count_up_to_the_clip(clip: float, cost: float) -> None:
    given = problem(dataset_of([5.0, 2.0], 2000), spread=Spread(0.1, 0.0))
    of = CmaDebiased(smear=1e-9, drift_clip=clip).costs(given)
    assert of(START[None]) == pytest.approx(cost / 0.1**2, rel=0.15)


@pytest.mark.usefixtures("many_draws")
def test_the_variance_of_what_contact_does_to_designs_is_clipped_too() -> None:
    given = problem(dataset_of([5.0, 2.0], 2000), spread=Spread(1.0, 0.0))
    of = CmaDebiased(smear=1e-9, drift_clip=0.01).costs(given)  # nearly all of the halved differences are beyond it
    assert of(START[None]) == pytest.approx(0.01**2 / (2 * 0.01**2 + SMALLEST_VARIANCE), rel=0.05)


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
    asked = problem(dataset_of(START, pairs=4 * DRAWS))
    CmaDebiased(population=4, generations=2, sigma0=0.1).candidates(asked)
    halves = asked_of(asked)
    assert [len(designs) for designs in halves] == [1] * 2 + [4] * 4
    assert asked.physics.steps == (2 * 1 + 2 * 2 * 4) * 4 * DRAWS
    changes = [designs - designs.mean(1, keepdims=True) for designs in halves]
    for around in changes:
        assert np.allclose(around, around[:1])  # each candidate the same
        first, mirrored, again, _ = np.split(around[0], 4)  # dealt out in turn
        assert np.allclose(first, again)
        assert np.allclose(first, -mirrored)
    drawn = [around[0, 0].round(6).tolist() for around in changes]
    assert len({tuple(one) for one in drawn}) == len(drawn)


@pytest.mark.parametrize("smear", [0.5, 2.0])
@pytest.mark.usefixtures("many_draws")
def test_a_candidate_is_smeared_by_a_share_of_sigma(smear: float) -> None:
    asked = problem(dataset_of(START, pairs=2000))
    CmaDebiased(population=4, generations=1, smear=smear).candidates(asked)
    explored, candidate = asked_of(asked)[0][0], asked_of(asked)[2][0]
    assert np.allclose(explored.std(0), UNIT, rtol=0.1)
    assert np.allclose(candidate.std(0), smear * UNIT, rtol=0.1)


def test_the_same_seed_finds_the_same_phi() -> None:
    once, again, other = (
        CmaDebiased().candidates(problem(dataset_of([3.0, 1.5]), seed=seed))[0].tolist() for seed in (1, 1, 2)
    )
    assert once == again != other


# --- what it keeps ---


def test_once_phi_has_moved_the_proxy_starts_again_from_its_twin() -> None:
    hw_nn = proxy([[2.0, 0.0], [0.0, 2.0]])
    memory = CmaDebiased().memory(hw_nn)
    hw_nn.copy_weights(proxy([[3.0, 0.0], [0.0, 2.0]]))
    memory.phi_was_found(hw_nn)
    assert weights_of(hw_nn) == [[2.0, 0.0], [0.0, 2.0]]


def test_a_run_that_was_stopped_goes_on_as_one_that_was_not(tmp_path: Path) -> None:
    method = replaced(search=CmaDebiased(pairs=8, population=4, generations=2), design_interval=2)
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
    assert learnt(resumed) == learnt(whole)
    going_on = method.iterations(Scales(), resumed)
    for _ in range(2):
        assert next(going_on) == next(run)
    assert resumed.phi.tolist() == whole.phi.tolist()
    assert learnt(resumed) == learnt(whole)
    assert learnt(whole)[0] != learnt(whole)[1]
