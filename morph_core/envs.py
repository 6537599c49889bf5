"""Every task as gymnasium.Env and VectorEnv, registered as morph/<Task>-v0: other libraries can train on them."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from morph_core.catalogue import TASKS, make_task
from morph_core.task import Task, Transition


def _spaces(task: Task) -> tuple[Box, Box]:
    return Box(-np.inf, np.inf, (task.observation_size,), np.float32), Box(-1, 1, (task.action_size,), np.float32)


def _finite(action: np.ndarray, shape: tuple[int, ...] | None) -> np.ndarray:
    """Return the action as an array, or raise ValueError that says what is allowed."""
    array = np.asarray(action, dtype=float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"an action must be {shape} finite numbers in [-1, 1], not {array!r}")
    return array


class TaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment with one design: the initial one, or `reset(options={"phi": [...]})` from then on."""

    metadata = {"render_modes": []}  # noqa: RUF012 - gymnasium's own form

    def __init__(self, task: str, render_mode: None = None, **task_options: Any) -> None:
        self.render_mode = render_mode
        self.task = make_task(task, task_options)
        self.observation_space, self.action_space = _spaces(self.task)
        self.phi = self.task.design_space.initial
        self._s = np.zeros((1, self.task.state_size))
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        if options and "phi" in options:
            self.phi = self.task.design_space.check(options["phi"])
        self._hw_phy = self.task.hw_phy(self.phi)
        self._s = self.task.reset(self._hw_phy, 1, self.np_random)
        self._steps = 0
        return self.task.observe(self._s)[0], {"phi": self.phi.copy()}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        transition = self.task.step(self._hw_phy, self._s, _finite(action, self.action_space.shape)[None])
        self._s = transition.s
        self._steps += 1
        info: dict[str, Any] = {f"reward_{name}": float(term[0]) for name, term in transition.reward_terms.items()}
        info["success"] = bool(transition.success[0])
        truncated = self._steps >= self.task.horizon and not transition.terminated[0]
        observation = self.task.observe(self._s)[0]
        return observation, float(transition.reward[0]), bool(transition.terminated[0]), bool(truncated), info


class TaskVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N environments stepped as one, each with its own design; they reset themselves on the step after their end."""

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, task: str, num_envs: int = 1, render_mode: None = None, **task_options: Any) -> None:
        self.render_mode = render_mode
        self.task = make_task(task, task_options)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = _spaces(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.phi = np.tile(self.task.design_space.initial, (num_envs, 1))
        self._s = np.zeros((num_envs, self.task.state_size))
        self._steps = np.zeros(num_envs, dtype=int)
        self._ended = np.zeros(num_envs, dtype=bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """`options={"phi": (d,) or (N, d)}` sets the designs from then on."""
        super().reset(seed=seed if not isinstance(seed, list) else seed[0])
        if options and "phi" in options:
            designs = np.broadcast_to(np.asarray(options["phi"], dtype=float), self.phi.shape)
            self.phi = np.stack([self.task.design_space.check(phi) for phi in designs])
        self._hw_phy = self.task.hw_phy(self.phi)
        self._s = self.task.reset(self._hw_phy, self.num_envs, self.np_random)
        self._steps[:] = 0
        self._ended[:] = False
        return self.task.observe(self._s), {"phi": self.phi.copy()}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        restarted = self._ended
        transition = self.task.step(self._hw_phy, self._s, _finite(actions, self.action_space.shape))
        self._s, self._steps = transition.s, self._steps + 1
        if restarted.any():
            fresh = self.task.reset(self._hw_phy, self.num_envs, self.np_random)
            self._s[restarted] = fresh[restarted]
            self._steps[restarted] = 0
        terminated = transition.terminated & ~restarted
        truncated = (self._steps >= self.task.horizon) & ~terminated
        self._ended = terminated | truncated
        reward = np.where(restarted, 0.0, transition.reward)
        return self.task.observe(self._s), reward, terminated, truncated, _info(transition, restarted)


def _info(transition: Transition, restarted: np.ndarray) -> dict[str, Any]:
    terms = {f"reward_{name}": np.where(restarted, 0.0, term) for name, term in transition.reward_terms.items()}
    return {**terms, "success": transition.success & ~restarted}


def register_tasks() -> None:
    """Register morph/Reacher-v0 and the like; done once when this module is imported."""
    for name in TASKS:
        gymnasium.register(
            id=f"morph/{name.title().replace('_', '')}-v0",
            entry_point="morph_core.envs:TaskEnv",
            vector_entry_point="morph_core.envs:TaskVectorEnv",
            kwargs={"task": name},
        )


register_tasks()
