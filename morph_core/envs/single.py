"""A task as gymnasium.Env."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded

from morph_core.envs.arguments import (
    RENDER_MODES,
    check_action,
    check_design,
    check_options,
    check_render_mode,
    check_seed,
    check_task,
)
from morph_core.envs.episodes import Episodes
from morph_core.envs.spaces import action_space, observation_space
from morph_core.task import Task


class TaskEnv(Episodes, gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment with one design: the initial one, or `reset(options={"phi": [...]})` from then on.

    An episode is truncated at the task's horizon, which is part of the task, and where the physics fails: then
    info["diverged"] is true, and the observation is the one before. Actions beyond [-1, 1] are clipped.
    """

    metadata = {"render_modes": list(RENDER_MODES)}  # noqa: RUF012 - gymnasium's own form

    def __init__(self, task: Task | str, render_mode: str | None = None, **task_options: Any) -> None:
        task = check_task(task, task_options)
        self._open(task, environments=1, limit=task.horizon)
        self.render_mode = check_render_mode(render_mode)
        self.metadata = {**self.metadata, "render_fps": 1 / task.control_dt}
        self.observation_space, self.action_space = observation_space(task), action_space(task)

    @property
    def phi(self) -> np.ndarray:
        """Design phi (d,) of the environment."""
        return self._phi[0].copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; `options={"phi": (d,)}` sets the design from then on.

        ValueError, and nothing changes, where a seed, an option or a design is not allowed or can't be built.
        """
        checked = check_options(options, ["phi"])
        phi = check_design(self.task, checked.get("phi", self._phi[0]))
        number = check_seed(seed)
        self._build(phi[None])
        super().reset(seed=number)
        self._begin(np.array([True]), [self.np_random])
        return self._observe()[0], {"phi": self.phi}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take one control step; return observation, reward, terminated, truncated and what the task tells of it.

        ValueError where the action is not allowed, ResetNeeded before the first reset and after the end of an episode.
        """
        self._check_begun("step")
        if self._ended[0]:
            raise ResetNeeded("the episode has ended: call reset() before the next step()")
        outcome = self._advance(check_action(action, (self.task.action_size,))[None])
        info = {name: values[0].item() for name, values in outcome.info.items()}
        ends = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        return self._observe()[0], float(outcome.reward[0]), *ends, info

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a picture (h, w, 3) uint8 of robot, objects and goal; nothing without a render_mode."""
        if self.render_mode is None:
            gymnasium.logger.warn('render() shows nothing without a mode: make(..., render_mode="rgb_array")')
            return None
        self._check_begun("render")
        return self._frame(0)
