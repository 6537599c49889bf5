"""What lives between iterations: the search's memory, the steps counted, a start from the seed alone."""

import copy

import numpy as np
import pytest
import torch

from morph_core.catalogue import make_task
from morph_core.hw_nn import HwNN
from morph_core.search import Memory
from morph_core.state import State, start
from morph_core.twin import Twin
from tests.core.conftest import SMALL, small_method

TASK = make_task("reacher")
DRIFT = small_method("morph", {"search": "drift"})


def twin_of(state: State) -> Twin:
    assert isinstance(state.memory, Twin)
    return state.memory


@pytest.fixture
def drifted() -> State:
    """A state whose proxy and reference have each gone their own way, their optimisers too."""
    state = start(TASK, DRIFT, 0)
    for hw_nn, target in ((state.hw_nn, 1.0), (twin_of(state).reference, -1.0)):
        for _ in range(3):
            hw_nn.optimizer.zero_grad()
            ((hw_nn.proxy(torch.ones(4, TASK.proxy_input_size)) - target) ** 2).mean().backward()
            hw_nn.optimizer.step()
    return state


def weights(hw_nn: HwNN) -> list[list[float]]:
    return [p.detach().flatten().tolist() for p in hw_nn.proxy.parameters()]


def moments(hw_nn: HwNN) -> list[dict[str, list[float]]]:
    state = hw_nn.optimizer.state_dict()["state"]
    return [{name: value.flatten().tolist() for name, value in state[i].items()} for i in sorted(state)]


@pytest.mark.parametrize("search", ["cma", "gradient"])
def test_only_the_drift_search_has_a_reference(search: str) -> None:
    state = start(TASK, small_method("morph", {"search": search}), 0)
    before = weights(state.hw_nn)
    state.memory.proxy_was_fitted(state.hw_nn)
    state.memory.phi_was_found(state.hw_nn)
    assert type(state.memory) is Memory
    assert "reference" not in {**state.modules, **state.optimizers}
    assert weights(state.hw_nn) == before


def test_the_reference_begins_as_the_proxys_twin() -> None:
    state = start(TASK, DRIFT, 0)
    assert weights(state.hw_nn) == weights(twin_of(state).reference)
    assert set(state.modules) == {"policy", "critic", "proxy", "reference"}
    assert set(state.optimizers) == {"control", "proxy", "reference"}


@pytest.mark.parametrize("method", ["cmaes_rl", "direct", "no_hw_opt", "value_gradient"])
def test_a_method_without_a_proxy_has_none(method: str) -> None:
    state = start(TASK, small_method(method), 0)
    assert set(state.modules) == {"policy", "critic"}
    assert set(state.optimizers) == {"control"}
    with pytest.raises(ValueError, match="no proxy"):
        _ = state.hw_nn


def test_the_reference_takes_nothing_from_the_rest_of_the_seed() -> None:
    with_reference, without = start(TASK, DRIFT, 5), start(TASK, SMALL, 5)
    assert weights(with_reference.hw_nn) == weights(without.hw_nn)
    assert with_reference.rng.random() == without.rng.random()


def test_paired_the_reference_is_the_proxy(drifted: State) -> None:
    proxy = weights(drifted.hw_nn)
    assert proxy != weights(twin_of(drifted).reference)
    drifted.memory.proxy_was_fitted(drifted.hw_nn)
    assert weights(drifted.hw_nn) == weights(twin_of(drifted).reference) == proxy


def test_settled_the_proxy_is_the_reference_with_its_momentum_but_not_the_same_object(drifted: State) -> None:
    hw_nn, reference = drifted.hw_nn, twin_of(drifted).reference
    learnt = weights(reference)
    assert moments(hw_nn) != moments(reference)
    drifted.memory.phi_was_found(hw_nn)
    assert weights(hw_nn) == weights(reference) == learnt
    kept = copy.deepcopy(moments(reference))
    assert moments(hw_nn) == kept
    hw_nn.optimizer.zero_grad()
    hw_nn.proxy(torch.ones(4, TASK.proxy_input_size)).sum().backward()
    hw_nn.optimizer.step()
    assert weights(reference) == learnt
    assert moments(reference) == kept


def test_the_start_is_the_initial_design_inside_the_given_space() -> None:
    space = TASK.design_space.with_bound("link_1", 0.5, 1.5).with_lock("link_2", 2.0)
    state = start(TASK, SMALL, 0, space)
    assert state.phi.tolist() == [1.5, 2.0, 3.0, 3.0, 3.0]
    assert (state.iteration, state.env_steps, state.diverged) == (0, 0, 0)
    assert (state.relabelled_steps, state.search_steps) == (0, 0)
    assert np.isfinite(state.alpha)
