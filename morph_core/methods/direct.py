"""`direct`, ours and not the paper's: a natural evolution strategy on phi from whole-episode returns."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

from morph_core.config import NotNegative, Share, most
from morph_core.exploration import run_trajectories
from morph_core.method import Method
from morph_core.protocol import Progress
from morph_core.spread import ExploredDesigns, nearest_buildable
from morph_core.task import Task

if TYPE_CHECKING:
    from morph_core.state import State


@dataclass(frozen=True)
class Direct(Method):
    """A natural evolution strategy on phi, without a proxy: the yardstick for how much design signal an iteration
    holds. Ours, not the paper's."""

    step: Annotated[NotNegative, most(1000.0, "every design would lie on the edge of its box")] = 1.5
    """Step size of the natural evolution strategy on phi."""
    freeze_success: Share = 0.0
    """Share of successful trajectories from which on phi is frozen and every episode runs on it; 0 never freezes it.
    Among episodes that all succeed, ranking is noise and would move phi at random."""
    designs: ExploredDesigns = ExploredDesigns()
    """Designs that are tried around phi, and what their episodes count."""

    name: ClassVar[str] = "direct"
    title: ClassVar[str] = "φ follows the returns of the designs that are explored"

    def iterations(self, task: Task, state: "State") -> Iterator[Progress]:
        for iteration in itertools.count(state.iteration + 1):
            state.set_learning_rates(self, iteration)
            spread = self.designs.spread(self.schedule, iteration, state.frozen)
            designs = spread.designs(state, self.trajectories)
            rollout = run_trajectories(task, state, task.hw_phy(designs), self.trajectories)
            if not rollout.holds_enough:
                yield state.advance(iteration, rollout, self.freeze_success)
                continue
            state.control.learn(state, rollout, iteration)
            advantage = self.designs.advantage(rollout.returns)
            # E[A (phi_i - phi)], the natural gradient
            step = (advantage[:, None] * (designs[rollout.kept] - state.phi)).mean(0)
            target = state.design_space.clip(state.phi + self.step * step)
            state.phi = nearest_buildable(task, state.phi, target)
            yield state.advance(iteration, rollout, self.freeze_success, design_sigma=spread.sigma)
