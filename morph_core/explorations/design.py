"""Exploration `design`: every episode runs on Hw-Phy with its own design, drawn around phi."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np

from morph_core.config import NotNegative, Positive, most
from morph_core.divergence import limited
from morph_core.exploration import Exploration, Pull, Relabelled
from morph_core.rollout import Rollout
from morph_core.spread import ExploredDesigns, Spread
from morph_core.task import Hardware, Task

if TYPE_CHECKING:
    from morph_core.state import State


@dataclass(frozen=True)
class Design(ExploredDesigns, Exploration):
    """Every episode runs on Hw-Phy with its own design around phi, so that what z explores is what a body can do."""

    kappa: Annotated[NotNegative, most(1e6, "Eq. 2 is summed in single precision, which would keep nothing else")] = 0.3
    """kappa: weight of the task's pull on the proxy."""
    z_sigma: Annotated[Positive, most(1e6, "z would carry no signal")] = 0.5
    """sigma_z: scale of the exploration of z, in units of z."""
    drift_clip: Annotated[NotNegative, most(1e6, "no two designs differ by more: it is no limit any more")] = 0.0
    """Limit of the difference between two designs' z, in units of z: a larger one compares a state in contact with one
    that is free. 0 sets no limit."""
    finish: Literal["policy_and_proxy", "policy"] = "policy_and_proxy"
    """What learns once phi is frozen: policy and proxy, or the policy alone, which saves the steps of relabelling."""

    name: ClassVar[str] = "design"

    def sigma_shown(self, spread: Spread) -> float:
        return spread.sigma

    def world(self, task: Task, state: "State", spread: Spread, trajectories: int) -> Hardware:
        return task.hw_phy(spread.designs(state, trajectories))

    @property
    def proxy_rests(self) -> bool:
        return self.finish == "policy"

    def pull(self, state: "State", rollout: Rollout, pairs: Relabelled, advantage: np.ndarray) -> Pull:
        """Return the pull linearised at F_phi.

        L_task = -kappa A (z - F_phi) . (m - F_phi) / sigma_z^2, with A the episode's standardised return and z what
        the episode's own design did. With the divergence its optimum is m = F_phi + eta E[A (z - F_phi) | s, a],
        eta = kappa / (2 alpha sigma_z^2). The plain score A log h is unbounded for negative A and diverges.
        """
        weight = self.advantage(rollout.returns)[pairs.episode]
        slope = -self.kappa / self.z_sigma**2 * weight[:, None] * limited(pairs.z - pairs.z_phi, self.drift_clip)
        gradient = slope.astype(np.float32)
        return lambda m, index: gradient[index] / np.float32(len(m))
