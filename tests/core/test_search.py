"""The search for phi: it finds the design that the data came from, and keeps to box and locks."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.config import Config
from morph_core.derive import Dataset, derive_design, relabel
from morph_core.exploration import run_trajectories
from morph_core.state import start as start_of_run
from morph_core.task import Hardware
from morph_core.catalogue import make_task
from morph_core.tasks.reacher import LINKS, Reacher

lengths = st.lists(st.floats(0.05, 5.0), min_size=LINKS, max_size=LINKS).map(np.array)
THOROUGH = Config(search_generations=60, search_sigma=0.5)
DRIFT = Config(search="drift", drift_designs=96)
BRITTLE_BEYOND = 4.0  # m


@dataclass(frozen=True)
class Brittle(Reacher):
    """A reacher whose Hw-Phy diverges with any link longer than BRITTLE_BEYOND."""

    def hw_phy(self, phi: np.ndarray) -> Hardware:  # pyright: ignore[reportIncompatibleMethodOverride]
        arm, breaks = super().hw_phy(phi), np.max(phi, -1) > BRITTLE_BEYOND
        return lambda s, a: np.where(np.broadcast_to(breaks, len(s))[:, None], np.nan, arm(s, a))


def dataset_of(task: Reacher, phi: np.ndarray, pairs: int = 128) -> Dataset:
    s, a = task.sample_pairs(pairs, np.random.default_rng(0))
    return Dataset(s, a, task.hw_phy(phi)(s, a))


def drift_towards(task: Reacher, phi: np.ndarray, pairs: int = 128) -> Dataset:
    """Return what the proxy would say had the task drawn it from the initial design to phi."""
    data = dataset_of(task, phi, pairs)
    return dataclasses.replace(data, drift=data.z - task.hw_phy(task.design_space.initial)(data.s, data.a))


def distance(task: Reacher, data: Dataset, phi: np.ndarray) -> float:
    return float(((task.hw_phy(phi)(data.s, data.a) - data.z) ** 2).sum(-1).mean())


@pytest.mark.parametrize("search", ["cma", "gradient"])
@pytest.mark.parametrize("z", ["joints", "tip"])
def test_the_design_behind_the_data_is_found(search: str, z: str) -> None:
    task = Reacher(z=z)  # pyright: ignore[reportArgumentType]
    true = np.array([2.5, 2.1, 0.66, 1.0, 2.3])  # the paper's arm
    config = dataclasses.replace(THOROUGH, search=search)
    found = derive_design(task, task.design_space, dataset_of(task, true), task.design_space.initial, config, 1)
    assert found.phi == pytest.approx(true, abs=0.05)
    assert found.cost < 0.01


@settings(max_examples=15)
@given(lengths, st.sampled_from(["cma", "gradient"]))
def test_the_search_keeps_to_bounds_and_locks_and_never_gets_worse(true: np.ndarray, search: str) -> None:
    task = Reacher()
    space = task.design_space.with_bound("link_2", 1.0, 1.5).with_lock("link_4", 3.0)
    data = dataset_of(task, true, 32)
    start = space.initial
    before = distance(task, data, start)
    found = derive_design(task, space, data, start, Config(search=search, search_generations=5), 1)
    space.check(found.phi)
    assert found.phi[3] == 3.0
    assert found.cost <= before + 1e-12


@pytest.mark.parametrize("free", [0, 1])
def test_a_search_with_hardly_anything_free_works(free: int) -> None:
    task = make_task("reacher")
    space = task.design_space
    for name in space.names[free:]:
        space = space.with_lock(name, 2.0)
    data = dataset_of(Reacher(), np.array([1.0, 2.0, 2.0, 2.0, 2.0]))
    phi = derive_design(task, space, data, space.initial, Config(), 1).phi
    assert phi == pytest.approx([1.0 if free else 2.0, 2.0, 2.0, 2.0, 2.0], abs=0.03)


@pytest.mark.parametrize("search", ["cma", "drift"])
def test_the_search_is_repeatable(search: str) -> None:
    task, config = Reacher(), Config(search=search)  # pyright: ignore[reportArgumentType]
    data = drift_towards(task, np.full(LINKS, 1.0))
    once, again = (derive_design(task, task.design_space, data, task.design_space.initial, config, 7) for _ in "ab")
    assert np.array_equal(once.phi, again.phi)
    assert (once.cost, once.steps) == (again.cost, again.steps)


@pytest.mark.parametrize("z", ["joints", "tip"])
@pytest.mark.parametrize("true", [[2.5, 2.1, 0.66, 1.0, 2.3], [4.0, 3.5, 3.0, 2.5, 2.0], [3.0, 3.0, 3.0, 3.0, 1.0]])
def test_the_drift_of_another_design_leads_towards_it(true: list[float], z: str) -> None:
    task = Reacher(z=z)  # pyright: ignore[reportArgumentType]
    start, data = task.design_space.initial, drift_towards(task, np.array(true), 256)
    found = derive_design(task, task.design_space, data, start, DRIFT, 1, sigma=0.5)
    went, wanted = found.phi - start, np.array(true) - start
    assert went @ wanted > 0.8 * np.linalg.norm(went) * np.linalg.norm(wanted)
    assert np.linalg.norm(went) <= DRIFT.drift_limit * 0.5 + 1e-9
    assert found.cost < distance(task, data, start)


def test_averaged_over_many_designs_the_drift_gives_away_the_design_itself() -> None:
    task, config = Reacher(), dataclasses.replace(DRIFT, drift_designs=400)
    start = task.design_space.initial
    for change in ([0.2, -0.1, 0.1, -0.2, 0.1], [0.0, 0.0, 0.3, 0.0, 0.0]):
        true = start + np.array(change)
        found = derive_design(task, task.design_space, drift_towards(task, true, 256), start, config, 1)
        assert found.phi == pytest.approx(true, abs=0.07)


@settings(max_examples=15)
@given(lengths, st.floats(0.05, 5.0), st.integers(0, 2**31 - 1))
def test_the_drift_search_keeps_to_bounds_and_locks_and_counts_its_steps(
    true: np.ndarray, sigma: float, seed: int
) -> None:
    task = Reacher()
    space = task.design_space.with_bound("link_1", 1.0, 1.5).with_lock("link_4", 3.0)
    config = Config(search="drift", drift_designs=8)
    found = derive_design(task, space, drift_towards(task, true, 32), space.initial, config, seed, sigma)
    space.check(found.phi)
    assert found.phi[3] == 3.0
    assert found.steps == (config.drift_designs + 1) * 32


def test_without_drift_phi_stays() -> None:
    task = Reacher()
    start = task.design_space.initial
    found = derive_design(task, task.design_space, drift_towards(task, start), start, DRIFT, 1)
    assert found.phi.tolist() == start.tolist()
    assert found.cost == 0


def test_the_drift_search_needs_a_drift() -> None:
    task = Reacher()
    with pytest.raises(ValueError, match="needs the proxy's reference"):
        derive_design(task, task.design_space, dataset_of(task, np.full(5, 1.0)), task.design_space.initial, DRIFT, 1)


def test_a_candidate_that_can_not_be_simulated_is_as_far_as_the_farthest_that_can() -> None:
    task = Brittle()
    data = dataset_of(Reacher(), np.full(LINKS, 2.0), 32)
    space = task.design_space
    found = derive_design(task, space, data, space.initial, Config(search="cma", search_generations=8), 1)
    assert found.phi.max() <= BRITTLE_BEYOND
    assert np.isfinite(found.cost)
    half_lost = derive_design(task, space, drift_towards(task, np.full(LINKS, 2.0)), np.full(LINKS, 4.0), DRIFT, 1)
    space.check(half_lost.phi)
    assert np.isfinite(half_lost.cost)


@pytest.mark.parametrize("search", ["cma", "gradient", "drift"])
def test_the_dataset_holds_the_drift_where_there_is_a_reference(search: str, small: Config) -> None:
    task = make_task("reacher")
    state = start_of_run(task, dataclasses.replace(small, search=search), 0)
    with torch.no_grad():
        next(state.learner.proxy.parameters()).mul_(1.1)
    world = task.hw_phy(state.phi)
    rollout = run_trajectories(task, state, world, small)
    dataset = relabel(rollout, state.learner, 50, state.rng)
    assert np.array_equal(dataset.z, state.learner.proxy.hardware(dataset.s, dataset.a))
    assert (dataset.drift is not None) == (search == "drift")
    if dataset.drift is not None:
        assert state.learner.reference is not None
        assert np.array_equal(dataset.z - dataset.drift, state.learner.reference.hardware(dataset.s, dataset.a))
        assert np.abs(dataset.drift).max() > 0
