"""A task's own units as the arrays that a program reads."""

import numpy as np

from morph_core.task import Task


def units_of(task: Task) -> dict[str, np.ndarray]:
    """Return middle and spread of what the policy sees, and the scale of its actions; ValueError if one is missing."""
    if task.observation_units is None or task.action_units is None:
        raise ValueError(f"{task.name} must have observation_units and action_units: its policy is run outside of it")
    middle, spread = task.observation_units
    return {"middle": middle, "spread": spread, "action_scale": task.action_units}
