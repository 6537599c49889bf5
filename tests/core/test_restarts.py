"""The episodes of an environment after its first one."""

import numpy as np
import pytest

from morph_core.envs import TaskEnv, TaskVectorEnv


@pytest.mark.parametrize("kind", [TaskEnv, TaskVectorEnv])
def test_after_a_reset_an_episode_has_its_whole_horizon(kind: type[TaskEnv] | type[TaskVectorEnv]) -> None:
    env = kind("reacher")
    horizon, still = env.task.horizon, np.zeros(env.action_space.shape)
    for steps in (horizon, 5, horizon):
        env.reset(seed=0)
        truncated = [bool(np.all(env.step(still)[3])) for _ in range(steps)]
        assert truncated == [step == horizon for step in range(1, steps + 1)]


def test_an_environment_that_restarts_by_itself_has_its_whole_horizon_again() -> None:
    envs = TaskVectorEnv("reacher", 2)
    horizon, still = envs.task.horizon, np.zeros(envs.action_space.shape)
    envs.reset(seed=0)
    truncated = [envs.step(still)[3].tolist() for _ in range(2 * horizon + 1)]  # one step starts it again
    assert [step for step, ends in enumerate(truncated, 1) if any(ends)] == [horizon, 2 * horizon + 1]
    assert truncated[-1] == [True, True]
