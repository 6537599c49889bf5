"""N episodes of a task, each with its own design and generator: what both environments are made of."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded

from morph_core.envs.view import View
from morph_core.task import Hardware, Task, Transition


@dataclass(frozen=True)
class Outcome:
    """What one control step did to N episodes. Where the physics failed, the step pays nothing and moves nothing."""

    reward: np.ndarray  # (N,)
    terminated: np.ndarray  # (N,) bool
    truncated: np.ndarray  # (N,) bool: at the limit, or because the physics failed; never with `terminated`
    info: dict[str, np.ndarray]  # name -> (N,)


class Episodes:
    """The designs and states of N episodes.

    Copies and pickles leave the hardware and the views behind, which are made again: all that changes is in the states.
    """

    def _open(self, task: Task, environments: int, limit: int) -> None:
        """Begin without episodes; each will end after `limit` steps at the latest."""
        self.task = task
        self._limit = limit
        self._phi = np.tile(task.design_space.initial, (environments, 1))
        self._s = np.zeros((environments, task.state_size))
        self._steps = np.zeros(environments, dtype=int)
        self._begun = np.zeros(environments, dtype=bool)
        self._ended = np.zeros(environments, dtype=bool)
        self._made: dict[bytes, Hardware] = {}
        self._views: dict[bytes, View] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_made": {}, "_views": {}}

    def _check_begun(self, call: str) -> None:
        if not self._begun.all():
            raise ResetNeeded(f"no episode has begun: call reset() before {call}()")

    def _build(self, phi: np.ndarray) -> None:
        """Take designs (N, d); where one can't be made, the error leaves the present ones in place."""
        made = {design.tobytes(): self._hw_phy(design) for design in (*phi, _one_or_all(phi))}
        self._views = {key: view for key, view in self._views.items() if key in made}
        self._phi, self._made = phi.copy(), made

    def _hw_phy(self, phi: np.ndarray) -> Hardware:
        """Return the Hw-Phy of designs (d,) or (N, d), made once."""
        key = phi.tobytes()
        if key not in self._made:
            self._made[key] = self.task.hw_phy(phi)
        return self._made[key]

    def _begin(self, chosen: np.ndarray, generators: Sequence[np.random.Generator]) -> None:
        """Start new episodes in the environments `chosen` (N,), each from its own generator alone."""
        for i in np.flatnonzero(chosen).tolist():
            self._s[i] = self.task.reset(self._hw_phy(self._phi[i]), 1, generators[i])[0]
        self._steps[chosen], self._begun[chosen], self._ended[chosen] = 0, True, False

    def _advance(self, action: np.ndarray) -> Outcome:
        """Execute actions (N, action_size)."""
        before = self._s
        transition = self.task.step(self._hw_phy(_one_or_all(self._phi)), before, action)
        diverged = transition.diverged | ~_is_sound(transition)
        self._s = np.where(diverged[:, None], before, transition.s)
        self._steps = self._steps + 1
        terminated = transition.terminated & ~diverged
        truncated = (diverged | (self._steps >= self._limit)) & ~terminated
        self._ended = terminated | truncated
        terms = {f"reward_{name}": np.where(diverged, 0.0, term) for name, term in transition.reward_terms.items()}
        info = {**terms, "success": transition.success & ~diverged, "diverged": diverged}
        return Outcome(np.where(diverged, 0.0, transition.reward), terminated, truncated, info)

    def _observe(self) -> np.ndarray:
        """Return what the policies see, (N, observation_size) float32."""
        return self.task.observe(self._s)

    def _frame(self, i: int) -> np.ndarray:
        """Return a picture (h, w, 3) uint8 of environment i."""
        phi = self._phi[i]
        key = phi.tobytes()
        if key not in self._views:
            self._views[key] = View(self.task, phi, self._hw_phy(phi))
        return self._views[key].frame(self._s[i])


def _is_sound(transition: Transition) -> np.ndarray:
    """Tell of each episode (N,) whether its state is a number that can be observed, and its reward one at all."""
    largest = np.abs(transition.s).max(1, initial=0.0)  # NaN where one is
    return (largest < np.finfo(np.float32).max) & np.isfinite(transition.reward)


def _one_or_all(phi: np.ndarray) -> np.ndarray:
    """Return the design (d,) that all environments have, or the designs (N, d)."""
    return phi[0] if (phi == phi[0]).all() else phi
