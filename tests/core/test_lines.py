"""The methods as sequences of iterations: what happens when, what stands still, and what is counted."""

import itertools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pytest
import torch

from morph_core.design import DesignSpace
from morph_core.explorations.design import Design
from morph_core.method import Method
from morph_core.methods.direct import Direct
from morph_core.methods.no_hw_opt import NoHwOpt
from morph_core.parts import Ppo, ProxyFit, Schedule
from morph_core.protocol import Progress
from morph_core.search import Problem, Search
from morph_core.searches.drift import Drift
from morph_core.spread import ExploredDesigns
from morph_core.state import State, start
from tests.core.scales import TINY, Scales, replaced, tensor, trajectories

DIRECT = Direct(
    trajectories=2, hidden=4, ppo=TINY.ppo, step=1.5, schedule=Schedule(11),
    designs=ExploredDesigns(sigma=1.0, sigma_end=0.25),
)  # fmt: skip
ALONE = NoHwOpt(trajectories=8, hidden=4, ppo=TINY.ppo)


def run(method: Method, iterations: int, state: State, task: Scales | None = None) -> list[Progress]:
    return list(itertools.islice(method.iterations(task or Scales(), state), iterations))


def begun(method: Method, **given: Any) -> State:
    return start(Scales(), method, 0, **given)


# --- when phi is searched for ---


@pytest.mark.parametrize("interval", [1, 2, 3])
def test_phi_is_searched_for_with_every_kth_iteration(interval: int) -> None:
    progress = run(replaced(design_interval=interval), 6, begun(TINY))
    assert [p.search_cost is not None for p in progress] == [i % interval == 0 for i in range(1, 7)]
    moved = [a.phi != b.phi for a, b in itertools.pairwise(progress)]
    assert moved == [i % interval == 0 for i in range(2, 7)]


def test_a_run_that_goes_on_counts_its_intervals_from_the_first_iteration() -> None:
    method = replaced(design_interval=3)
    state = begun(method)
    run(method, 2, state)
    assert [p.search_cost is not None for p in run(method, 2, state)] == [True, False]


def test_a_search_gets_the_spread_of_its_iteration_and_as_many_pairs_as_it_asks_for() -> None:
    @dataclass(frozen=True)
    class Watching(Search):
        name = "watching"

        def candidates(self, problem: Problem) -> np.ndarray:
            seen.append(problem)
            return problem.start[None]

    seen: list[Problem] = []
    method = replaced(search=Watching(pairs=5), exploration=Design(sigma=1.6, sigma_end=0.4), schedule=Schedule(11))
    state = begun(method)
    progress = run(method, 6, state)
    assert [len(problem.dataset.s) for problem in seen] == [5] * 6
    assert [problem.spread.sigma for problem in seen] == [p.design_sigma for p in progress]
    assert progress[-1].design_sigma == pytest.approx(0.8)
    # the dataset's z is what the proxy said after its step; nothing has touched it since
    assert np.array_equal(seen[-1].dataset.z, state.hw_nn(seen[-1].dataset.s, seen[-1].dataset.a))


# --- frozen ---


@pytest.mark.parametrize("method", [TINY, DIRECT])
def test_frozen_phi_stands_still_and_every_episode_runs_on_it(method: Method) -> None:
    state = begun(method)
    run(method, 1, state)
    state.frozen = True
    phi = state.phi.tolist()
    for progress in run(method, 3, state):
        assert progress.phi == phi
        assert progress.design_sigma == 0.0
        assert progress.search_cost is None
        assert state.explored is not None
        assert (state.explored == phi).all()


@pytest.mark.parametrize(
    ("share", "wanted", "frozen"), [(0.5, 0.5, True), (0.5, 0.6, False), (1.0, 1.0, True), (0.5, 0.0, False)]
)
@pytest.mark.parametrize("kind", [TINY, DIRECT])
def test_phi_is_frozen_once_enough_trajectories_succeed(kind: Any, share: float, wanted: float, frozen: bool) -> None:
    method = replaced(kind, freeze_success=wanted)
    state = begun(method)
    (progress,) = run(method, 1, state, Scales(ends=2, succeeding=share))
    assert progress.success == share
    assert state.frozen is frozen
    run(method, 1, state)  # nobody succeeds any more
    assert state.frozen is frozen


@pytest.mark.parametrize(("finish", "rests"), [("policy_and_proxy", False), ("policy", True)])
def test_once_phi_is_frozen_the_proxy_learns_on_or_rests_without_a_step_of_relabelling(
    finish: Literal["policy_and_proxy", "policy"], rests: bool
) -> None:
    method = replaced(exploration=Design(finish=finish))
    state = begun(method)
    run(method, 1, state)

    def weights(name: str) -> list[np.ndarray]:
        return [weight.detach().numpy().copy() for weight in state.modules[name].parameters()]

    for frozen in (False, True):
        state.frozen = frozen
        before, steps = {name: weights(name) for name in ("policy", "proxy")}, state.relabelled_steps
        (progress,) = run(method, 1, state)
        resting = frozen and rests
        same = {name: all(map(np.array_equal, before[name], weights(name))) for name in before}
        assert same == {"policy": False, "proxy": resting}
        assert (state.relabelled_steps == steps) is resting
        assert (progress.divergence is None) is resting
        assert (progress.design_sigma == 0.0) is frozen


# --- what an iteration counts ---


def test_steps_are_counted_by_where_they_were_taken() -> None:
    method = replaced(proxy=ProxyFit(prefit=3, prefit_pairs=10, pairs=5))
    state = begun(method)
    (first,) = run(method, 1, state)
    steps, searched = 8 * 3, (4 * 2 + 2) * 16
    assert (state.iteration, state.env_steps, first.env_steps) == (1, steps, steps)
    assert (state.relabelled_steps, state.search_steps) == (3 * 10 + 5, searched)
    run(method, 1, state)
    assert (state.iteration, state.env_steps) == (2, 2 * steps)
    assert (state.relabelled_steps, state.search_steps) == (3 * 10 + 2 * 5, 2 * searched)


def test_steps_after_an_episodes_end_are_not_counted() -> None:
    state = begun(ALONE)
    run(ALONE, 1, state, Scales(ends=2, succeeding=0.5))
    assert state.env_steps == 4 * 2 + 4 * 3


def test_progress_says_what_the_trajectories_were() -> None:
    state = begun(ALONE)
    (progress,) = run(ALONE, 1, state, Scales(ends=1, succeeding=0.25))
    assert progress.episode_return == pytest.approx(4 * (2 * 1 + 6 * 3) / 8)  # phi is (2, 2): 4 a step
    assert progress.success == 0.25
    assert progress.phi == [2.0, 2.0]
    assert progress.policy_std == pytest.approx(state.control.policy.mean_std)
    assert (progress.divergence, progress.alpha, progress.design_sigma, progress.search_cost) == (None,) * 4


def test_progress_says_which_alpha_and_projection_were_in_force() -> None:
    state = begun(TINY)
    iterations = TINY.iterations(Scales(), state)
    first = next(iterations)
    state.alpha, state.projection = 7.0, "one_sided"
    second = next(iterations)
    assert [(p.alpha, p.projection) for p in (first, second)] == [(1.0, "none"), (7.0, "one_sided")]


@pytest.mark.parametrize(("alpha", "projection"), [(50.0, "none"), (0.0, "none"), (1.0, "as_printed")])
def test_what_a_user_sets_changes_what_is_learnt(alpha: float, projection: Any) -> None:
    def proxy_after(state: State) -> torch.Tensor:
        state.phi = np.array([-2.0, -2.0])  # Hw-Phy draws the untrained proxy down, the returns draw it up
        assert run(method, 2, state)[0].cosine_negative == 1.0
        return torch.cat([p.detach().flatten() for p in state.hw_nn.proxy.parameters()])

    method = replaced(exploration=Design(kappa=30.0, sigma=1.2))
    as_planned, edited = begun(method), begun(method)
    edited.alpha, edited.projection = alpha, projection
    assert not torch.equal(proxy_after(as_planned), proxy_after(edited))


def test_alpha_and_projection_begin_as_the_method_says() -> None:
    state = begun(replaced(alpha=3.0, projection="as_printed"))
    assert (state.alpha, state.projection) == (3.0, "as_printed")
    assert (begun(ALONE).alpha, begun(ALONE).projection, begun(ALONE).proxy) == (0.0, "none", None)


def test_all_rates_follow_the_iteration_those_of_a_searchs_networks_too() -> None:
    ppo = Ppo(epochs=1, minibatches=1, learning_rate=0.01, learning_rate_end=0.2)
    method = replaced(search=Drift(pairs=8, designs=8), ppo=ppo, schedule=Schedule(11))
    state = begun(method)
    run(method, 6, state)
    rates = {name: optimizer.param_groups[0]["lr"] for name, optimizer in state.optimizers.items()}
    expected = {"control": 0.01, "proxy": method.proxy.learning_rate, "reference": method.proxy.learning_rate}
    assert rates == {name: pytest.approx(0.6 * rate) for name, rate in expected.items()}


def test_the_policys_std_and_rate_fall_with_the_iterations_since_it_started_afresh() -> None:
    ppo = Ppo(epochs=1, minibatches=1, std=0.8, std_end=0.2, restart_interval=5, learning_rate=1e-5)
    method = NoHwOpt(trajectories=2, hidden=4, ppo=ppo, schedule=Schedule(11))
    state = begun(method)
    progress = run(method, 6, state)
    assert progress[3].policy_std == pytest.approx(0.8 * 0.25**0.3, rel=1e-3)
    assert state.control_start == 5
    assert progress[5].policy_std == pytest.approx(0.8, rel=1e-3)  # the first iteration of a new policy


@pytest.mark.parametrize("method", [TINY, DIRECT, ALONE])
@pytest.mark.parametrize("sound", [0, 1])
def test_iterations_that_leave_no_two_episodes_are_counted_and_teach_nothing(method: Method, sound: int) -> None:
    class Broken(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return lambda s, _: np.where(np.arange(len(s))[:, None] < sound, s[:, :2], np.nan)

    state = begun(method)
    before = [p.detach().clone() for module in state.modules.values() for p in module.parameters()]
    progress = run(method, 2, state, Broken())
    assert (state.iteration, state.diverged) == (2, 2 * (method.trajectories - sound))
    assert [(p.success, p.episode_return, p.phi) for p in progress] == [(0.0, 6.0 * sound, [2.0, 2.0])] * 2
    after = [p for module in state.modules.values() for p in module.parameters()]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


# --- the evolution strategy ---


def test_of_a_pair_of_designs_phi_follows_the_better_one() -> None:
    state = begun(DIRECT)
    run(DIRECT, 1, state)
    assert state.explored is not None
    better = state.explored[state.explored.sum(1).argmax()]  # an episode pays phi_1 + phi_2 a step
    # A = +-1 / sqrt(2), and E[A (phi_i - phi)] is the better one's distance times that
    assert np.allclose(state.phi, 2 + 1.5 * (better - 2) / np.sqrt(2))


def test_the_evolution_strategy_keeps_to_box_locks_and_what_can_be_built() -> None:
    space = Scales().design_space.with_bound("first", 1.9, 2.1).with_lock("second", 3.0)
    state = begun(DIRECT, design_space=space)
    assert all(1.9 <= p.phi[0] <= 2.1 and p.phi[1] == 3.0 for p in run(DIRECT, 3, state))
    rising = [p.phi[0] for p in run(DIRECT, 20, begun(DIRECT), Scales(largest=2.5))]
    assert 2.2 < max(rising) <= 2.5


def test_the_evolution_strategy_weighs_the_designs_whose_episodes_are_there() -> None:
    class Half(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return lambda s, _: np.where(np.arange(len(s))[:, None] == 1, np.nan, phi * s[:, :2])

    method = replaced(DIRECT, trajectories=4)
    state = begun(method)
    run(method, 1, state, Half())
    assert state.explored is not None
    kept = state.explored[[0, 2, 3]]
    weights = method.designs.advantage(3 * kept.sum(1))
    assert np.allclose(state.phi, 2 + 1.5 * (weights[:, None] * (kept - 2)).mean(0))


def test_the_evolution_strategys_sigma_anneals() -> None:
    assert [p.design_sigma for p in run(DIRECT, 6, begun(DIRECT))][::5] == [1.0, pytest.approx(0.5)]


def test_alone_the_policy_learns_and_phi_is_where_it_was_put() -> None:
    state = begun(ALONE)
    state.phi = np.array([3.0, 1.0])
    policy = [p.detach().clone() for p in state.control.policy.parameters()]
    assert [p.phi for p in run(ALONE, 2, state)] == [[3.0, 1.0]] * 2
    assert any(not torch.equal(a, b) for a, b in zip(policy, state.control.policy.parameters(), strict=True))


# --- the state ---


def test_advancing_adds_up_and_freezes_at_the_share() -> None:
    state = begun(ALONE)
    kept = np.array([True, False, True, True])
    successes = np.array([True, False, True])
    rollout = trajectories(np.ones((2, 3)), np.ones((2, 3)), kept=kept, successes=successes, steps=7)
    progress = state.advance(4, rollout, 0.5, search_cost=0.25)
    assert (state.iteration, state.env_steps, state.diverged, state.frozen) == (4, 7, 1, True)
    assert (progress.success, progress.episode_return, progress.search_cost) == (0.5, 2.0, 0.25)
    state.advance(5, rollout, 0.6)
    assert (state.env_steps, state.diverged, state.frozen) == (14, 2, True)


def test_a_state_begins_at_the_initial_design_inside_the_space() -> None:
    space = DesignSpace(Scales().design_space.parameters).with_bound("first", 5.0, 6.0).with_lock("second", -1.0)
    state = begun(TINY, design_space=space)
    assert state.phi.tolist() == [5.0, -1.0]
    assert state.design_space == space


def test_every_random_number_of_a_run_comes_from_its_seed() -> None:
    def first_weights(seed: int) -> list[torch.Tensor]:
        state = start(Scales(), TINY, seed)
        return [p.detach() for module in state.modules.values() for p in module.parameters()]

    torch.manual_seed(1)
    once = first_weights(3)
    torch.manual_seed(2)
    assert all(torch.equal(a, b) for a, b in zip(once, first_weights(3), strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(once, first_weights(4), strict=True))
    assert [p.phi for p in run(TINY, 3, start(Scales(), TINY, 3))] == [
        p.phi for p in run(TINY, 3, start(Scales(), TINY, 3))
    ]


def test_the_memory_learns_within_the_iterations_and_without_the_tasks_gradient() -> None:
    method = replaced(search=Drift(pairs=8, designs=8), design_interval=99, alpha=1.0)
    quiet = replaced(method, exploration=Design(kappa=0.0))
    pulled, free = begun(method), begun(quiet)
    run(method, 1, pulled)
    run(quiet, 1, free)
    features = tensor([[1.0, 1.0]])
    said = {
        name: hw_nn.proxy(features).detach()
        for name, hw_nn in {**{f"pulled {n}": h for n, h in pulled.proxies.items()}, **free.proxies}.items()
    }
    assert torch.equal(said["pulled reference"], said["reference"])  # kappa does not reach the reference
    assert not torch.equal(said["pulled proxy"], said["proxy"])
    assert torch.allclose(said["proxy"], said["reference"], atol=1e-5)  # without the task's pull they are one
