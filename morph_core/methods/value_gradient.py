"""`value_gradient`, the modern peer: one policy and critic for every design of the box, and phi climbs the critic."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np

from morph_core.config import Fraction, NotNegative, Settings, Share, most
from morph_core.design import DesignSpace
from morph_core.exploration import run_trajectories
from morph_core.method import Method
from morph_core.parts import Schedule
from morph_core.protocol import Progress
from morph_core.spread import drawn_back, nearest_buildable
from morph_core.task import Task

if TYPE_CHECKING:
    from morph_core.state import State


@dataclass(frozen=True)
class Window(Settings):
    """Part of the box in which designs are drawn: around phi, and narrower and narrower."""

    width: Fraction = 1.0
    """Width of the window at the start, as a share of each parameter's range; 1 is the whole box."""
    width_end: Fraction = 0.04
    """Width of the window at the end of the schedule, to which it falls geometrically, as a share of each parameter's
    range."""
    hold: Share = 0.1
    """Share of the schedule for which the window keeps its first width."""

    def at(self, schedule: Schedule, iteration: int) -> float:
        """Return the width of the window in an iteration, as a share of each parameter's range."""
        return schedule.geometric(self.width, self.width_end, iteration, self.hold)


@dataclass(frozen=True)
class ValueGradient(Method):
    """A policy and a critic that see phi learn on designs from all over the box, and phi climbs the critic's value.

    This is the idea of "Shape Your Body: Value Gradients for Multi-Embodiment Robot Design" (Bohlinger and Peters 2026,
    arXiv 2606.00702), as a peer of the methods here: each episode keeps a design of its own, PPO learns with phi in
    what policy and critic see, and phi goes where V(s_0, phi), averaged over start states, rises.

    It differs from the original in these points. There the critic is trained to its end on a fixed distribution of
    designs and frozen, and only then climbed; here one budget pays for both, as in the other methods: after a short
    wait phi takes a step an iteration, and the designs are drawn from a window of the box that begins as the whole of
    it and narrows around phi. There a penalty holds phi near a reference design; here the step has a length of its own,
    whatever the slope, and the box is the only limit. There the value is averaged over a fixed bank of states, here
    over the start states of the iteration. There one network for many robots reads a description of every joint, and
    control gains are design as well; here the parameters of one robot, scaled to its box, stand beside the observation
    of the plain network that all methods here have.

    Bounds and locks that a user edits are obeyed from the next iteration on, and phi goes on from an injected design.
    """

    step: Annotated[NotNegative, most(1.0, "a step is never longer than the box")] = 0.03
    """Root mean square of a step of phi over the free parameters at the start, as a share of each parameter's range."""
    step_end: Fraction = 0.3
    """Step of phi at the end of the schedule, to which it falls geometrically, as a fraction of the first one."""
    wait: Share = 0.05
    """Share of the schedule for which phi stays at the start, and where policy and critic start afresh: a critic that
    has learnt nothing says nothing of phi."""
    freeze_success: Share = 0.9
    """Share of successful trajectories from which on phi is frozen and every episode runs on it; 0 never freezes it.
    The step does not shrink where the slope is small: without an end it leads away from a design that was found."""
    designs: Window = Window()
    """Window of the box from which the designs of the episodes are drawn."""

    name: ClassVar[str] = "value_gradient"
    title: ClassVar[str] = "policy and critic see φ and learn all over the box, φ climbs the critic"
    sees_phi: ClassVar[bool] = True

    def iterations(self, task: Task, state: "State") -> Iterator[Progress]:
        for iteration in itertools.count(state.iteration + 1):
            state.set_learning_rates(self, iteration)
            width = 0.0 if state.frozen else self.designs.at(self.schedule, iteration)
            state.explored = designs_in_window(task, state, width, self.trajectories)
            world = task.hw_phy(state.explored)
            rollout = run_trajectories(task, state, world, self.trajectories, state.explored)
            if rollout.holds_enough:
                state.control.learn(state, rollout, iteration)
                age = iteration - state.control_start
                if not state.frozen and self.schedule.share(age) >= self.wait:
                    start = rollout.observation[0, :, : task.observation_size]
                    slope = state.control.value_slope(start, state.phi)
                    target = ascended(state.design_space, state.phi, slope, self._step(iteration))
                    state.phi = nearest_buildable(task, state.phi, target)
            yield state.advance(iteration, rollout, self.freeze_success)

    def _step(self, iteration: int) -> float:
        return self.step * self.schedule.geometric(1.0, self.step_end, iteration)


def designs_in_window(task: Task, state: "State", width: float, count: int) -> np.ndarray:
    """Return designs (count, d), uniform in a window of the box: antithetic pairs, locked entries kept.

    The window is `width` of each parameter's range wide and lies round phi, or beside it where the box ends. A design
    that can't be built is drawn back towards phi.
    """
    space, phi = state.design_space, state.phi
    size = width * (space.hi - space.lo)
    low = np.clip(phi - size / 2, space.lo, space.hi - size)
    half = state.rng.random((count // 2, len(space)))
    return drawn_back(task, phi, space.clip(low + size * np.concatenate([half, 1 - half])))


def ascended(space: DesignSpace, phi: np.ndarray, slope: np.ndarray, step: float) -> np.ndarray:
    """Return phi (d,) after a step up the slope dV/dphi (d,), inside the box, locked entries kept.

    The step is measured in shares of each parameter's range. Its root mean square over the free parameters is `step`;
    parameters that stand at a bound beyond which the slope leads do not take part.
    """
    width = space.hi - space.lo
    direction = np.where(space.free, slope * width, 0.0)
    direction[(phi <= space.lo) & (direction < 0) | (phi >= space.hi) & (direction > 0)] = 0.0
    length = np.sqrt((direction**2).sum() / max(1, space.free.sum()))
    return space.clip(phi + step * width * direction / (length + 1e-12))
