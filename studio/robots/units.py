"""A task's own units as the arrays that a program reads."""

import numpy as np

from morph_core.task import Task


def speeds_of(task: Task) -> list[float]:
    """Return how fast (m/s, rad/s) actions of 1 move the joints of a task, or their targets; [] if it is unknown."""
    units = task.action_units
    return [] if units is None else [float(f"{speed:.12g}") for speed in units / task.control_dt]


def units_of(task: Task) -> dict[str, np.ndarray]:
    """Return middle and spread of what the policy sees, and the scale of its actions; ValueError if one is missing."""
    if task.observation_units is None or task.action_units is None:
        raise ValueError(f"{task.name} must have observation_units and action_units: its policy is run outside of it")
    middle, spread = task.observation_units
    return {"middle": middle, "spread": spread, "action_scale": task.action_units}
