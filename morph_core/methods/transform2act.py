"""`transform2act`, the paper's rival: the design is the first action of an episode, and one PPO learns all actions."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from msgspec import Meta

from morph_core.config import most
from morph_core.exploration import run_trajectories
from morph_core.method import Method
from morph_core.protocol import Progress
from morph_core.spread import drawn_back, nearest_buildable
from morph_core.task import Task

if TYPE_CHECKING:
    import torch

    from morph_core.state import State
    from morph_core.two_stages import TwoStageControl


@dataclass(frozen=True)
class Transform2Act(Method):
    """The paper's baseline Transform2Act (Yuan et al. 2022): the first action of an episode is its design, which pays
    nothing, all others control it, and one PPO learns both.

    The design is a step from the initial one in the space that a sine maps to the box. Policy and critic see phi; the
    critic is told by a flag which stage it values, and advantages go straight through both stages. The present phi is
    the design of the mean step.

    It differs from the original in these points. Our robots keep their topology: there is no stage that adds and
    removes links, one action sets all parameters, and the graph networks, which share their weights between joints,
    reduce to one network each for design, control and value. PPO's settings, networks and observations are those of
    the other methods here, so gamma and learning rates are the task's, not .995 and 5e-5, and episodes are as many
    every iteration, not 50 thousand steps of them. The standard deviation of the actions falls by schedule, that of the
    design is learnt as in the original. The first action is not counted as an environment step: nothing is simulated.

    Bounds, locks and designs that a user sets are obeyed from the next iteration on: steps begin elsewhere, so that the
    mean step leads to where the design was moved. A design that can't be built is drawn back towards phi until it can.
    """

    design_std: Annotated[float, Meta(ge=0.02), most(2.0, "every design would lie on the edge of its box")] = 0.1
    """Standard deviation of the design's step at the start, in the mapped space where the bounds are -1 and 1."""
    credit: Literal["gae", "balanced"] = "gae"
    """Rule by which designs are credited: `gae` lets advantages go straight through both stages, as the original does;
    with `balanced` a design's advantage is the undiscounted return less the value, and each stage's advantages are
    standardised apart, as BodyGen (Lu et al. 2025) has it."""

    name: ClassVar[str] = "transform2act"
    title: ClassVar[str] = "each episode's first action is its φ, one PPO learns design and control"
    sees_phi: ClassVar[bool] = True

    def control(self, task: Task, weights: "torch.Generator") -> "TwoStageControl":
        from morph_core.two_stages import TwoStageControl

        return TwoStageControl(
            task, self.ppo, self.schedule, self.hidden, weights, self.design_std, self.credit == "balanced"
        )

    def rules(self) -> str:
        return f"{self.title}, credit of designs {self.credit}"

    def iterations(self, task: Task, state: "State") -> Iterator[Progress]:
        from morph_core.two_stages import TwoStageControl, design_of

        for iteration in itertools.count(state.iteration + 1):
            control, space = state.control, state.design_space
            if not isinstance(control, TwoStageControl):
                raise ValueError("the method transform2act needs the policies that it made before the first iteration")
            head = control.design_policy
            head.lead_to(space, state.phi)
            state.set_learning_rates(self, iteration)
            step = head.draw(self.trajectories, state.rng)
            designs = state.explored = drawn_back(task, state.phi, design_of(space, head.start.numpy() + step))
            rollout = run_trajectories(task, state, task.hw_phy(designs), self.trajectories, designs)
            if not rollout.holds_enough:
                yield state.advance(iteration, rollout)
                continue
            control.learn_both(state, rollout, step[rollout.kept], iteration)
            sigma = float((designs.std(0) / space.scale)[space.free].mean()) if space.free.any() else 0.0
            state.phi = nearest_buildable(task, state.phi, head.mean_design(space))
            yield state.advance(iteration, rollout, design_sigma=sigma)
