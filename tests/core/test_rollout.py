"""Trajectories and advantages."""

import dataclasses

import numpy as np
import pytest
import torch

from morph_core.catalogue import make_task
from morph_core.episodes import evaluate, record_episode
from morph_core.exploration import relabel_on_hardware
from morph_core.rollout import Act, Rollout, advantages, collect
from morph_core.state import start
from morph_core.tasks.reacher import LINKS, Reacher
from tests.core.conftest import SMALL, Fragile, small_method


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


def test_an_episode_ends_at_the_goal_and_not_before() -> None:
    task = make_task("reacher")
    arm = task.hw_phy(task.design_space.initial)
    rng = np.random.default_rng(0)
    still = collect(task, lambda o: np.zeros((len(o), LINKS), dtype=np.float32), arm, task.reset(arm, 3, rng))
    assert still.steps == 3 * task.horizon
    assert not still.successes.any()
    assert np.array_equal(still.s[1], still.s[0])


def turning(rng: np.random.Generator) -> Act:
    return lambda o: rng.uniform(-1, 1, (len(o), LINKS)).astype(np.float32)


def test_diverged_episodes_are_left_out_and_counted() -> None:
    task, sound = Fragile(), Reacher()
    arm = task.hw_phy(task.design_space.initial)
    s = task.reset(arm, 64, np.random.default_rng(0))
    rollout = collect(task, turning(np.random.default_rng(1)), arm, s)
    whole = collect(sound, turning(np.random.default_rng(1)), arm, s)
    after = np.concatenate([whole.s[1:], whole.last_s[None]])
    broken = np.any([task.broken(s) & alive for s, alive in zip(after, whole.alive, strict=True)], 0)
    assert 0 < broken.sum() < 64
    assert np.array_equal(rollout.kept, ~broken)
    assert (rollout.episodes, rollout.diverged) == (64, broken.sum())
    for name in ("s", "a", "z", "reward", "action", "observation", "alive", "success", "contact"):
        array = getattr(rollout, name)
        assert np.array_equal(array, getattr(whole, name)[: len(array), ~broken], equal_nan=name == "contact"), name
    assert np.array_equal(rollout.returns, whole.returns[~broken])
    assert np.array_equal(rollout.successes, whole.successes[~broken])
    assert rollout.alive.sum() < rollout.steps < 64 * task.horizon


def test_the_steps_of_what_is_left_out_count_up_to_where_it_diverged() -> None:
    task = Fragile(limit=0.0)  # diverges in the first step
    arm = task.hw_phy(task.design_space.initial)
    rollout = collect(task, turning(np.random.default_rng(1)), arm, task.reset(arm, 8, np.random.default_rng(0)))
    assert (rollout.steps, rollout.diverged, rollout.episodes) == (8, 8, 8)
    assert rollout.returns.shape == rollout.successes.shape == (0,)
    assert rollout.s.shape == (1, 0, task.state_size)


def test_no_batch_holds_a_step_of_a_diverged_episode() -> None:
    task = Fragile()
    state = start(task, SMALL, 0)
    arm = task.hw_phy(state.phi)
    s = task.reset(arm, 64, np.random.default_rng(0))
    rollout = collect(task, turning(np.random.default_rng(1)), arm, s)
    assert rollout.diverged
    batch = state.control.batch(rollout)
    pairs = relabel_on_hardware(rollout, arm, 0, state.rng)
    assert len(batch) == len(pairs) == rollout.alive.sum()
    assert all(torch.isfinite(getattr(batch, field.name)).all() for field in dataclasses.fields(batch))
    assert np.isfinite(pairs.z).all()
    assert not task.broken(pairs.s).any()


@pytest.mark.parametrize("sampled", [False, True])
def test_an_evaluation_counts_a_diverged_episode_as_a_failure(sampled: bool) -> None:
    task = Fragile()
    policy = start(task, small_method("morph", {"ppo.std": 2.0}), 0).control.policy
    score, rollout = evaluate(task, policy, task.design_space.initial, 64, np.random.default_rng(0), sampled)
    assert score.diverged == rollout.diverged == 64 - rollout.alive.shape[1]
    assert (score.diverged > 0) == sampled  # the mean of a fresh policy hardly moves
    assert score.success == rollout.successes.sum() / 64
    assert score.episode_return == pytest.approx(rollout.returns.mean())


def test_success_is_a_share_of_all_episodes_and_not_of_those_that_could_be_simulated() -> None:
    rollout = rollout_of(np.ones((2, 3)), np.ones((2, 3), dtype=bool))
    rollout = dataclasses.replace(rollout, kept=np.array([True, False, True, True]), successes=np.array([1, 0, 1]))
    assert rollout.success_rate == 0.5


def test_where_every_simulation_diverges_the_score_is_zero_and_the_recorded_episode_is_the_design() -> None:
    task = Fragile(limit=0.0)
    phi = task.design_space.initial
    score, rollout = evaluate(task, start(task, SMALL, 0).control.policy, phi, 8, np.random.default_rng(0), True)
    assert (score.success, score.episode_return, score.diverged) == (0.0, 0.0, 8)
    assert list(record_episode(task, rollout, phi)) == ["phi"]
