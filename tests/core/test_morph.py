"""Algorithm 1 and its baselines as generators: what they yield, what they obey."""

import copy
import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from morph_core.objective import cosine_by_parameter, fit_proxy
from torch import nn

from morph_core.catalogue import make_task
from morph_core.checkpoint import all_finite
from morph_core.config import Config
from morph_core.protocol import Progress
from morph_core.state import State, start
from morph_core.train import METHODS
from tests.core.conftest import Fragile

TASK = make_task("reacher")
PREFIT_PAIRS = 512
"""Of each supervised step that fits the proxy before line 1."""


def run(method: str, config: Config, iterations: int, state: State | None = None, seed: int = 0) -> list[Progress]:
    state = state or start(TASK, config, seed)
    return list(itertools.islice(METHODS[method](TASK, config, state), iterations))


def same_weights(first: nn.Module, second: nn.Module) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))


@pytest.mark.parametrize("method", sorted(METHODS))
def test_a_method_yields_one_progress_per_iteration_and_repeats_itself(method: str, small: Config) -> None:
    once, again = run(method, small, 3), run(method, small, 3)
    assert [p.iteration for p in once] == [1, 2, 3]
    assert [p.phi for p in once] == [p.phi for p in again]
    assert once[-1].env_steps == 3 * small.trajectories * TASK.horizon
    for progress in once:
        TASK.design_space.check(progress.phi)


def test_seeds_differ(small: Config) -> None:
    assert run("morph", small, 2, seed=0)[-1].phi != run("morph", small, 2, seed=1)[-1].phi


def test_morph_and_direct_move_phi_and_no_hw_opt_does_not(small: Config) -> None:
    initial = TASK.design_space.initial.tolist()
    assert run("morph", small, 2)[-1].phi != initial
    assert run("direct", small, 2)[-1].phi != initial
    assert run("no_hw_opt", small, 2)[-1].phi == initial


def test_the_gaussian_exploration_runs_in_the_proxys_world(small: Config) -> None:
    progress = run("morph", dataclasses.replace(small, exploration="gaussian"), 2)[-1]
    assert progress.design_sigma is None
    assert progress.cosine is not None
    assert np.isfinite(progress.episode_return)


@pytest.mark.parametrize("z", ["joints", "tip"])
@pytest.mark.parametrize("exploration", ["design", "gaussian"])
def test_every_z_and_exploration_go_together(z: str, exploration: str, small: Config) -> None:
    task = make_task("reacher", {"z": z, "tunnel": "paper"})
    config = dataclasses.replace(small, exploration=exploration)
    progress = next(METHODS["morph"](task, config, start(task, config, 0)))
    assert np.isfinite(progress.divergence or np.nan)
    assert len(progress.cosine_by_parameter or []) == 5


def test_phi_is_searched_for_every_k_iterations(small: Config) -> None:
    costs = [p.search_cost for p in run("morph", dataclasses.replace(small, design_interval=3), 6)]
    assert [c is not None for c in costs] == [False, False, True, False, False, True]


def test_locks_and_bounds_hold_while_the_caller_edits_the_state(small: Config) -> None:
    state = start(TASK, small, 0)
    iterations = METHODS["morph"](TASK, small, state)
    next(iterations)
    state.design_space = state.design_space.with_lock("link_1", 2.0).with_bound("link_2", 0.5, 0.9)
    state.phi = state.design_space.clip(state.phi)
    for progress in itertools.islice(iterations, 3):
        assert progress.phi[0] == 2.0
        assert 0.5 <= progress.phi[1] <= 0.9


def test_an_edited_alpha_is_in_force_in_the_next_iteration(small: Config) -> None:
    state = start(TASK, small, 0)
    iterations = METHODS["morph"](TASK, small, state)
    assert next(iterations).alpha == 1.0
    state.alpha = 50.0
    heavy = next(iterations)
    assert heavy.alpha == 50.0


def test_the_prefit_brings_the_proxy_to_hw_phy(small: Config) -> None:
    config = dataclasses.replace(small, hidden=64, proxy_prefit=300)
    state = start(TASK, config, 0)
    s, a = TASK.sample_pairs(256, np.random.default_rng(1))
    true = TASK.hw_phy(state.phi)(s, a)

    def error() -> float:
        return float(((state.learner.proxy.hardware(s, a) - true) ** 2).sum(-1).mean())

    before = error()
    fit_proxy(TASK, state, config)
    assert error() < 0.02 * before


def test_the_cosine_of_a_parameter_is_that_along_what_it_moves() -> None:
    s, a = TASK.sample_pairs(16, np.random.default_rng(0))
    arm = TASK.hw_phy(TASK.design_space.initial)
    direction = arm.jacobian(s, a)[..., 2]  # pyright: ignore[reportAttributeAccessIssue] - it is differentiable
    agreeing = cosine_by_parameter(arm, s, a, direction, direction)
    opposed = cosine_by_parameter(arm, s, a, -direction, direction)
    assert agreeing is not None
    assert opposed is not None
    assert agreeing[2] == pytest.approx(1.0)
    assert opposed[2] == pytest.approx(-1.0)
    assert cosine_by_parameter(arm, s, a, 0 * direction, direction) == [None] * 5
    assert cosine_by_parameter(lambda s, _: s, s, a, direction, direction) is None


def test_by_drift_the_proxy_is_paired_with_a_reference_and_settles_after_each_search(small: Config) -> None:
    config = dataclasses.replace(small, search="drift", design_interval=2, drift_designs=8)
    state = start(TASK, config, 0)
    iterations = METHODS["morph"](TASK, config, state)
    assert next(iterations).search_cost is None
    proxy, reference = state.learner.modules["proxy"], state.learner.modules["reference"]
    assert not same_weights(proxy, reference)  # the task has drawn one of them
    second = next(iterations)
    assert second.search_cost is not None
    assert second.phi != TASK.design_space.initial.tolist()
    assert same_weights(proxy, reference)
    searched = (config.drift_designs + 1) * config.search_pairs
    assert state.relabelled_steps == config.proxy_prefit * PREFIT_PAIRS + state.env_steps + searched


@pytest.mark.parametrize("method", ["morph", "direct"])
def test_where_phi_is_frozen_it_stays_and_every_episode_runs_on_it(method: str, small: Config) -> None:
    state = start(TASK, small, 0)
    iterations = METHODS[method](TASK, small, state)
    progress = [next(iterations), next(iterations)]
    state.frozen = True
    progress += itertools.islice(iterations, 3)
    assert progress[0].phi != progress[1].phi == progress[2].phi == progress[4].phi
    assert [p.design_sigma for p in progress[2:]] == [0.0] * 3
    assert state.explored is not None
    assert (state.explored == state.phi).all()


@pytest.mark.parametrize(("success", "frozen"), [(0.5, True), (0.49, False)])
def test_phi_is_frozen_once_enough_trajectories_succeed(success: float, frozen: bool, small: Config) -> None:
    state = start(TASK, small, 0)
    rollout = SimpleNamespace(steps=1, diverged=0, success_rate=success)
    state.advance(1, rollout, dataclasses.replace(small, freeze_success=0.5))  # pyright: ignore
    assert state.frozen == frozen
    state.advance(2, SimpleNamespace(steps=1, diverged=0, success_rate=0.0), small)  # pyright: ignore
    assert state.frozen == frozen  # it does not thaw by itself


@pytest.mark.parametrize("method", sorted(METHODS))
def test_a_policy_that_reaches_no_milestone_starts_afresh_and_phi_stays(method: str, small: Config) -> None:
    task = make_task("pen_press", {"initial_length": 0.05})  # these fingers reach nothing
    config = dataclasses.replace(small, proxy_prefit=1, proxy_pairs=64, design_interval=10, restart_interval=2)
    state = start(task, config, 0)
    iterations = METHODS[method](task, config, state)
    next(iterations)
    learnt = state.learner.policy
    assert (state.control_start, state.last_reached) == (0, 0)
    next(iterations)
    assert state.learner.policy is not learnt
    assert (state.control_start, state.last_reached) == (2, 2)
    next(iterations)
    assert all_finite(state)


@pytest.mark.parametrize("method", sorted(METHODS))
def test_a_method_learns_from_the_episodes_that_could_be_simulated(method: str, small: Config) -> None:
    task, config = Fragile(), dataclasses.replace(small, trajectories=32, policy_std=1.0)
    state = start(task, config, 0)
    before = copy.deepcopy(state.learner.policy.state_dict())
    progress = list(itertools.islice(METHODS[method](task, config, state), 4))
    assert 0 < state.diverged < 4 * 32
    assert all(np.isfinite(p.episode_return) for p in progress)
    assert any(not torch.equal(before[name], weights) for name, weights in state.learner.policy.state_dict().items())
    assert all_finite(state)


@pytest.mark.parametrize("limit", [0.0, 0.06])
@pytest.mark.parametrize("method", sorted(METHODS))
def test_an_iteration_that_leaves_no_two_episodes_is_skipped(method: str, limit: float, small: Config) -> None:
    task, config = Fragile(limit=limit), dataclasses.replace(small, proxy_prefit=0)
    state = start(task, config, 0)
    before = copy.deepcopy({name: module.state_dict() for name, module in state.learner.modules.items()})
    progress = list(itertools.islice(METHODS[method](task, config, state), 3))
    assert [p.iteration for p in progress] == [1, 2, 3]
    assert state.diverged == 3 * config.trajectories
    assert progress[-1].env_steps == state.env_steps >= state.diverged
    assert [(p.success, p.episode_return, p.phi) for p in progress] == [(0.0, 0.0, state.phi.tolist())] * 3
    for name, module in state.learner.modules.items():
        assert all(torch.equal(before[name][key], value) for key, value in module.state_dict().items())


def test_weights_come_from_the_seed_alone(small: Config) -> None:
    torch.manual_seed(1)
    first = start(TASK, small, 3).learner.policy.state_dict()
    torch.manual_seed(2)
    second = start(TASK, small, 3).learner.policy.state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.slow
def test_morph_finds_an_arm_that_reaches_the_goal() -> None:
    from morph_core.episodes import evaluate

    state = start(TASK, TASK.config, 0)
    for progress in METHODS["morph"](TASK, TASK.config, state):
        if progress.env_steps >= 0.7e6:
            break
    score, _ = evaluate(TASK, state.learner.policy, state.phi, 128, np.random.default_rng(1), sampled=True)
    assert score.success >= 0.9
