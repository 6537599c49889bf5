"""Advantages and value targets, by hand."""

import numpy as np
import pytest
import torch

from morph_core.rollout import advantages
from tests.core.scales import linear, replaced, started, trajectories

ENDED = [[True, True], [True, True], [False, True]]
"""The first episode ends after two steps, the second at the horizon."""


def test_no_value_flows_over_the_end_of_an_episode() -> None:
    values = np.array([[1.0, 1.0], [2.0, 2.0], [400.0, 4.0]])  # 400: of a step after the end
    result = advantages(trajectories([[1.0, 1.0], [1.0, 1.0], [100.0, 1.0]], ENDED), values, 0.5, 0.5)
    # from behind: delta = r + gamma V' - V, A = delta + gamma lambda A'; V' is 0 after the end and at the horizon
    assert result[:2, 0].tolist() == [1 + 0.5 * 2 - 1 + 0.25 * -1, 1 - 2]
    assert result[:, 1].tolist() == [1 + 0.5 * 2 - 1 + 0.25 * 0.25, 1 + 0.5 * 4 - 2 + 0.25 * -3, 1 - 4]


@pytest.mark.parametrize(("gae_lambda", "first"), [(0.0, 1 + 0.5 * 2 - 1), (1.0, 1 + 0.5 + 0.25 - 1)])
def test_lambda_leads_from_one_step_to_the_whole_return(gae_lambda: float, first: float) -> None:
    values = np.array([[1.0], [2.0], [4.0]])
    result = advantages(trajectories(np.ones((3, 1)), np.ones((3, 1))), values, 0.5, gae_lambda)
    assert result[0, 0] == pytest.approx(first)


def test_a_batch_holds_the_steps_alive_with_time_target_and_standardised_advantage() -> None:
    state = started(replaced())
    state.control.critic.value = linear([[0.0, 3.0]], [1.0])  # V = 1 + 3 t / T = 1, 2, 3
    observation = np.arange(6, dtype=np.float32).reshape(3, 2, 1)
    action = np.arange(12, dtype=np.float32).reshape(3, 2, 2)
    rollout = trajectories([[1.0, 2.0], [3.0, 4.0], [500.0, 6.0]], ENDED, observation=observation, action=action)
    ppo = state.control._ppo
    batch = state.control.batch(rollout)
    values = np.array([[1.0, 1.0], [2.0, 2.0], [0.0, 3.0]])  # a step after the end has no value
    advantage = advantages(rollout, values, ppo.gamma, ppo.gae_lambda)
    alive = np.array(ENDED)
    assert len(batch) == 5
    assert batch.observation[:, 0].tolist() == [0, 1, 2, 3, 5]
    assert batch.action[:, 0].tolist() == [0, 2, 4, 6, 10]
    assert torch.allclose(batch.time, torch.tensor([0, 0, 1, 1, 2]) / 3)
    assert batch.value_target.tolist() == pytest.approx((advantage + values)[alive].tolist())
    counted = advantage[alive]
    assert batch.advantage.tolist() == pytest.approx(((counted - counted.mean()) / counted.std(ddof=1)).tolist())
    expected = state.control.policy.log_prob(batch.observation, batch.action)
    assert torch.equal(batch.log_prob, expected)
    assert not batch.log_prob.requires_grad


def test_the_return_of_an_episode_is_undiscounted_and_ends_with_it() -> None:
    assert trajectories([[1.0, 1.0], [2.0, 2.0], [4.0, 4.0]], ENDED).returns.tolist() == [3.0, 7.0]
