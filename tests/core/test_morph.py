"""Algorithm 1 and its baselines as generators: what they yield, what they obey."""

import copy
import itertools
from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from morph_core.catalogue import METHODS, make_method, make_task
from morph_core.checkpoint import damage_of
from morph_core.divergence import divergence
from morph_core.hw_nn import cosine_by_parameter
from morph_core.protocol import Progress
from morph_core.state import start
from tests.core.conftest import SMALL, Fragile, small_method, small_morph

TASK = make_task("reacher")


def run(method: str, iterations: int, seed: int = 0, settings: Mapping[str, object] | None = None) -> list[Progress]:
    chosen = small_method(method, settings)
    return list(itertools.islice(chosen.iterations(TASK, start(TASK, chosen, seed)), iterations))


def same_weights(first: nn.Module, second: nn.Module) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))


@pytest.mark.parametrize("method", sorted(METHODS))
def test_a_method_yields_one_progress_per_iteration_and_repeats_itself(method: str) -> None:
    once, again = run(method, 3), run(method, 3)
    assert [p.iteration for p in once] == [1, 2, 3]
    assert [p.phi for p in once] == [p.phi for p in again]
    assert once[-1].env_steps == 3 * SMALL.trajectories * TASK.horizon
    for progress in once:
        TASK.design_space.check(progress.phi)


def test_seeds_differ() -> None:
    assert run("morph", 2, seed=0)[-1].phi != run("morph", 2, seed=1)[-1].phi


def test_morph_and_direct_move_phi_and_no_hw_opt_does_not() -> None:
    initial = TASK.design_space.initial.tolist()
    assert run("morph", 2)[-1].phi != initial
    assert run("direct", 2)[-1].phi != initial
    assert run("no_hw_opt", 2)[-1].phi == initial


@pytest.mark.parametrize("exploration", ["gaussian", "gaussian_iid"])
def test_the_gaussian_exploration_runs_in_the_proxys_world(exploration: str) -> None:
    progress = run("morph", 2, settings={"exploration": exploration})[-1]
    assert progress.design_sigma is None
    assert progress.cosine is not None
    assert np.isfinite(progress.episode_return)


@pytest.mark.parametrize("z", ["joints", "tip"])
@pytest.mark.parametrize("exploration", ["design", "gaussian", "gaussian_iid"])
def test_every_z_and_exploration_go_together(z: str, exploration: str) -> None:
    task = make_task("reacher", {"z": z, "tunnel": "paper"})
    method = small_method("morph", {"exploration": exploration})
    progress = next(method.iterations(task, start(task, method, 0)))
    assert np.isfinite(progress.divergence or np.nan)
    assert len(progress.cosine_by_parameter or []) == 5


def test_phi_is_searched_for_every_k_iterations() -> None:
    costs = [p.search_cost for p in run("morph", 6, settings={"design_interval": 3})]
    assert [c is not None for c in costs] == [False, False, True, False, False, True]


def test_locks_and_bounds_hold_while_the_caller_edits_the_state() -> None:
    state = start(TASK, SMALL, 0)
    iterations = SMALL.iterations(TASK, state)
    next(iterations)
    state.design_space = state.design_space.with_lock("link_1", 2.0).with_bound("link_2", 0.5, 0.9)
    state.phi = state.design_space.clip(state.phi)
    for progress in itertools.islice(iterations, 3):
        assert progress.phi[0] == 2.0
        assert 0.5 <= progress.phi[1] <= 0.9


def test_an_edited_alpha_is_in_force_in_the_next_iteration() -> None:
    state = start(TASK, SMALL, 0)
    iterations = SMALL.iterations(TASK, state)
    assert next(iterations).alpha == 1.0
    state.alpha = 50.0
    heavy = next(iterations)
    assert heavy.alpha == 50.0


def test_the_prefit_brings_the_proxy_to_hw_phy() -> None:
    state = start(TASK, small_method("morph", {"hidden": 64, "proxy.prefit": 300}), 0)
    s, a = TASK.sample_pairs(256, np.random.default_rng(1))
    true = TASK.hw_phy(state.phi)(s, a)

    def error() -> float:
        return float(divergence(state.hw_nn(s, a), true))

    before = error()
    state.fit_proxy(TASK)
    assert state.fitted
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


def test_by_drift_the_proxy_is_paired_with_a_reference_and_settles_after_each_search() -> None:
    method = small_morph({"search": "drift", "design_interval": 2, "search.designs": 8})
    state = start(TASK, method, 0)
    iterations = method.iterations(TASK, state)
    assert next(iterations).search_cost is None
    proxy, reference = state.modules["proxy"], state.modules["reference"]
    assert not same_weights(proxy, reference)  # the task has drawn one of them
    second = next(iterations)
    assert second.search_cost is not None
    assert second.phi != TASK.design_space.initial.tolist()
    assert same_weights(proxy, reference)
    searched = (8 + 1) * method.search.pairs
    assert state.search_steps == searched
    assert state.relabelled_steps == method.proxy.prefit * method.proxy.prefit_pairs + state.env_steps


@pytest.mark.parametrize("method", ["morph", "direct"])
def test_where_phi_is_frozen_it_stays_and_every_episode_runs_on_it(method: str) -> None:
    chosen = small_method(method)
    state = start(TASK, chosen, 0)
    iterations = chosen.iterations(TASK, state)
    progress = [next(iterations), next(iterations)]
    state.frozen = True
    progress += itertools.islice(iterations, 3)
    assert progress[0].phi != progress[1].phi == progress[2].phi == progress[4].phi
    assert [p.design_sigma for p in progress[2:]] == [0.0] * 3
    assert state.explored is not None
    assert (state.explored == state.phi).all()


@pytest.mark.parametrize(("success", "frozen"), [(0.5, True), (0.49, False)])
def test_phi_is_frozen_once_enough_trajectories_succeed(success: float, frozen: bool) -> None:
    state = start(TASK, SMALL, 0)
    rollout = SimpleNamespace(steps=1, diverged=0, seconds=0.0, success_rate=success, mean_return=0.0)
    state.advance(1, rollout, freeze_success=0.5)  # pyright: ignore[reportArgumentType]
    assert state.frozen == frozen
    rollout = SimpleNamespace(steps=1, diverged=0, seconds=0.0, success_rate=0.0, mean_return=0.0)
    state.advance(2, rollout, freeze_success=0.5)  # pyright: ignore[reportArgumentType]
    assert state.frozen == frozen  # it does not thaw by itself


@pytest.mark.parametrize("method", sorted(METHODS))
def test_a_policy_that_reaches_no_milestone_starts_afresh_and_phi_stays(method: str) -> None:
    task = make_task("pen_press", {"initial_length": 0.05})  # these fingers reach nothing
    quick = {"proxy.prefit": 1, "proxy.pairs": 64, "design_interval": 10} if method == "morph" else {}
    chosen = small_method(method, {"ppo.restart_interval": 2, **quick})
    state = start(task, chosen, 0)
    iterations = chosen.iterations(task, state)
    next(iterations)
    learnt = state.control.policy
    assert (state.control_start, state.last_reached) == (0, 0)
    next(iterations)
    assert state.control.policy is not learnt
    assert (state.control_start, state.last_reached) == (2, 2)
    next(iterations)
    assert not damage_of(state)


@pytest.mark.parametrize("method", sorted(METHODS))
def test_a_method_learns_from_the_episodes_that_could_be_simulated(method: str) -> None:
    task, chosen = Fragile(), small_method(method, {"trajectories": 32, "ppo.std": 1.0})
    state = start(task, chosen, 0)
    before = copy.deepcopy(state.control.policy.state_dict())
    progress = list(itertools.islice(chosen.iterations(task, state), 4))
    assert 0 < state.diverged < 4 * 32
    assert all(np.isfinite(p.episode_return) for p in progress)
    assert any(not torch.equal(before[name], weights) for name, weights in state.control.policy.state_dict().items())
    assert not damage_of(state)


@pytest.mark.parametrize("limit", [0.0, 0.06])
@pytest.mark.parametrize("method", sorted({*METHODS} - {"cmaes_rl"}))  # which begins a candidate all the same
def test_an_iteration_that_leaves_no_two_episodes_is_skipped(method: str, limit: float) -> None:
    task, chosen = Fragile(limit=limit), small_method(method, {"proxy.prefit": 0} if method == "morph" else {})
    state = start(task, chosen, 0)
    before = copy.deepcopy({name: module.state_dict() for name, module in state.modules.items()})
    progress = list(itertools.islice(chosen.iterations(task, state), 3))
    assert [p.iteration for p in progress] == [1, 2, 3]
    assert state.diverged == 3 * chosen.trajectories
    assert progress[-1].env_steps == state.env_steps >= state.diverged
    assert [(p.success, p.episode_return, p.phi) for p in progress] == [(0.0, 0.0, state.phi.tolist())] * 3
    for name, module in state.modules.items():
        assert all(torch.equal(before[name][key], value) for key, value in module.state_dict().items())


def test_weights_come_from_the_seed_alone() -> None:
    torch.manual_seed(1)
    first = start(TASK, SMALL, 3).control.policy.state_dict()
    torch.manual_seed(2)
    second = start(TASK, SMALL, 3).control.policy.state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.slow
def test_morph_finds_an_arm_that_reaches_the_goal() -> None:
    from morph_core.episodes import evaluate

    method = make_method("morph", TASK)
    state = start(TASK, method, 0)
    for progress in method.iterations(TASK, state):
        if progress.env_steps >= 0.7e6:
            break
    score, _ = evaluate(TASK, state.control.policy, state.phi, 128, np.random.default_rng(1), sampled=True)
    assert score.success >= 0.9
