"""Everything of a run that lives from one iteration to the next: what a user may edit, and what a checkpoint holds."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from morph_core.config import Projection
from morph_core.control import Control
from morph_core.design import DesignSpace
from morph_core.exploration import Notes
from morph_core.hw_nn import HwNN
from morph_core.method import Method
from morph_core.protocol import Progress
from morph_core.rollout import Rollout
from morph_core.search import Memory
from morph_core.task import Task


@dataclass
class State:
    """Everything of a run that lives from one iteration to the next.

    A method reads it at the start of an iteration and has changed it at the end; in between it is the caller's.
    """

    iteration: int
    env_steps: int
    phi: np.ndarray  # (d,)
    design_space: DesignSpace
    alpha: float
    """alpha: weight of the divergence that is in force; 0 for a method without a proxy."""
    projection: Projection
    control: Control
    proxy: HwNN | None
    """Hw-NN with its optimiser; None for a method without a proxy."""
    memory: Memory
    """What the search for phi keeps from one iteration to the next."""
    notes: Notes
    """What the exploration keeps from one iteration to the next."""
    rng: np.random.Generator
    fitted: bool = False
    """Whether the proxy has been fitted to Hw-Phy at the initial design."""
    explored: np.ndarray | None = None  # (N, d)
    """The designs that the last iteration explored, for people; no checkpoint holds them."""
    generation: np.ndarray | None = None  # (P, d)
    """The designs that the last generation of the last search for phi tried, for people; no checkpoint holds them."""
    frozen: bool = False
    """Whether phi stays as it is, and every episode runs on it."""
    relabelled_steps: int = 0
    """Steps of Hw-Phy outside of trajectories and of the search for phi: the proxy's fit, relabelling, and what an
    exploration asks of designs."""
    search_steps: int = 0
    """Steps of Hw-Phy that the search for phi took."""
    diverged: int = 0
    """Episodes left out because their simulation diverged."""
    control_start: int = 0
    """The iteration after which policy and critic last started afresh."""
    last_reached: int = 0
    """The last iteration in which episodes reached the first milestone of the task."""
    collected_in: float = 0.0
    """Time that the trajectories of the last iteration took, in seconds; no checkpoint holds it."""
    learnt_in: float = 0.0
    """Time that policy and critic learnt in the last iteration, in seconds; no checkpoint holds it."""
    searched_in: float = 0.0
    """Time that the last search for phi took, in seconds; no checkpoint holds it."""

    @property
    def hw_nn(self) -> HwNN:
        """Return the proxy; ValueError for a method that has none."""
        if self.proxy is None:
            raise ValueError("this method has no proxy")
        return self.proxy

    @property
    def proxies(self) -> Mapping[str, HwNN]:
        """Return every proxy that learns, by the name under which a checkpoint holds it."""
        return ({"proxy": self.proxy} if self.proxy else {}) | dict(self.memory.learners)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Return every network, by the name under which a checkpoint holds it."""
        networks = {name: hw_nn.proxy for name, hw_nn in self.proxies.items()}
        return {**self.control.modules, **networks}

    @property
    def optimizers(self) -> Mapping[str, torch.optim.Adam]:
        """Return every optimiser, by the name under which a checkpoint holds it."""
        return {"control": self.control.optimizer, **{name: hw_nn.optimizer for name, hw_nn in self.proxies.items()}}

    def set_learning_rates(self, method: Method, iteration: int) -> None:
        """Anneal the rates of policy, critic and proxies over the schedule."""
        self.control.set_learning_rate(iteration - self.control_start)
        for hw_nn in self.proxies.values():
            hw_nn.set_learning_rate(method.schedule.linear(method.ppo.learning_rate_end, iteration))

    def fit_proxy(self, task: Task) -> None:
        """Fit the proxy to Hw-Phy with the present phi, unless that has been done: before line 1, and after phi was
        changed by a user."""
        if not self.fitted:
            self.relabelled_steps += self.hw_nn.fit(task.hw_phy(self.phi), self.rng)
            self.memory.proxy_was_fitted(self.hw_nn)
            self.fitted = True

    def advance(
        self,
        iteration: int,
        rollout: Rollout,
        freeze_success: float = 0.0,
        success: float | None = None,
        **metrics: object,
    ) -> Progress:
        """Note that an iteration is over, and return what is to be said of it.

        phi is frozen once `success`, by default that of the trajectories, reaches `freeze_success`; 0 never freezes it.
        An iteration without `metrics` left nothing to learn from: almost every simulation diverged.
        """
        self.iteration = iteration
        self.env_steps += rollout.steps
        self.diverged += rollout.diverged
        self.collected_in = rollout.seconds
        reached = rollout.success_rate if success is None else success
        self.frozen = self.frozen or 0 < freeze_success <= reached
        return Progress(
            iteration=iteration,
            env_steps=self.env_steps,
            phi=self.phi.tolist(),
            episode_return=rollout.mean_return,
            success=rollout.success_rate,
            policy_std=self.control.policy.mean_std,
            frozen=self.frozen,
            control_start=self.control_start,
            **metrics,  # pyright: ignore[reportArgumentType]
        )


def start(task: Task, method: Method, seed: int, design_space: DesignSpace | None = None) -> State:
    """Return the state before the first iteration; everything random in a run comes from `seed`."""
    space = design_space or task.design_space
    weights = torch.Generator().manual_seed(seed)
    control = method.control(task, weights)
    proxy = HwNN(task, method.proxy_fit, method.hidden, weights) if method.proxy_fit else None
    memory, notes = method.memory(proxy), method.notes()
    alpha, projection = method.steering
    rng = np.random.default_rng(seed)
    return State(0, 0, space.initial, space, alpha, projection, control, proxy, memory, notes, rng)
