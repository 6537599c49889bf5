"""What lives between iterations: the proxy's reference, the steps counted, a start from the seed alone."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from morph_core.catalogue import make_task
from morph_core.config import Config
from morph_core.networks import Proxy
from morph_core.state import Learner, start

TASK = make_task("reacher")


@pytest.fixture
def drifted(small: Config) -> Learner:
    """A learner whose proxy and reference have each gone their own way, their optimisers too."""
    learner = start(TASK, dataclasses.replace(small, search="drift"), 0).learner
    assert learner.reference is not None
    assert learner.reference_optimizer is not None
    for network, optimizer, target in (
        (learner.proxy, learner.proxy_optimizer, 1.0),
        (learner.reference, learner.reference_optimizer, -1.0),
    ):
        for _ in range(3):
            optimizer.zero_grad()
            ((network(torch.ones(4, TASK.proxy_input_size)) - target) ** 2).mean().backward()
            optimizer.step()
    return learner


def weights(network: Proxy | None) -> list[list[float]]:
    assert network is not None
    return [p.detach().flatten().tolist() for p in network.parameters()]


def moments(optimizer: torch.optim.Adam | None) -> list[dict[str, list[float]]]:
    assert optimizer is not None
    state = optimizer.state_dict()["state"]
    return [{name: value.flatten().tolist() for name, value in state[i].items()} for i in sorted(state)]


@pytest.mark.parametrize("search", ["cma", "gradient"])
def test_only_the_drift_search_has_a_reference(small: Config, search: str) -> None:
    learner = start(TASK, dataclasses.replace(small, search=search), 0).learner
    before = weights(learner.proxy)
    learner.pair()
    learner.settle()
    assert "reference" not in learner.modules | learner.optimizers
    assert weights(learner.proxy) == before


def test_the_reference_begins_as_the_proxys_twin(small: Config) -> None:
    learner = start(TASK, dataclasses.replace(small, search="drift"), 0).learner
    assert weights(learner.proxy) == weights(learner.reference)
    assert set(learner.modules) == {"policy", "critic", "proxy", "reference"}
    assert set(learner.optimizers) == {"control", "proxy", "reference"}


def test_the_reference_takes_nothing_from_the_rest_of_the_seed(small: Config) -> None:
    with_reference, without = (start(TASK, dataclasses.replace(small, search=s), 5) for s in ("drift", "cma"))
    assert weights(with_reference.learner.proxy) == weights(without.learner.proxy)
    assert with_reference.rng.random() == without.rng.random()


def test_paired_the_reference_is_the_proxy(drifted: Learner) -> None:
    proxy = weights(drifted.proxy)
    assert proxy != weights(drifted.reference)
    drifted.pair()
    assert weights(drifted.proxy) == weights(drifted.reference) == proxy


def test_settled_the_proxy_is_the_reference_with_its_momentum_but_not_the_same_object(drifted: Learner) -> None:
    reference = weights(drifted.reference)
    assert moments(drifted.proxy_optimizer) != moments(drifted.reference_optimizer)
    drifted.settle()
    assert weights(drifted.proxy) == weights(drifted.reference) == reference
    kept = copy.deepcopy(moments(drifted.reference_optimizer))
    assert moments(drifted.proxy_optimizer) == kept
    drifted.proxy_optimizer.zero_grad()
    drifted.proxy(torch.ones(4, TASK.proxy_input_size)).sum().backward()
    drifted.proxy_optimizer.step()
    assert weights(drifted.reference) == reference
    assert moments(drifted.reference_optimizer) == kept


def test_the_start_is_the_initial_design_inside_the_given_space(small: Config) -> None:
    space = TASK.design_space.with_bound("link_1", 0.5, 1.5).with_lock("link_2", 2.0)
    state = start(TASK, small, 0, space)
    assert state.phi.tolist() == [1.5, 2.0, 3.0, 3.0, 3.0]
    assert (state.iteration, state.env_steps, state.relabelled_steps, state.diverged) == (0, 0, 0, 0)
    assert np.isfinite(state.alpha)
