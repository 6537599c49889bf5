"""The search for phi: it finds the design that the data came from, and keeps to box and locks."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.design import DesignSpace
from morph_core.divergence import divergence
from morph_core.exploration import run_trajectories
from morph_core.hw_nn import HwNN
from morph_core.methods.proxy import Morph
from morph_core.search import Dataset, Memory, Search, derive_design, relabel
from morph_core.searches.cma import Cma
from morph_core.searches.drift import Drift
from morph_core.searches.gradient import Gradient
from morph_core.spread import Spread
from morph_core.state import start as start_of_run
from morph_core.task import Hardware, Task
from morph_core.tasks.reacher import LINKS, Reacher
from morph_core.twin import Twin
from tests.core.conftest import small_method

lengths = st.lists(st.floats(0.05, 5.0), min_size=LINKS, max_size=LINKS).map(np.array)
THOROUGH = {"cma": Cma(generations=60, sigma0=0.5), "gradient": Gradient()}
DRIFT = Drift(designs=96)
BRITTLE_BEYOND = 4.0  # m


@dataclass(frozen=True)
class Brittle(Reacher):
    """A reacher whose Hw-Phy diverges with any link longer than BRITTLE_BEYOND."""

    def hw_phy(self, phi: np.ndarray) -> Hardware:  # pyright: ignore[reportIncompatibleMethodOverride]
        arm, breaks = super().hw_phy(phi), np.max(phi, -1) > BRITTLE_BEYOND
        return lambda s, a: np.where(np.broadcast_to(breaks, len(s))[:, None], np.nan, arm(s, a))


@dataclass(frozen=True)
class Found:
    """What a search for phi came to."""

    phi: np.ndarray
    cost: float
    steps: int
    """Steps of Hw-Phy that it took."""


class StandIn(Twin):
    """A twin whose reference says what the Hw-Phy of a design says: the drift is then that from this design."""

    def __init__(self, reference: Hardware) -> None:
        self.reference = reference  # pyright: ignore[reportAttributeAccessIssue] - it is only asked for z

    def phi_was_found(self, hw_nn: HwNN) -> None:
        """Leave the proxy alone: nobody has trained a reference."""


def dataset_of(task: Reacher, phi: np.ndarray, pairs: int = 128) -> Dataset:
    s, a = task.sample_pairs(pairs, np.random.default_rng(0))
    return Dataset(s, a, task.hw_phy(phi)(s, a))


def derived(
    task: Task, data: Dataset, search: Search, *, seed: int = 1, sigma: float = 1.0, start: np.ndarray | None = None,
    space: DesignSpace | None = None, memory: Memory | None = None,
) -> Found:  # fmt: skip
    """Search from `start` for the phi behind the data. By `drift`, the task has drawn the proxy to where the data is
    from where the Hw-Phy of the initial design has it."""
    state = start_of_run(task, Morph(hidden=4, search=search), seed, space)
    state.phi = state.phi if start is None else start
    if memory is None and isinstance(search, Drift):
        memory = StandIn(task.hw_phy(task.design_space.initial))
    state.memory = memory or state.memory
    cost = derive_design(task, state, data, search, Spread(sigma, 0.0))
    return Found(state.phi, cost, state.search_steps)


def distance(task: Reacher, data: Dataset, phi: np.ndarray) -> float:
    return float(divergence(task.hw_phy(phi)(data.s, data.a), data.z))


@pytest.mark.parametrize("search", ["cma", "gradient"])
@pytest.mark.parametrize("z", ["joints", "tip"])
def test_the_design_behind_the_data_is_found(search: str, z: str) -> None:
    task = Reacher(z=z)  # pyright: ignore[reportArgumentType]
    true = np.array([2.5, 2.1, 0.66, 1.0, 2.3])  # the paper's arm
    found = derived(task, dataset_of(task, true), THOROUGH[search])
    assert found.phi == pytest.approx(true, abs=0.05)
    assert found.cost < 0.01


def test_the_gradient_search_counts_what_it_asks_of_the_physics() -> None:
    task = Reacher()
    found = derived(task, dataset_of(task, task.design_space.initial * 0.9, 32), Gradient(steps=5))
    assert found.steps == (5 + 2) * 32  # a step each, and the divergence at the start and at the end


@settings(max_examples=15)
@given(lengths, st.sampled_from([Cma(generations=5), Gradient()]))
def test_the_search_keeps_to_bounds_and_locks_and_never_gets_worse(true: np.ndarray, search: Search) -> None:
    task = Reacher()
    space = task.design_space.with_bound("link_2", 1.0, 1.5).with_lock("link_4", 3.0)
    data = dataset_of(task, true, 32)
    before = distance(task, data, space.initial)
    found = derived(task, data, search, space=space)
    space.check(found.phi)
    assert found.phi[3] == 3.0
    assert found.cost <= before + 1e-12


@pytest.mark.parametrize("free", [0, 1])
def test_a_search_with_hardly_anything_free_works(free: int) -> None:
    task = Reacher()
    space = task.design_space
    for name in space.names[free:]:
        space = space.with_lock(name, 2.0)
    data = dataset_of(task, np.array([1.0, 2.0, 2.0, 2.0, 2.0]))
    phi = derived(task, data, Cma(), space=space).phi
    assert phi == pytest.approx([1.0 if free else 2.0, 2.0, 2.0, 2.0, 2.0], abs=0.03)


@pytest.mark.parametrize("search", [Cma(), Drift()])
def test_the_search_is_repeatable(search: Search) -> None:
    task = Reacher()
    data = dataset_of(task, np.full(LINKS, 1.0))
    once, again = (derived(task, data, search, seed=7) for _ in "ab")
    assert np.array_equal(once.phi, again.phi)
    assert (once.cost, once.steps) == (again.cost, again.steps)


@pytest.mark.parametrize("z", ["joints", "tip"])
@pytest.mark.parametrize("true", [[2.5, 2.1, 0.66, 1.0, 2.3], [4.0, 3.5, 3.0, 2.5, 2.0], [3.0, 3.0, 3.0, 3.0, 1.0]])
def test_the_drift_of_another_design_leads_towards_it(true: list[float], z: str) -> None:
    task = Reacher(z=z)  # pyright: ignore[reportArgumentType]
    start, data = task.design_space.initial, dataset_of(task, np.array(true), 256)
    found = derived(task, data, DRIFT, sigma=0.5)
    went, wanted = found.phi - start, np.array(true) - start
    assert went @ wanted > 0.8 * np.linalg.norm(went) * np.linalg.norm(wanted)
    assert np.linalg.norm(went) <= DRIFT.limit * 0.5 + 1e-9
    assert found.cost < distance(task, data, start)


def test_averaged_over_many_designs_the_drift_gives_away_the_design_itself() -> None:
    task, search = Reacher(), dataclasses.replace(DRIFT, designs=400)
    start = task.design_space.initial
    for change in ([0.2, -0.1, 0.1, -0.2, 0.1], [0.0, 0.0, 0.3, 0.0, 0.0]):
        true = start + np.array(change)
        found = derived(task, dataset_of(task, true, 256), search)
        assert found.phi == pytest.approx(true, abs=0.07)


@settings(max_examples=15)
@given(lengths, st.floats(0.05, 5.0), st.integers(0, 2**31 - 1))
def test_the_drift_search_keeps_to_bounds_and_locks_and_counts_its_steps(
    true: np.ndarray, sigma: float, seed: int
) -> None:
    task, search = Reacher(), Drift(designs=8)
    space = task.design_space.with_bound("link_1", 1.0, 1.5).with_lock("link_4", 3.0)
    found = derived(task, dataset_of(task, true, 32), search, seed=seed, sigma=sigma, space=space)
    space.check(found.phi)
    assert found.phi[3] == 3.0
    assert found.steps == (search.designs + 1) * 32


def test_without_drift_phi_stays() -> None:
    task = Reacher()
    start = task.design_space.initial
    found = derived(task, dataset_of(task, start), DRIFT)
    assert found.phi.tolist() == start.tolist()
    assert found.cost == 0


def test_the_drift_search_needs_its_memory() -> None:
    task = Reacher()
    with pytest.raises(ValueError, match="the search drift needs the memory that it made"):
        derived(task, dataset_of(task, np.full(5, 1.0)), DRIFT, memory=Memory())


def test_a_candidate_that_can_not_be_simulated_is_as_far_as_the_farthest_that_can() -> None:
    task = Brittle()
    data = dataset_of(Reacher(), np.full(LINKS, 2.0), 32)
    found = derived(task, data, Cma(generations=8))
    assert found.phi.max() <= BRITTLE_BEYOND
    assert np.isfinite(found.cost)
    twin = StandIn(Reacher().hw_phy(task.design_space.initial))
    half_lost = derived(task, dataset_of(Reacher(), np.full(LINKS, 2.0)), DRIFT, start=np.full(LINKS, 4.0), memory=twin)
    task.design_space.check(half_lost.phi)
    assert np.isfinite(half_lost.cost)


@pytest.mark.parametrize("search", ["cma", "cma_debiased", "gradient", "drift"])
def test_the_dataset_is_what_the_proxy_says_and_a_twin_knows_how_far_it_was_drawn(search: str) -> None:
    task, method = Reacher(), small_method("morph", {"search": search})
    state = start_of_run(task, method, 0)
    with torch.no_grad():
        next(state.hw_nn.proxy.parameters()).mul_(1.1)
    rollout = run_trajectories(task, state, task.hw_phy(state.phi), method.trajectories)
    dataset = relabel(rollout, state.hw_nn, 50, state.rng)
    assert np.array_equal(dataset.z, state.hw_nn(dataset.s, dataset.a))
    assert isinstance(state.memory, Twin) == (search in ("drift", "cma_debiased"))
    if isinstance(state.memory, Twin):
        drift = state.memory.drift(dataset)
        assert np.array_equal(dataset.z - drift, state.memory.reference(dataset.s, dataset.a))
        assert np.abs(drift).max() > 0
