"""The spaces of a task's observations and actions."""

import numpy as np
from gymnasium.spaces import Box

from morph_core.task import Task


def observation_space(task: Task) -> Box:
    return Box(-np.inf, np.inf, (task.observation_size,), np.float32)


def action_space(task: Task) -> Box:
    return Box(-1, 1, (task.action_size,), np.float32)
