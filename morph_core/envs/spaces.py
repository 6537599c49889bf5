"""The spaces of a task's observations and actions."""

import numpy as np
from gymnasium.spaces import Box

from morph_core.task import Task


def observation_space(task: Task) -> Box:
    """Return the box of observations (observation_size,), which has no bounds."""
    return Box(-np.inf, np.inf, (task.observation_size,), np.float32)


def action_space(task: Task) -> Box:
    """Return the box of actions (action_size,), from -1 to 1."""
    return Box(-1, 1, (task.action_size,), np.float32)
