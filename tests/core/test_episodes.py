"""Success, return and milestones on Hw-Phy, and one episode as it is recorded."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from morph_core.episodes import evaluate, record_episode
from morph_core.rollout import collect
from morph_core.task import Hardware, Transition
from tests.core.scales import Scales, started


def score(task: Scales, episodes: int = 8, sampled: bool = True) -> Any:
    policy = started().control.policy
    return evaluate(task, policy, np.array([1.0, 2.0]), episodes, np.random.default_rng(0), sampled)[0]


@pytest.mark.parametrize(("succeeding", "success"), [(0.0, 0.0), (0.25, 0.25), (1.0, 1.0)])
def test_success_and_return_are_means_over_the_episodes(succeeding: float, success: float) -> None:
    result = score(Scales(ends=2, succeeding=succeeding))
    assert result.success == success
    assert result.episode_return == pytest.approx(3 * (2 * success + 3 * (1 - success)))
    assert result.diverged == 0


def test_a_milestone_of_a_step_after_the_end_does_not_count() -> None:
    # "late" is reached in the third step by every episode that gets there
    assert score(Scales()).milestones == {"near": 0.0, "late": 1.0}
    assert score(Scales(ends=2, succeeding=0.5)).milestones["late"] == 0.5
    assert score(Scales(ends=2)).milestones["late"] == 0.0
    assert score(Scales(near=0.25)).milestones["near"] == 0.25


def test_the_task_says_what_a_success_is() -> None:
    class Held(Scales):
        def solved(self, reached: np.ndarray) -> np.ndarray:
            return reached.sum(0) >= 2

    result = score(Held(ends=3, near=1.0))
    assert (result.success, result.milestones) == (0.0, {"near": 0.0, "late": 0.0})


def test_a_success_after_the_end_does_not_count() -> None:
    class Afterwards(Scales):
        def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
            first_half = np.arange(len(s)) < len(s) // 2
            third = s[:, 2] == 2
            return dataclasses.replace(super().step(hardware, s, action), terminated=first_half, success=third)

    result = score(Afterwards())
    assert result.success == 0.5
    assert result.episode_return == pytest.approx(3 * (1 + 3) / 2)


def test_an_episode_whose_simulation_diverged_has_failed() -> None:
    class Half(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return lambda s, _: np.where(np.arange(len(s))[:, None] < len(s) // 2, phi * s[:, :2], np.nan)

    result = score(Half(ends=2, near=1.0))
    assert (result.success, result.diverged) == (0.5, 4)
    assert result.milestones["near"] == 0.5
    assert result.episode_return == pytest.approx(6.0)


def test_only_a_sampled_policy_draws_random_numbers() -> None:
    policy, task, phi = started().control.policy, Scales(), np.array([1.0, 2.0])
    mean = evaluate(task, policy, phi, 4, np.random.default_rng(0), sampled=False)[1]
    sampled = evaluate(task, policy, phi, 4, np.random.default_rng(0), sampled=True)[1]
    assert (mean.action == 0).all()
    assert (sampled.action != 0).all()


def test_a_rollout_counts_steps_until_each_end_and_keeps_what_was_executed() -> None:
    task, phi = Scales(ends=2, succeeding=0.5), np.array([1.0, 2.0])
    start = task.reset(task.hw_phy(phi), 4, np.random.default_rng(0))
    rollout = collect(task, lambda o: np.full((len(o), 2), 0.5, dtype=np.float32), task.hw_phy(phi), start)
    assert rollout.alive.sum(0).tolist() == [2, 2, 3, 3]
    assert (rollout.steps, rollout.episodes, rollout.diverged) == (10, 4, 0)
    assert rollout.successes.tolist() == [True, True, False, False]
    assert rollout.success_rate == 0.5
    assert rollout.returns.tolist() == [6.0, 6.0, 9.0, 9.0]
    assert rollout.s[:, 0, 2].tolist() == [0, 1, 2]
    assert rollout.a[2, :, 0].tolist() == [0, 0, 0.5, 0.5]  # what has ended rests
    everybody = collect(Scales(ends=1), lambda o: np.zeros((len(o), 2), dtype=np.float32), task.hw_phy(phi), start)
    assert len(everybody.reward) == 1  # nobody is left to go on


def test_an_episode_that_ended_before_it_could_diverge_is_kept() -> None:
    class Late(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return lambda s, _: np.where(s[:, 2:] == 2, np.nan, phi * s[:, :2])

    result = score(Late(ends=2, succeeding=0.5))
    assert (result.success, result.diverged) == (0.5, 4)


@pytest.mark.parametrize(("ends", "steps"), [(2, 2), (0, 3)])
def test_a_recorded_episode_has_its_steps_and_one_posture_more(ends: int, steps: int) -> None:
    task = Scales(ends=ends, succeeding=0.5, near=1.0)
    _, rollout = evaluate(task, started().control.policy, np.array([1.0, 2.0]), 2, np.random.default_rng(0), True)
    episode = record_episode(task, rollout, np.array([1.0, 2.0]))
    assert episode["qpos"][:, 2].tolist() == list(range(steps + 1))
    assert [len(episode[name]) for name in ("action", "contact", "success", "reward", "milestones/near")] == [steps] * 5
    assert episode["reward_terms/scales"].tolist() == [3.0] * steps
    assert episode["phi"].tolist() == [1.0, 2.0]
