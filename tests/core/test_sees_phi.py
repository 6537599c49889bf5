"""Policy and critic that see phi: what they are told of it, and that one policy answers alike wherever it is run."""

import dataclasses
import functools
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from morph_core.checkpoint import load_checkpoint, save_checkpoint
from morph_core.episodes import evaluate
from morph_core.exploration import run_trajectories
from morph_core.history import History
from morph_core.methods.no_hw_opt import NoHwOpt
from morph_core.state import State, start
from morph_core.tasks.reacher import Reacher
from studio.export.policy import policy_at
from tests.core.conftest import make_run, small_method
from tests.core.scales import Scales, linear


@dataclass(frozen=True)
class Seeing(NoHwOpt):
    """A policy that sees phi, on a design that stays."""

    name: ClassVar[str] = "seeing"
    sees_phi: ClassVar[bool] = True


METHOD = Seeing(**vars(small_method("no_hw_opt")))
TASK = Reacher()


def lived(task: Scales | Reacher = TASK, iterations: int = 2) -> State:
    state = start(task, METHOD, 3)
    list(itertools.islice(METHOD.iterations(task, state), iterations))
    return state


@functools.cache
def after_two() -> State:
    """Return a state that no test changes; made by the first that asks, not where this file is imported."""
    return lived()


DESIGNS = st.lists(st.floats(0.05, 5.0), min_size=5, max_size=5).map(np.array)


def test_a_design_is_seen_as_its_place_in_the_tasks_own_box() -> None:
    space = Scales().design_space.with_bound("first", -1.0, 3.0)
    policy = start(Scales(), METHOD, 0, space).control.policy
    seen = policy.phi_seen(np.array([[-20.0, 20.0], [0.0, 10.0]]))
    assert seen.tolist() == [[-1.0, 1.0], [0.0, 0.5]]
    assert seen.dtype == np.float32


def test_a_policy_that_does_not_see_phi_is_itself_at_every_design() -> None:
    policy = start(TASK, small_method("no_hw_opt"), 0).control.policy
    assert policy.at(TASK.design_space.initial) is policy
    assert "hard_box" not in policy.state_dict()
    with pytest.raises(ValueError, match="does not see phi"):
        policy.phi_seen(TASK.design_space.initial)


@given(phi=DESIGNS, seed=st.integers(0, 9))
def test_the_policy_at_a_design_answers_as_the_whole_one_that_sees_it(phi: np.ndarray, seed: int) -> None:
    policy = after_two().control.policy
    observation = np.random.default_rng(seed).standard_normal((7, TASK.observation_size), dtype=np.float32)
    whole = np.concatenate([observation, np.tile(policy.phi_seen(phi), (7, 1))], 1)
    alone = policy.at(phi)
    assert not alone.sees_phi
    assert alone.act(observation, None) == pytest.approx(policy.act(whole, None), abs=1e-5)
    action = torch.zeros(7, TASK.action_size)
    told = policy.log_prob(torch.from_numpy(whole), action)
    assert torch.allclose(alone.log_prob(torch.from_numpy(observation), action), told, atol=1e-4)


def test_making_the_policy_at_a_design_leaves_the_whole_one_as_it_is() -> None:
    policy = after_two().control.policy
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    policy.at(TASK.design_space.initial)
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())


def test_each_episode_sees_its_own_design() -> None:
    state = start(TASK, METHOD, 0)
    designs = np.random.default_rng(0).uniform(2.0, 4.0, (6, 5))
    rollout = run_trajectories(TASK, state, TASK.hw_phy(designs), 6, designs)
    for step in rollout.observation:
        assert np.array_equal(step[:, -5:], state.control.policy.phi_seen(designs))
    assert np.array_equal(rollout.observation[..., :-5], np.stack([TASK.observe(s) for s in rollout.s]))


def test_where_no_designs_are_given_the_present_one_is_seen() -> None:
    state = start(TASK, METHOD, 0)
    state.phi = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    rollout = run_trajectories(TASK, state, TASK.hw_phy(state.phi), 4)
    assert np.array_equal(rollout.observation[0, 0, -5:], state.control.policy.phi_seen(state.phi))


def test_an_evaluation_tells_the_policy_the_design_that_it_is_run_on() -> None:
    state = start(Scales(), METHOD, 0)
    mean = linear([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [0.0, 0.0])
    state.control.policy.mean = torch.nn.Sequential(mean)
    phi = np.array([10.0, -5.0])
    _, rollout = evaluate(Scales(), state.control.policy, phi, 3, np.random.default_rng(0), sampled=False)
    assert np.unique(rollout.action.reshape(-1, 2), axis=0).tolist() == [[0.5, -0.25]]


def test_policies_that_start_afresh_see_phi_too() -> None:
    state = start(TASK, METHOD, 0)
    state.control.begin_again(state, 1)
    assert state.control.policy.sees_phi
    assert len(list(itertools.islice(METHOD.iterations(TASK, state), 1))) == 1


def test_it_goes_on_from_a_checkpoint_bit_for_bit(tmp_path: Path) -> None:
    state, folder = lived(), make_run(tmp_path)
    save_checkpoint(folder, state, 0.0)
    loaded, _ = load_checkpoint(folder, 2, TASK, METHOD)
    ahead, behind = (list(itertools.islice(METHOD.iterations(TASK, s), 2)) for s in (state, loaded))
    assert ahead == behind
    for name, value in state.control.policy.state_dict().items():
        assert torch.equal(loaded.control.policy.state_dict()[name], value)


def test_the_exported_policy_answers_as_the_trained_one_at_the_design(tmp_path: Path) -> None:
    state, folder = lived(), make_run(tmp_path)
    save_checkpoint(folder, state, 0.0)
    observation = np.random.default_rng(1).standard_normal((9, TASK.observation_size), dtype=np.float32)
    answers = []
    for phi in (state.phi, state.phi * 0.4):
        exported = policy_at(History(folder), 2, phi)
        assert exported is not None
        assert exported.weights[0].shape == (METHOD.hidden, TASK.observation_size)
        answers.append(exported.act(observation, None))
        assert answers[-1] == pytest.approx(state.control.policy.at(phi).act(observation, None), abs=1e-6)
    assert np.abs(answers[0] - answers[1]).max() > 1e-3


def test_the_critic_sees_phi() -> None:
    state = start(TASK, dataclasses.replace(METHOD, trajectories=4), 0)
    rollout = run_trajectories(TASK, state, TASK.hw_phy(state.phi), 4)
    seen = torch.from_numpy(rollout.observation[0])
    other = seen.clone()
    other[:, -1] += 1
    time = torch.zeros(4)
    assert not torch.equal(state.control.critic(seen, time), state.control.critic(other, time))
