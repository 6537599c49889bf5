"""The searches for phi on a Hw-Phy that is linear in it, so that where they must end is known."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from morph_core.design import DesignSpace
from morph_core.search import Dataset, Memory, Physics, Problem, Search, derive_design, relabel
from morph_core.searches.cma import Cma
from morph_core.searches.drift import Drift
from morph_core.searches.gradient import Gradient
from morph_core.spread import Spread
from morph_core.task import Task
from morph_core.twin import Twin
from tests.core.scales import Multiplied, Scales, proxy, replaced, started, tensor, trajectories, weights_of

SPACE = Scales().design_space
START = np.array([2.0, 2.0])


class Noted(Physics):
    """Physics that notes every design it is asked about."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.asked: list[np.ndarray] = []

    def z(self, s: np.ndarray, a: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        self.asked.append(candidates)
        return super().z(s, a, candidates)


def dataset_of(phi: Any, pairs: int = 64, seed: int = 0, widths: Any = (1.0, 1.0)) -> Dataset:
    """Return sampled s of exactly these root mean squares, with the z of a design."""
    s = np.random.default_rng(seed).standard_normal((pairs, 2))
    s *= np.array(widths) / np.sqrt((s**2).mean(0))
    return Dataset(np.pad(s, ((0, 0), (0, 1))), np.zeros((pairs, 2)), s * np.asarray(phi))


def problem(dataset: Dataset, space: DesignSpace = SPACE, task: Task | None = None, **others: Any) -> Problem:
    given = {"start": START, "spread": Spread(0.5, 0.0), "memory": Memory(), "seed": 1} | others
    return Problem(Noted(task or Scales()), space, dataset, **given)


# --- physics ---


def test_the_cost_of_a_design_is_its_divergence_from_the_dataset() -> None:
    dataset = Dataset(np.array([[1.0, 2.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros((2, 2)), np.zeros((2, 2)))
    physics = Physics(Scales())
    costs = physics.costs(dataset, np.array([[1.0, 1.0], [3.0, 0.0]]))
    assert costs.tolist() == [(1 + 4 + 1) / 2, 9 / 2]
    assert physics.steps == 4


def test_where_a_simulation_diverges_a_design_costs_as_much_as_the_farthest_that_did_not() -> None:
    class Brittle(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return lambda s, _: np.where((phi * s[:, :2] > 5).any(1)[:, None], np.nan, phi * s[:, :2])

    dataset = Dataset(np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), np.zeros((2, 2)), np.zeros((2, 2)))
    costs = Physics(Brittle()).costs(dataset, np.array([[1.0, 0.0], [3.0, 0.0], [6.0, 0.0]]))
    assert costs.tolist() == [(1 + 4) / 2, (9 + 9) / 2, 9.0]
    assert Physics(Brittle()).costs(dataset, np.array([[6.0, 0.0]])).tolist() == [np.inf]


# --- gradient ---


def test_a_step_of_the_gradient_is_one_over_the_largest_curvature() -> None:
    dataset = dataset_of([5.0, 6.0], widths=(2.0, 1.0))
    start, found = Gradient(steps=1).candidates(problem(dataset))
    assert start.tolist() == START.tolist()
    # D is 4 (phi_1 - 5)^2 + (phi_2 - 6)^2: the first is there at once, the second after 1/4 of the way
    assert found.tolist() == pytest.approx([5.0, 2 + (6 - 2) / 4])
    assert Gradient(steps=2).candidates(problem(dataset))[1].tolist() == pytest.approx([5.0, 3 + (6 - 3) / 4])
    assert Gradient(steps=200).candidates(problem(dataset))[1].tolist() == pytest.approx([5.0, 6.0])


def test_the_gradient_stops_at_the_box_and_leaves_locks_alone() -> None:
    space = SPACE.with_bound("first", 0.0, 3.5).with_lock("second", 2.0)
    found = Gradient(steps=50).candidates(problem(dataset_of([5.0, 6.0]), space))[1]
    assert found.tolist() == [3.5, 2.0]


def test_without_a_gradient_in_phi_the_search_is_refused_with_the_choices() -> None:
    class Opaque(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return lambda s, _: phi * s[:, :2]

    Gradient().check(Scales())
    with pytest.raises(ValueError, match='no gradient in phi: search by "cma" or "drift"'):
        Gradient().check(Opaque())
    with pytest.raises(ValueError, match="no gradient in phi"):
        Gradient().candidates(problem(dataset_of([5.0, 6.0]), task=Opaque()))


# --- cma ---


def test_cma_starts_at_phi_with_the_step_of_its_settings_in_units_of_scale() -> None:
    asked = problem(dataset_of([5.0, 6.0]), start=np.array([4.0, 3.0]))
    Cma(population=1000, generations=1, sigma0=0.25).candidates(asked)
    first: np.ndarray = asked.physics.asked[0]  # pyright: ignore[reportAttributeAccessIssue]
    assert first.shape == (1000, 2)
    assert np.allclose(first.mean(0), [4.0, 3.0], atol=0.05)
    assert np.allclose(first.std(0), [0.25, 0.25 * 2], rtol=0.1)


def test_cma_takes_its_generations_of_its_population_and_ends_where_hw_phy_matches() -> None:
    asked = problem(dataset_of([5.0, 6.0]))
    start, found = Cma(population=10, generations=40, sigma0=0.5).candidates(asked)
    assert start.tolist() == START.tolist()
    assert np.allclose(found, [5.0, 6.0], atol=0.01)
    assert asked.physics.steps == 10 * 40 * 64


def test_cma_keeps_to_the_box() -> None:
    space = SPACE.with_bound("first", 1.0, 3.5)
    asked = problem(dataset_of([5.0, 6.0]), space)
    found = Cma(population=10, generations=40, sigma0=0.5).candidates(asked)[1]
    designs = np.concatenate(asked.physics.asked)  # pyright: ignore[reportAttributeAccessIssue]
    assert ((designs[:, 0] >= 1.0) & (designs[:, 0] <= 3.5)).all()
    assert np.allclose(found, [3.5, 6.0], atol=0.02)


def test_the_same_seed_finds_the_same_phi() -> None:
    once, again, other = (
        Cma(generations=3).candidates(problem(dataset_of([5.0, 6.0]), seed=seed))[1].tolist() for seed in (1, 1, 2)
    )
    assert once == again != other


@pytest.mark.parametrize(("lo", "hi", "best"), [(-20.0, 20.0, 5.0), (0.0, 3.0, 3.0)])
def test_along_a_single_free_parameter_cma_is_a_grid_over_its_bounds(lo: float, hi: float, best: float) -> None:
    space = SPACE.with_lock("second", 2.0).with_bound("first", lo, hi)
    asked = problem(dataset_of([5.0, 6.0]), space)
    found = Cma(population=5, generations=9).candidates(asked)[1]
    (grid,) = asked.physics.asked  # pyright: ignore[reportAttributeAccessIssue]
    assert np.allclose(grid[:, 0], np.linspace(lo, hi, 45))
    assert (grid[:, 1] == 2.0).all()
    assert found[0] == pytest.approx(grid[np.abs(grid[:, 0] - best).argmin(), 0])


# --- drift ---

SIGNS = np.array([[1, 1], [1, 1], [1, -1], [1, -1], [-1, 1], [-1, 1], [-1, -1], [-1, -1]], dtype=float)
"""Noise whose components are uncorrelated to the last digit, in either half (even and odd rows) alike."""


@dataclass(frozen=True)
class Given(Spread):
    """A spread with this noise for the designs of a search."""

    rows: Any = None

    def noise(self, space: DesignSpace, count: int, rng: np.random.Generator) -> np.ndarray:
        assert count == len(self.rows)
        return np.asarray(self.rows, dtype=float)


def drifted(
    by: Any, drift: Drift, spread: Spread | None = None, space: DesignSpace = SPACE, **others: Any
) -> tuple[np.ndarray, Problem]:
    """Return what the search finds where the task has drawn the proxy by this much in phi away from its reference."""
    spread = spread or Given(0.5, 0.0, SIGNS)
    reference = proxy([[2.0, 0.0], [0.0, 2.0]])
    asked = problem(dataset_of(np.array([2.0, 2.0]) + by), space, spread=spread, memory=Twin(reference), **others)
    (found,) = drift.candidates(asked)
    return found, asked


def search(**settings: Any) -> Drift:
    return Drift(**{"designs": 16, "ridge": 0.0, "limit": 100.0} | settings)


def test_phi_follows_the_drift_where_hw_phy_is_linear() -> None:
    found, asked = drifted([0.3, -0.4], search())
    assert np.allclose(found - START, [0.3, -0.4], rtol=0.01)
    assert asked.physics.steps == 16 * 64
    (designs,) = asked.physics.asked  # pyright: ignore[reportAttributeAccessIssue]
    assert np.allclose(designs[:8] - START, SIGNS * [0.5, 1.0])
    assert np.allclose(designs[8:] - START, -SIGNS * [0.5, 1.0])


@pytest.mark.parametrize(("ridge", "share"), [(0.5, 1.0), (2.0, 1 / 2), (4.0, 1 / 4)])
def test_the_ridge_is_the_least_curvature_as_a_share_of_the_mean(ridge: float, share: float) -> None:
    found, _ = drifted([0.3, -0.4], search(ridge=ridge))
    assert np.allclose(found - START, np.array([0.3, -0.4]) * share, rtol=0.01)


@pytest.mark.parametrize(("limit", "length"), [(0.5, 0.5), (10.0, 5.0)])
def test_a_step_is_no_longer_than_the_limit_in_units_of_the_explored_sigma(limit: float, length: float) -> None:
    found, _ = drifted([0.5 * 3.0, 0.5 * 2 * 4.0], search(limit=limit))  # 3 and 4 Sigmas
    in_sigmas = (found - START) / [0.5, 1.0]
    assert np.linalg.norm(in_sigmas) == pytest.approx(length, rel=0.01)
    assert in_sigmas[0] / in_sigmas[1] == pytest.approx(3 / 4, rel=0.01)


def ones(by: Any) -> Dataset:
    """Return pairs with s = 1, so that z is phi."""
    return Dataset(np.ones((4, 3)), np.zeros((4, 2)), np.tile(np.array([2.0, 2.0]) + by, (4, 1)))


@pytest.mark.parametrize(("clip", "step"), [(0.0, 3.0), (1.0, 1.0), (0.5, 0.5)])
def test_the_drift_counts_up_to_the_clip(clip: float, step: float) -> None:
    asked = problem(ones([3.0, 0.0]), spread=Given(0.25, 0.0, SIGNS), memory=Twin(proxy([[2.0, 0.0], [0.0, 2.0]])))
    found = search(drift_clip=clip).candidates(asked)[0]
    assert found.tolist() == pytest.approx([2.0 + step, 2.0], rel=0.01)


def test_the_change_between_two_designs_counts_up_to_the_clip() -> None:
    asked = problem(ones([0.5, 0.0]), spread=Given(2.0, 0.0, SIGNS), memory=Twin(proxy([[2.0, 0.0], [0.0, 2.0]])))
    # a change of 2 counts 1: dz/dphi seems half as large, phi goes twice as far
    assert search(drift_clip=1.0).candidates(asked)[0].tolist() == pytest.approx([2.0 + 1.0, 2.0], rel=0.01)


def test_two_halves_of_the_designs_are_multiplied_and_neither_with_itself() -> None:
    space = SPACE.with_lock("second", 2.0)
    uneven = np.array([[1, 0], [2, 0], [-1, 0], [-2, 0]])  # in one half the variance is 1, in the other 4
    for ridge, share in ((0.0, (1 + 4) / 2 / (1 * 4)), (1.0, (1 + 4) / 2 / ((1 + 16) / 2))):
        found, _ = drifted([0.3, 0.0], search(designs=8, ridge=ridge), Given(0.5, 0.0, uneven), space)
        assert found[0] - 2.0 == pytest.approx(0.3 * share, rel=0.01)
        assert found[1] == 2.0


def test_every_group_of_pairs_is_tried_with_designs_of_its_own() -> None:
    asked = problem(dataset_of([2.3, 1.6]), spread=Spread(0.5, 0.0), memory=Twin(proxy([[2.0, 0.0], [0.0, 2.0]])))
    found = search(designs=4, groups=16, ridge=0.2).candidates(asked)[0]
    asked_of = asked.physics.asked  # pyright: ignore[reportAttributeAccessIssue]
    assert [designs.shape for designs in asked_of] == [(4, 2)] * 16
    assert len(np.unique(np.concatenate(asked_of), axis=0)) == 16 * 4
    assert asked.physics.steps == 4 * 64  # every pair is in one group
    assert np.dot(found - START, [0.3, -0.4]) > 0


@pytest.mark.parametrize("groups", [3, 64, 65])
def test_however_the_pairs_are_split_phi_follows_the_drift(groups: int) -> None:
    found, asked = drifted([0.3, -0.4], search(groups=groups))
    assert np.allclose(found - START, [0.3, -0.4], rtol=0.01)
    assert asked.physics.steps == 16 * 64
    assert len(asked.physics.asked) == min(groups, 64)  # pyright: ignore[reportAttributeAccessIssue]


def test_what_a_rough_hw_phy_adds_to_a_half_does_not_shorten_the_step() -> None:
    class Rough(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return lambda s, _: phi * s[:, :2] + 5 * noise.standard_normal((len(s), 2))

    noise, steps = np.random.default_rng(0), []
    space = SPACE.with_lock("second", 2.0)
    for seed in range(10):
        found, _ = drifted([0.3, 0.0], search(designs=400), Spread(0.5, 0.0), space, task=Rough(), seed=seed)
        steps.append((found[0] - 2.0) / 0.3)
    assert np.mean(steps) == pytest.approx(1.0, abs=0.15)  # half as long by the square of one estimate


def test_designs_that_can_not_be_simulated_change_nothing() -> None:
    class Brittle(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return lambda s, _: np.where(phi[:, :1] > 2.4, np.nan, phi * s[:, :2])

    found, _ = drifted([0.3, -0.4], search(), task=Brittle())
    assert np.isfinite(found).all()


@pytest.mark.parametrize("correlation", [0.0, 0.6])
@pytest.mark.parametrize("ridge", [0.0, 1.0])
def test_correlated_designs_find_the_same_and_under_a_ridge_what_they_have_in_common(
    correlation: float, ridge: float
) -> None:
    space, scale = Scales(grouped=True).design_space, 0.5 * np.array([1.0, 2.0])
    covariance = np.array([[1, correlation], [correlation, 1]])
    root = np.linalg.cholesky(covariance)
    spread = Given(0.5, correlation, SIGNS @ root.T)
    by = np.array([0.3, -0.4])
    found, _ = drifted(by, search(ridge=ridge), spread, space)
    values, vectors = np.linalg.eigh(root.T @ root)  # of J'J in units of the white noise, up to a factor
    floor = np.maximum(values, ridge * np.trace(covariance) / 2)
    white = vectors @ (vectors.T @ (root.T @ (by / scale)) / floor)
    assert np.allclose(found - START, scale * (root @ white), rtol=0.02)
    if ridge == 0:
        assert np.allclose(found - START, by, rtol=0.02)


def test_locks_and_box_hold_for_the_drift() -> None:
    space = SPACE.with_bound("first", 0.0, 2.1).with_lock("second", 2.0)
    found, _ = drifted([0.3, -0.4], search(), space=space)
    assert found.tolist() == [2.1, 2.0]


def test_the_drift_needs_its_own_memory() -> None:
    with pytest.raises(ValueError, match="the search drift needs the memory"):
        search().candidates(problem(dataset_of([1.0, 1.0])))


# --- the twin ---


def test_the_reference_begins_as_a_copy_and_drifts_from_the_proxy_by_what_the_task_asks() -> None:
    hw_nn = proxy([[1.0, 0.0], [0.0, 1.0]])
    twin = Drift().memory(hw_nn)
    assert twin.learners == {"reference": twin.reference}
    assert twin.reference is not hw_nn
    assert weights_of(twin.reference) == weights_of(hw_nn)
    hw_nn.proxy.net = proxy([[1.5, 0.0], [0.0, 1.0]]).proxy.net
    s, a = np.array([[2.0, 3.0, 0.0]]), np.zeros((1, 2))
    assert twin.drift(Dataset(s, a, hw_nn(s, a))).tolist() == [[1.0, 0.0]]


def test_the_reference_learns_from_hw_phy_alone_and_what_it_learnt_passes_to_the_proxy() -> None:
    hw_nn = started().hw_nn
    twin = Drift().memory(hw_nn)
    twin.learn(tensor([[1.0, 1.0]]), tensor([[9.0, 9.0]]))
    reference, s, a = twin.reference, np.ones((1, 3)), np.zeros((1, 2))
    assert hw_nn(s, a).tolist() != reference(s, a).tolist()
    assert not hw_nn.optimizer.state
    twin.phi_was_found(hw_nn)
    assert hw_nn(s, a).tolist() == reference(s, a).tolist()
    moments, kept = (network.optimizer.state_dict()["state"] for network in (hw_nn, reference))
    assert moments.keys() == kept.keys() != set()
    assert all((moments[i][name] == kept[i][name]).all() for i in kept for name in kept[i])
    twin.learn(tensor([[1.0, 1.0]]), tensor([[9.0, 9.0]]))  # they are two again
    assert hw_nn(s, a).tolist() != reference(s, a).tolist()
    assert all((moments[i]["step"] == 1).all() for i in moments)


def test_after_a_fit_the_reference_is_as_the_proxy_is() -> None:
    hw_nn = proxy([[1.0, 0.0], [0.0, 1.0]])
    twin = Drift().memory(hw_nn)
    hw_nn.proxy.net = proxy([[1.5, 0.0], [0.0, 1.0]]).proxy.net
    twin.proxy_was_fitted(hw_nn)
    assert weights_of(twin.reference) == weights_of(hw_nn) == [[1.5, 0.0], [0.0, 1.0]]


@pytest.mark.parametrize("kind", [Cma, Gradient])
def test_the_other_searches_keep_nothing(kind: type[Search]) -> None:
    hw_nn = proxy([[1.0, 0.0], [0.0, 1.0]])
    memory = kind().memory(hw_nn)
    memory.proxy_was_fitted(hw_nn)
    memory.learn(tensor([[1.0, 1.0]]), tensor([[9.0, 9.0]]))
    memory.phi_was_found(hw_nn)
    assert memory.learners == {}
    assert weights_of(hw_nn) == [[1.0, 0.0], [0.0, 1.0]]


# --- lines 5 and 6 ---


@dataclass(frozen=True)
class Fixed(Search):
    """A search that proposes these designs."""

    proposed: tuple = ()

    def candidates(self, problem: Problem) -> np.ndarray:
        seen.append(problem)
        return np.array(self.proposed, dtype=float)


seen: list[Problem] = []


@pytest.fixture(autouse=True)
def forget() -> None:
    seen.clear()


def test_of_what_a_search_proposes_the_design_of_least_divergence_is_taken() -> None:
    state = started()
    state.search_steps = 100
    cost = derive_design(
        Scales(), state, dataset_of([5.0, 6.0]), Fixed(proposed=([9, 9], [5, 5], [2, 2])), Spread(0.5, 0.0)
    )
    assert state.phi.tolist() == [5.0, 5.0]
    assert cost == pytest.approx(1.0)
    assert (state.search_steps, state.relabelled_steps) == (100 + 3 * 64, 0)


def test_a_search_begins_inside_the_box_with_what_the_state_holds() -> None:
    state = started(seed=3)
    state.design_space = SPACE.with_bound("first", 3.0, 4.0)
    spread, dataset = Spread(0.5, 0.0), dataset_of([5.0, 6.0])
    seed = int(np.random.default_rng(3).integers(1, 2**31))
    derive_design(Scales(), state, dataset, Fixed(proposed=([3, 3],)), spread)
    (given,) = seen
    assert given.start.tolist() == [3.0, 2.0]
    assert (given.space, given.spread, given.memory, given.seed) == (state.design_space, spread, state.memory, seed)
    assert given.dataset is dataset


def test_with_every_parameter_locked_nothing_is_searched_for() -> None:
    state = started()
    state.design_space = SPACE.with_lock("first", 2.0).with_lock("second", 3.0)
    cost = derive_design(Scales(), state, dataset_of([5.0, 6.0]), Fixed(), Spread(0.5, 0.0))
    assert seen == []
    assert state.phi.tolist() == [2.0, 3.0]
    assert cost == pytest.approx(18.0)


def test_a_design_that_can_not_be_built_is_halved_back_to_phi() -> None:
    state = started()
    derive_design(Scales(), state, dataset_of([30.0, 6.0]), Fixed(proposed=([18, 6],)), Spread(0.5, 0.0))
    assert state.phi.tolist() == [10.0, 4.0]


def test_once_phi_was_found_the_proxy_is_the_reference() -> None:
    state = started(replaced(search=search()))
    state.proxy = proxy([[3.0, 0.0], [0.0, 2.0]])
    state.memory = Twin(proxy([[2.0, 0.0], [0.0, 2.0]]))
    dataset = dataset_of([2.3, 2.0])
    derive_design(Scales(), state, dataset, search(), Given(0.5, 0.0, SIGNS))
    assert np.allclose(state.phi, [2.3, 2.0], atol=0.01)
    assert weights_of(state.hw_nn) == [[2.0, 0.0], [0.0, 2.0]]


def test_line_5_labels_steps_alive_with_the_proxy() -> None:
    alive = np.ones((3, 4), dtype=bool)
    alive[1:, 2] = False
    rng = np.random.default_rng(1)
    rollout = trajectories(np.zeros((3, 4)), alive, s=rng.standard_normal((3, 4, 3)), a=rng.standard_normal((3, 4, 2)))
    dataset = relabel(rollout, Multiplied(np.array([2.0, 3.0])), 500, np.random.default_rng(0))
    assert dataset.s.shape == (500, 3)
    assert {tuple(s) for s in dataset.s} == {tuple(s) for s in rollout.s[alive]}
    assert {(*s, *a) for s, a in zip(dataset.s, dataset.a, strict=True)} == {
        (*s, *a) for s, a in zip(rollout.s[alive], rollout.a[alive], strict=True)
    }
    assert np.array_equal(dataset.z, dataset.s[:, :2] * [2.0, 3.0])


def test_settings_of_a_search_are_checked() -> None:
    with pytest.raises(ValueError, match="designs must be a multiple of 4"):
        dataclasses.replace(Drift(), designs=6)
