"""CMA-ES over phi with PPO for every candidate: on two scales a candidate's return is 3 (phi_1 + phi_2)."""

import dataclasses
import functools
import itertools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cma
import numpy as np
import pytest
import torch

from morph_core.catalogue import make_task
from morph_core.checkpoint import load_checkpoint, save_checkpoint
from morph_core.design import DesignSpace
from morph_core.episodes import evaluate
from morph_core.history import History
from morph_core.methods.cmaes_rl import REFUSALS, CmaesRl, Trials
from morph_core.parts import Schedule
from morph_core.protocol import InjectDesign, Lock, Progress, SetBound, Unlock
from morph_core.search import Memory
from morph_core.state import State, start
from morph_core.task import Hardware, Transition
from morph_core.train import Trainer, apply_edit
from tests.core.conftest import make_run, rewrite, small_method
from tests.core.scales import TINY, Scales

RIVAL = CmaesRl(trajectories=4, hidden=4, ppo=TINY.ppo, schedule=Schedule(10), candidate_iterations=2)
POPULATION = 6  # 4 + floor(3 ln 2)
WIDE = Scales(largest=20.0)
"""Two scales of which every design in the box can be built."""
SPACE = WIDE.design_space


def run(iterations: int, state: State, task: Scales | None = None, method: CmaesRl = RIVAL) -> list[Progress]:
    return list(itertools.islice(method.iterations(task or WIDE, state), iterations))


def begun(task: Scales | None = None, space: DesignSpace | None = None, seed: int = 0) -> State:
    return start(task or WIDE, RIVAL, seed, space)


def trials_of(state: State) -> Trials:
    assert isinstance(state.memory, Trials)
    return state.memory


def by_pycma(seed: int, generations: int, largest: float = np.inf) -> list[list[float]]:
    """Return all candidates that pycma asks for from phi = (2, 2) in the box [-20, 20], told costs as known by hand."""
    es = cma.CMAEvolutionStrategy([0.55, 0.55], 0.25, {"bounds": [0, 1], "seed": seed, "verbose": -9})
    candidates = []
    for _ in range(generations):
        asked = es.ask()
        phi = [[-20 + 40 * u for u in x] for x in asked]
        es.tell(asked, [-3 * sum(p) if p[0] <= largest else np.inf for p in phi])
        candidates += phi
    return candidates


def close_to(phi: Any) -> Any:
    return pytest.approx(phi, rel=0, abs=1e-9)


# --- the search ---


def test_the_candidates_are_those_of_pycma_told_minus_the_best_returns() -> None:
    state = begun()
    tried = [p.phi for p in run(2 * 3 * POPULATION, state)][::2]
    wanted = by_pycma(trials_of(state).seed, 3)
    assert len(wanted) == len(tried) == 3 * POPULATION
    for phi, by_hand in zip(tried, wanted, strict=True):
        assert phi == close_to(by_hand)
    costs = [-3 * sum(phi) for phi in tried[:-1]]  # the last one has not been told yet
    assert trials_of(state).costs == pytest.approx(costs, abs=1e-9)


def test_a_better_design_is_found() -> None:
    state = begun()
    run(2 * 10 * POPULATION, state)
    assert sum(trials_of(state).best_phi) > 30  # of 40; the initial design has 4
    assert trials_of(state).best_of_all == pytest.approx(3 * sum(trials_of(state).best_phi))


@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_every_candidate_gets_its_iterations_and_not_one_more(iterations: int) -> None:
    method = dataclasses.replace(RIVAL, candidate_iterations=iterations)
    progress = run(4 * iterations, begun(), method=method)
    blocks = [len(list(same)) for _, same in itertools.groupby(progress, key=lambda p: p.phi)]
    assert blocks == [iterations] * 4
    assert [p.env_steps for p in progress] == [4 * 3 * i for i in range(1, 4 * iterations + 1)]


def test_every_candidate_begins_with_a_policy_that_has_learnt_nothing() -> None:
    state = begun()
    iterations = RIVAL.iterations(WIDE, state)
    starts, stds, weights = [], [], []
    for progress in itertools.islice(iterations, 5):
        starts.append(state.control_start)
        stds.append(progress.policy_std)
        weights.append(state.control.policy)
    assert starts == [0, 0, 2, 2, 4]
    assert stds[::2] == pytest.approx([0.5] * 3, abs=0.003)
    assert stds[1::2] == pytest.approx([0.5 * 0.4 ** (1 / 9)] * 2, abs=0.003)  # one of nine steps on the way to .2
    assert weights[0] is weights[1] is not weights[2]
    assert state.control.optimizer.param_groups[0]["params"][0] is next(state.control.policy.parameters())


def test_a_candidate_counts_with_its_best_iteration() -> None:
    trials = Trials()
    trials.open(np.array([1.0, 2.0]), asked=True)
    for mean_return in (-5.0, -2.0, -3.0):
        trials.take_note(mean_return)
    trials.close()
    assert (trials.costs, trials.best_phi, trials.best_of_all) == ([2.0], [1.0, 2.0], -2.0)
    trials.open(np.array([3.0, 4.0]), asked=True)
    trials.take_note(-2.5)
    trials.close()
    assert (trials.costs, trials.best_phi, trials.best_of_all) == ([2.0, 2.5], [1.0, 2.0], -2.0)


def test_a_candidate_whose_every_simulation_diverges_costs_infinity() -> None:
    @dataclass(frozen=True)
    class Broken(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return super().hw_phy(np.full(2, np.nan))

    state = begun()
    progress = run(5, state, Broken(largest=20.0))
    assert trials_of(state).costs == [None, None]
    assert (trials_of(state).best_phi, trials_of(state).best_of_all) == ([], None)
    assert np.isfinite([p.phi for p in progress]).all()


def test_a_search_that_has_come_to_its_end_begins_anew_at_the_best() -> None:
    @dataclass(frozen=True)
    class Flat(Scales):
        def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
            return dataclasses.replace(super().step(hardware, s, action), reward=np.zeros(len(s)))

    state = begun()
    method = dataclasses.replace(RIVAL, candidate_iterations=1)
    iterations = method.iterations(Flat(largest=20.0), state)
    next(iterations)
    first = trials_of(state).seed
    later = (trials_of(state) for _ in itertools.islice(iterations, 500))
    anew = next(trials for trials in later if trials.seed != first)
    assert anew.start == anew.best_phi != SPACE.initial.tolist()
    assert (anew.asked, anew.costs) == (True, [])


# --- what can't be built, and what is not free ---


def test_candidates_that_cant_be_built_are_refused_as_infinitely_costly_and_counted() -> None:
    task = Scales(largest=4.0)
    state = begun(task)
    tried = [p.phi for p in run(2 * 10, state, task)][::2]
    wanted = by_pycma(trials_of(state).seed, 5, largest=4.0)
    buildable = [phi for phi in wanted if phi[0] <= 4.0]
    for phi, by_hand in zip(tried, buildable, strict=False):
        assert phi == close_to(by_hand)
    refused = wanted.index(buildable[9]) - 9
    assert trials_of(state).refused == refused > 0
    assert trials_of(state).costs.count(None) == refused


def test_where_nothing_else_can_be_built_the_start_is_tried() -> None:
    @dataclass(frozen=True)
    class Alone(Scales):
        def buildable(self, phi: np.ndarray) -> np.ndarray:
            return (phi == 2.0).all(-1)

    state = begun()
    assert [p.phi for p in run(4, state, Alone())] == [[2.0, 2.0]] * 4
    assert REFUSALS < trials_of(state).refused <= 2 * REFUSALS


def test_a_lone_free_parameter_is_searched_too() -> None:
    state = begun(space=SPACE.with_lock("second", 3.0))
    tried = [p.phi for p in run(2 * 5 * POPULATION, state)]
    assert {phi[1] for phi in tried} == {3.0}
    assert all(-20 <= phi[0] <= 20 for phi in tried)
    assert trials_of(state).best_phi[0] > 15


def test_where_nothing_is_free_the_policy_learns_on() -> None:
    space = SPACE.with_lock("first", 1.0).with_lock("second", 3.0)
    state = begun(space=space)
    assert [p.phi for p in run(6, state)] == [[1.0, 3.0]] * 6
    assert state.control_start == 0


# --- edits ---


def test_bounds_and_locks_are_obeyed_from_the_next_candidate_on() -> None:
    state = begun()
    present = run(1, state)[-1].phi
    low, high = present[0] - 1, present[0] + 1
    apply_edit(SetBound("first", low, high), state, WIDE)
    apply_edit(Lock("second"), state, WIDE)
    progress = run(9, state)
    assert progress[0].phi == present  # which lies inside, and is tried to its end
    assert progress[1].phi != present
    assert all(low <= p.phi[0] <= high and p.phi[1] == present[1] for p in progress)
    assert trials_of(state).start == present  # the best so far
    assert len(trials_of(state).costs) == 3  # of the CMA-ES that began anew
    apply_edit(Unlock("second"), state, WIDE)
    assert run(3, state)[-1].phi[1] != present[1]


def test_after_an_edit_the_search_begins_at_the_best_candidate_inside_the_new_box() -> None:
    state = begun()
    run(6, state)
    trials = trials_of(state)
    best = max([trials.best_phi, trials.phi], key=sum)
    apply_edit(SetBound("second", -20.0, 19.5), state, WIDE)
    run(1, state)
    assert trials.start == [best[0], min(best[1], 19.5)]


def test_an_injected_design_is_the_next_candidate_and_the_search_begins_anew_after_it() -> None:
    state = begun()
    run(3, state)
    seed = trials_of(state).seed
    apply_edit(InjectDesign([9.5, 19.0]), state, WIDE)
    progress = run(3, state)
    assert [p.phi for p in progress[:2]] == [[9.5, 19.0]] * 2
    assert progress[2].phi != [9.5, 19.0]
    assert trials_of(state).start == trials_of(state).best_phi == [9.5, 19.0]
    assert (trials_of(state).seed != seed, trials_of(state).costs) == (True, [])
    assert trials_of(state).best_of_all == pytest.approx(3 * 28.5)


def test_a_design_that_is_injected_before_the_first_iteration_is_the_first_candidate() -> None:
    state = begun()
    apply_edit(InjectDesign([5.0, 6.0]), state, WIDE)
    assert [p.phi for p in run(2, state)] == [[5.0, 6.0]] * 2


def test_a_bound_that_moves_the_present_candidate_begins_it_again_where_it_has_moved_to() -> None:
    state = begun()
    present = run(1, state)[-1].phi
    apply_edit(SetBound("first", -20.0, present[0] - 1), state, WIDE)
    progress = run(3, state)
    assert [p.phi for p in progress[:2]] == [[present[0] - 1, present[1]]] * 2
    assert progress[2].phi[0] <= present[0] - 1


# --- checkpoints ---


@functools.cache
def uninterrupted(largest: float, seed: int) -> tuple[list[Progress], State]:
    """Return the first thirty iterations, and the state after them."""
    task = Scales(largest=largest)
    state = begun(task, seed=seed)
    return run(30, state, task), state


@pytest.mark.parametrize("after", [1, 2, 3, 13, 14])
def test_it_goes_on_from_a_checkpoint_bit_for_bit(after: int, tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    task = Scales(largest=8.0)
    expected, whole = uninterrupted(8.0, seed=4)
    state = begun(task, seed=4)
    run(after, state, task)
    save_checkpoint(folder, state, 0.0)
    loaded, _ = load_checkpoint(folder, after, task, RIVAL)
    assert run(30 - after, loaded, task) == expected[after:]
    for name, module in whole.modules.items():
        for key, value in module.state_dict().items():
            assert torch.equal(loaded.modules[name].state_dict()[key], value)
    assert trials_of(loaded) == trials_of(whole)


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(Trials)])
def test_every_fact_survives_a_checkpoint(name: str, tmp_path: Path) -> None:
    state = begun()
    run(5, state)
    trials_of(state).refused = 7
    assert getattr(trials_of(state), name) != getattr(Trials(), name)
    save_checkpoint(folder := make_run(tmp_path), state, 0.0)
    loaded, _ = load_checkpoint(folder, 5, WIDE, RIVAL)
    assert getattr(trials_of(loaded), name) == getattr(trials_of(state), name)


def test_the_facts_are_json() -> None:
    state = begun()
    run(3, state)
    json.dumps(state.memory.facts, allow_nan=False)


def test_a_checkpoint_from_before_there_were_facts_opens(tmp_path: Path) -> None:
    folder, state = make_run(tmp_path), start(Scales(), TINY, 0)
    save_checkpoint(folder, state, 0.0)
    rewrite(folder.checkpoint(0), memory=None)
    load_checkpoint(folder, 0, Scales(), TINY)


def test_it_refuses_another_methods_memory() -> None:
    state = begun()
    state.memory = Memory()
    with pytest.raises(ValueError, match="cmaes_rl needs the memory"):
        run(1, state)


# --- the trainer ---


def test_an_evaluation_measures_the_candidate_that_is_being_tried(tmp_path: Path) -> None:
    folder = make_run(tmp_path, method=small_method("cmaes_rl", {"evaluation.interval": 1}), iterations=6)
    Trainer(folder).run()
    history = History(folder)
    assert [e.phi for e in history.evaluations] == [p.phi for p in history.progress]
    assert len({tuple(e.phi) for e in history.evaluations}) == 3
    assert history.best is not None
    assert history.best.sampled_return == max(e.sampled_return for e in history.evaluations)
    initial = DesignSpace(tuple(history.record.parameters)).initial
    assert history.best.phi != initial.tolist()


def test_a_run_ends_with_the_best_candidate_and_its_policy(tmp_path: Path) -> None:
    folder = make_run(tmp_path, method=small_method("cmaes_rl"), iterations=1000, env_steps=6000, final_episodes=10)
    for _ in range(2):  # taken up again, it measures nothing twice
        Trainer(folder).run()
    history = History(folder)
    *regular, final = history.evaluations
    assert final.final
    assert not any(evaluation.final for evaluation in regular)
    best = max(regular, key=lambda e: (e.sampled_success, e.sampled_return))
    assert best.iteration < history.iteration
    assert (final.iteration, final.env_steps, final.phi) == (best.iteration, best.env_steps, best.phi)
    task = make_task("reacher")
    state, _ = load_checkpoint(folder, best.iteration, task, small_method("cmaes_rl"))
    rng = np.random.default_rng([history.record.seed, best.iteration, 10])
    score, _ = evaluate(task, state.control.policy, state.phi, 10, rng, sampled=True)
    assert final.sampled_return == score.episode_return
