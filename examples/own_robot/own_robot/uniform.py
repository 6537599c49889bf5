"""Exploration `uniform`: every episode runs on its own design, drawn from a box around phi."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from morph_core.explorations.design import Design
from morph_core.spread import Spread
from morph_core.task import Hardware, Task

if TYPE_CHECKING:
    from morph_core.state import State


@dataclass(frozen=True)
class Uniform(Design):
    """Designs are drawn uniformly from a box around phi, with the same Sigma as `design` has; the rest is the same."""

    name: ClassVar[str] = "uniform"

    def world(self, task: Task, state: "State", spread: Spread, trajectories: int) -> Hardware:
        space = state.design_space
        half_width = np.sqrt(3) * spread.sigma * space.scale  # of a uniform distribution with this Sigma
        half = state.rng.uniform(-half_width, half_width, (trajectories // 2, len(space)))
        state.explored = space.clip(state.phi + np.concatenate([half, -half]))
        return task.hw_phy(state.explored)
