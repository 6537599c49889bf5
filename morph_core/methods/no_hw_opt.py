"""RL-NoHWOpt: the same PPO on Hw-Phy with the initial design."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from morph_core.exploration import run_trajectories
from morph_core.method import Method
from morph_core.protocol import Progress
from morph_core.task import Task

if TYPE_CHECKING:
    from morph_core.state import State


@dataclass(frozen=True)
class NoHwOpt(Method):
    """The paper's baseline RL-NoHWOpt: the policy learns on the initial design, and phi moves only when a user moves
    it."""

    name: ClassVar[str] = "no_hw_opt"
    title: ClassVar[str] = "the policy learns alone, φ stays as it is"

    def iterations(self, task: Task, state: "State") -> Iterator[Progress]:
        for iteration in itertools.count(state.iteration + 1):
            state.set_learning_rates(self, iteration)
            rollout = run_trajectories(task, state, task.hw_phy(state.phi), self.trajectories)
            if rollout.holds_enough:
                state.control.learn(state, rollout, iteration)
            yield state.advance(iteration, rollout)
