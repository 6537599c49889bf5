"""Trajectories and advantages."""

import dataclasses

import numpy as np
import pytest

from morph_core.rollout import Rollout, advantages, collect
from morph_core.tasks import make_task
from morph_core.tasks.reacher import LINKS


def rollout_of(reward: np.ndarray, alive: np.ndarray) -> Rollout:
    empty = np.zeros((*reward.shape, 1))
    fields = {field.name: empty for field in dataclasses.fields(Rollout)}
    return Rollout(**{**fields, "reward": reward, "alive": alive, "success": alive, "reward_terms": {}})


def test_advantages_are_those_of_the_definition() -> None:
    rng = np.random.default_rng(0)
    reward, values, gamma, gae_lambda = rng.normal(size=(5, 1)), rng.normal(size=(5, 1)), 0.9, 0.8
    result = advantages(rollout_of(reward, np.ones((5, 1), dtype=bool)), values, gamma, gae_lambda)
    following = np.append(values[1:, 0], 0.0)
    delta = reward[:, 0] + gamma * following - values[:, 0]
    expected = [sum((gamma * gae_lambda) ** k * delta[t + k] for k in range(5 - t)) for t in range(5)]
    assert result[:, 0].tolist() == pytest.approx(expected)


def test_with_lambda_one_the_value_target_is_the_discounted_return() -> None:
    reward = np.array([[1.0], [2.0], [4.0]])
    values = np.array([[0.3], [-0.2], [0.5]])
    result = advantages(rollout_of(reward, np.ones((3, 1), dtype=bool)), values, 0.5, 1.0) + values
    assert result[:, 0].tolist() == pytest.approx([1 + 1 + 1, 2 + 2, 4])


def test_nothing_flows_back_over_the_end_of_an_episode() -> None:
    alive = np.array([[True], [True], [False], [False]])
    reward = np.array([[1.0], [1.0], [100.0], [100.0]])
    ended = advantages(rollout_of(reward, alive), np.zeros((4, 1)), 0.9, 0.9)
    assert ended[:2, 0].tolist() == pytest.approx([1 + 0.81, 1.0])
    assert rollout_of(reward, alive).returns.tolist() == [2.0]
    assert rollout_of(reward, alive).steps == 2


def test_an_episode_ends_at_the_goal_and_not_before() -> None:
    task = make_task("reacher")
    arm = task.hw_phy(task.design_space.initial)
    rng = np.random.default_rng(0)
    still = collect(task, lambda o: np.zeros((len(o), LINKS), dtype=np.float32), arm, task.reset(arm, 3, rng))
    assert still.steps == 3 * task.horizon
    assert not still.successes.any()
    assert np.array_equal(still.s[1], still.s[0])
