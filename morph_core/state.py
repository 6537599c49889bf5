"""Everything of a run that lives from one iteration to the next: what a user may edit, and what a checkpoint holds."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from morph_core.config import Config, Projection
from morph_core.design import DesignSpace
from morph_core.networks import Critic, Policy, Proxy
from morph_core.task import Task


@dataclass
class Learner:
    """theta, psi and the critic, each with its optimiser."""

    policy: Policy
    critic: Critic
    proxy: Proxy
    control_optimizer: torch.optim.Adam
    proxy_optimizer: torch.optim.Adam

    @property
    def modules(self) -> dict[str, nn.Module]:
        return {"policy": self.policy, "critic": self.critic, "proxy": self.proxy}

    @property
    def optimizers(self) -> dict[str, torch.optim.Adam]:
        return {"control": self.control_optimizer, "proxy": self.proxy_optimizer}


@dataclass
class State:
    """A method reads it at the start of an iteration and has changed it at the end; in between it is the caller's."""

    iteration: int
    env_steps: int
    phi: np.ndarray  # (d,)
    design_space: DesignSpace
    alpha: float
    projection: Projection
    learner: Learner
    rng: np.random.Generator
    fitted: bool = False
    """Whether the proxy has been fitted to Hw-Phy at the initial design."""


def start(task: Task, config: Config, seed: int, design_space: DesignSpace | None = None) -> State:
    """Return the state before the first iteration; everything random in a run comes from `seed`."""
    space = design_space or task.design_space
    weights = torch.Generator().manual_seed(seed)
    policy, critic, proxy = Policy(task, config, weights), Critic(task, config, weights), Proxy(task, config, weights)
    learner = Learner(
        policy, critic, proxy,
        torch.optim.Adam([*policy.parameters(), *critic.parameters()], config.learning_rate, fused=True),
        torch.optim.Adam(proxy.parameters(), config.proxy_learning_rate, fused=True),
    )  # fmt: skip
    return State(0, 0, space.initial, space, config.alpha, config.projection, learner, np.random.default_rng(seed))
