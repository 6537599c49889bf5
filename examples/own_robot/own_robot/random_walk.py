"""Method `random_walk`: phi takes a random step wherever that step did better."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from morph_core.config import Positive
from morph_core.exploration import run_trajectories
from morph_core.method import Method
from morph_core.protocol import Progress
from morph_core.spread import nearest_buildable
from morph_core.task import Task

if TYPE_CHECKING:
    from morph_core.state import State


@dataclass(frozen=True)
class RandomWalk(Method):
    """Half of the episodes run on phi, half on a neighbour: phi moves there where they returned more. The policy learns
    from both with the PPO of all methods."""

    step: Positive = 0.5
    """Standard deviation of a step of phi, in units of each parameter's scale."""

    name: ClassVar[str] = "random_walk"
    title: ClassVar[str] = "φ takes a random step where that did better"

    def iterations(self, task: Task, state: "State") -> Iterator[Progress]:
        half = self.trajectories // 2
        for iteration in itertools.count(state.iteration + 1):
            state.set_learning_rates(self, iteration)
            space = state.design_space
            step = self.step * space.scale * state.rng.standard_normal(len(space))
            neighbour = nearest_buildable(task, state.phi, space.clip(state.phi + step))
            state.explored = np.repeat([state.phi, neighbour], half, axis=0)
            rollout = run_trajectories(task, state, task.hw_phy(state.explored), self.trajectories)
            on_neighbour = rollout.kept.nonzero()[0] >= half
            if 0 < on_neighbour.sum() < len(on_neighbour):  # of both designs, some episodes did not diverge
                state.control.learn(state, rollout, iteration)
                if rollout.returns[on_neighbour].mean() > rollout.returns[~on_neighbour].mean():
                    state.phi = neighbour
            yield state.advance(iteration, rollout)
