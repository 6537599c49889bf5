"""A task as gymnasium.vector.VectorEnv: N environments stepped as one."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from morph_core.envs.arguments import (
    RENDER_MODES,
    check_action,
    check_designs,
    check_environments,
    check_limit,
    check_mask,
    check_options,
    check_render_mode,
    check_seeds,
    check_task,
)
from morph_core.envs.episodes import Episodes
from morph_core.envs.spaces import action_space, observation_space
from morph_core.task import Task


class TaskVectorEnv(Episodes, VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N environments, each with its own design and generator, that give what SyncVectorEnv of N TaskEnv gives.

    An environment starts again on the step after its end: then its action is ignored and its reward 0.
    """

    metadata = {"render_modes": list(RENDER_MODES), "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        task: Task | str,
        num_envs: int = 1,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **task_options: Any,
    ) -> None:
        task = check_task(task, task_options)
        self.num_envs = check_environments(num_envs)
        self._open(task, self.num_envs, check_limit(max_episode_steps, task.horizon))
        self.render_mode = check_render_mode(render_mode)
        self.metadata = {**self.metadata, "render_fps": 1 / task.control_dt}
        self.single_observation_space, self.single_action_space = observation_space(task), action_space(task)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._generators: list[tuple[np.random.Generator, int] | None] = [None] * self.num_envs

    @property
    def phi(self) -> np.ndarray:
        """Designs phi (N, d) of the environments."""
        return self._phi.copy()

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Generators (N) of the environments, as SyncVectorEnv has them."""
        return tuple(generator for generator, _ in self._seeded([None] * self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Seeds (N) from which the environments' generators were made."""
        return tuple(seed for _, seed in self._seeded([None] * self.num_envs))

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | np.ndarray | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start all episodes, or those of `options={"reset_mask": (N,) bool}`; "phi", (d,) or (N, d), sets designs.

        Environment i is seeded by n + i from an int n, else by the i-th seed; where that is None, its generator goes
        on. ValueError, and nothing changes, where a seed, an option or a design is not allowed or can't be built.
        """
        checked = check_options(options, ["phi", "reset_mask"])
        seeds = check_seeds(seed, self.num_envs)
        chosen = np.ones(self.num_envs, dtype=bool)
        if "reset_mask" in checked:
            chosen = check_mask(checked["reset_mask"], self.num_envs)
            if not (self._begun | chosen).all():
                raise ResetNeeded("some episodes have not begun: call reset() without reset_mask first")
        phi = check_designs(self.task, checked.get("phi", self._phi), chosen)
        self._build(np.where(chosen[:, None], phi, self._phi))
        self._seeded([one if mine else None for one, mine in zip(seeds, chosen, strict=True)])
        self._begin(chosen, self.np_random)
        return self._observe(), self._designs_of(chosen)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        self._check_begun("step")
        restarted = self._ended
        outcome = self._advance(check_action(actions, (self.num_envs, self.task.action_size), ignored=restarted))
        terminated, truncated = outcome.terminated & ~restarted, outcome.truncated & ~restarted
        self._ended = terminated | truncated
        info: dict[str, Any] = {}
        for name, values in outcome.info.items():
            info[name], info[f"_{name}"] = np.where(restarted, np.zeros_like(values), values), ~restarted
        if restarted.any():
            self._begin(restarted, self.np_random)
            info |= self._designs_of(restarted)
        return self._observe(), np.where(restarted, 0.0, outcome.reward), terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture (h, w, 3) uint8 of each environment; nothing without a render_mode."""
        if self.render_mode is None:
            gymnasium.logger.warn('render() shows nothing without a mode: make_vec(..., render_mode="rgb_array")')
            return None
        self._check_begun("render")
        return tuple(self._frame(i) for i in range(self.num_envs))

    def _seeded(self, seeds: Sequence[int | None]) -> list[tuple[np.random.Generator, int]]:
        """Return generators and their seeds, made anew where there is a seed (N,) or was no generator."""
        kept = zip(self._generators, seeds, strict=True)
        made = [old if old and seed is None else seeding.np_random(seed) for old, seed in kept]
        self._generators[:] = made
        return made

    def _designs_of(self, chosen: np.ndarray) -> dict[str, np.ndarray]:
        """Return the info of a reset of the environments `chosen` (N,)."""
        return {"phi": np.where(chosen[:, None], self._phi, 0.0), "_phi": chosen.copy()}
