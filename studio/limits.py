"""How large the numbers of a new run may be: the same for form, API and command line."""

import os

LARGEST_SEED = 2**32 - 1
MAX_ITERATIONS = 1_000_000
LAST_ITERATION = 10 * MAX_ITERATIONS  # a branch counts on from its parent
MAX_ENV_STEPS = 10**12
MAX_FINAL_EPISODES = 100_000
MAX_TRAINERS = 1024


def cores() -> list[int]:
    """Return the cores that this process may use, by their numbers."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def whole(name: str, value: object, lo: int, hi: int) -> int:
    """Return a whole number in [lo, hi]; raise ValueError that says so for anything else."""
    if isinstance(value, float) and value.is_integer():  # a browser has one kind of number
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not lo <= value <= hi:
        raise ValueError(f"{name} must be a whole number from {lo} to {hi}, not {value!r}")
    return value


def seed(value: object) -> int:
    """Return the seed of a run; raise ValueError that says what is allowed."""
    return whole("seed", value, 0, LARGEST_SEED)


def iterations(value: object, name: str = "iterations") -> int:
    """Return a number of iterations; raise ValueError that says what is allowed."""
    return whole(name, value, 1, MAX_ITERATIONS)


def env_steps(value: object) -> int:
    """Return a budget of environment steps; raise ValueError that says what is allowed."""
    return whole("env_steps", value, 1, MAX_ENV_STEPS)


def final_episodes(value: object) -> int:
    """Return a number of episodes for an evaluation at the end of a run; ValueError says what is allowed."""
    return whole("final_episodes", value, 0, MAX_FINAL_EPISODES)


def iterations_within(steps: int, trajectories: int) -> int:
    """Return the largest number of iterations that a budget of environment steps can hold: an episode has a step."""
    return min(MAX_ITERATIONS, -(-steps // trajectories))
