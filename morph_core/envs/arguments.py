"""What a user hands to an environment, checked before anything changes; every refusal says what is allowed."""

import contextlib
import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from morph_core.catalogue import make_task
from morph_core.task import Task

RENDER_MODES = ("rgb_array",)


def check_task(task: Task | str, options: Mapping[str, Any]) -> Task:
    """Return a task by its name and options, or the task itself; ValueError for options beside a task object."""
    if isinstance(task, str):
        return make_task(task, options)
    if isinstance(task, type) or not hasattr(task, "hw_phy"):
        raise ValueError(f"task must be a task's name or a task object, not {task!r}")
    if options:
        raise ValueError(f"{', '.join(options)}: options go with a task's name; a task object has its own")
    return task


def check_render_mode(mode: str | None) -> str | None:
    """Return the mode, or raise ValueError that lists the choices."""
    if mode is not None and mode not in RENDER_MODES:
        raise ValueError(f"unknown render_mode {mode!r}; choose from: {', '.join(RENDER_MODES)}, or None for none")
    return mode


def check_options(options: Mapping[str, Any] | None, allowed: Sequence[str]) -> Mapping[str, Any]:
    """Return reset's options; ValueError lists the choices."""
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ValueError(f"options must be a dict or None, not {options!r}; it may hold: {', '.join(allowed)}")
    for option in options:
        if option not in allowed:
            raise ValueError(f"unknown option {option!r}; choose from: {', '.join(allowed)}")
    return options


def check_design(task: Task, phi: Any) -> np.ndarray:
    """Return a design (d,) that is inside the task's box and can be put together, or raise ValueError."""
    design = task.design_space.check(_numbers("phi", phi))
    task.check_buildable(design)
    return design


def check_designs(task: Task, phi: Any, chosen: np.ndarray) -> np.ndarray:
    """Return designs (N, d) from one (d,) for all or one for each environment; those of `chosen` (N,) are checked."""
    designs, shape = _numbers("phi", phi), (len(chosen), len(task.design_space))
    if designs.ndim == 2 and designs.shape != shape:
        raise ValueError(f"phi has the shape {designs.shape}; {shape[1:]} or {shape} is needed")
    if designs.ndim != 2:
        return np.tile(check_design(task, designs), (len(chosen), 1))
    for i in np.flatnonzero(chosen):
        try:
            check_design(task, designs[i])
        except ValueError as error:
            raise ValueError(f"environment {i}: {error}") from None
    return designs


def check_seed(seed: Any) -> int | None:
    """Return a seed as Gymnasium takes it, or raise ValueError."""
    if seed is None:
        return None
    number = None
    if not isinstance(seed, bool | np.bool_):
        with contextlib.suppress(TypeError):
            number = operator.index(seed)
    if number is None or number < 0:
        raise ValueError(f"a seed must be a whole number from 0 on, or None, not {seed!r}")
    return number


def check_seeds(seed: Any, environments: int) -> list[int | None]:
    """Return a seed for each environment: n + i from an int n, else what is given; None keeps a generator."""
    if isinstance(seed, list | tuple) or (isinstance(seed, np.ndarray) and seed.ndim > 0):
        if len(seed) != environments:
            raise ValueError(f"{len(seed)} seeds don't fit {environments} environments")
        return [check_seed(one) for one in seed]
    first = check_seed(seed)
    return [None if first is None else first + i for i in range(environments)]


def check_mask(mask: Any, environments: int) -> np.ndarray:
    """Return which environments (N,) are to be reset, refused as Gymnasium's SyncVectorEnv does."""
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        raise TypeError(f"reset_mask must be a numpy array of {environments} bool, not {mask!r}")
    if mask.shape != (environments,) or not mask.any():
        raise ValueError(f"reset_mask must have the shape ({environments},) and one True at least, not {mask!r}")
    return mask


def check_action(action: Any, shape: tuple[int, ...], ignored: np.ndarray | None = None) -> np.ndarray:
    """Return an action; ValueError unless it is finite numbers of this shape, but in the rows `ignored` (N,).

    Numbers beyond [-1, 1] are clipped by the task.
    """
    array = _numbers("an action", action)
    if ignored is not None and array.shape == shape:
        array[ignored] = 0.0
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"an action must be {shape} finite numbers, of which more than [-1, 1] is clipped: {action!r}")
    return array


def check_limit(limit: int | None, horizon: int) -> int:
    """Return after how many steps an episode is cut: its horizon at the latest; -1, as in make(), sets no limit."""
    if limit is None or limit == -1:
        return horizon
    if isinstance(limit, bool) or not isinstance(limit, int) or limit < 1:
        raise ValueError(f"max_episode_steps must be a whole number from 1 on, or -1 for no limit, not {limit!r}")
    return min(limit, horizon)


def check_environments(count: Any) -> int:
    """Return how many environments there are, or raise ValueError."""
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise ValueError(f"num_envs must be a whole number from 1 on, not {count!r}")
    return int(count)


def _numbers(name: str, value: Any) -> np.ndarray:
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        if np.asarray(value).dtype.kind not in "SUc" and not np.ma.is_masked(value):
            return np.array(value, dtype=float)
    raise ValueError(f"{name} must be numbers, not {value!r}")
