"""Everything of a run that lives from one iteration to the next: what a user may edit, and what a checkpoint holds."""

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from morph_core.config import Config, Projection
from morph_core.design import DesignSpace
from morph_core.networks import Critic, Policy, Proxy
from morph_core.protocol import Progress
from morph_core.rollout import Rollout
from morph_core.task import Task


@dataclass
class Learner:
    """theta, psi and the critic, each with its optimiser."""

    policy: Policy
    critic: Critic
    proxy: Proxy
    reference: Proxy | None
    """A twin of the proxy that only learns Hw-Phy: what the task asks for is the proxy's difference from it.
    `search=drift` alone needs it."""
    control_optimizer: torch.optim.Adam
    proxy_optimizer: torch.optim.Adam
    reference_optimizer: torch.optim.Adam | None

    @property
    def modules(self) -> dict[str, nn.Module]:
        twin = {"reference": self.reference} if self.reference else {}
        return {"policy": self.policy, "critic": self.critic, "proxy": self.proxy, **twin}

    @property
    def optimizers(self) -> dict[str, torch.optim.Adam]:
        twin = {"reference": self.reference_optimizer} if self.reference_optimizer else {}
        return {"control": self.control_optimizer, "proxy": self.proxy_optimizer, **twin}

    def pair(self) -> None:
        """Let the reference start as the proxy is."""
        if self.reference:
            self.reference.load_state_dict(self.proxy.state_dict())

    def settle(self) -> None:
        """After a search by drift: phi has gone where the task drew the proxy, which starts again as the reference."""
        if self.reference and self.reference_optimizer:
            self.proxy.load_state_dict(self.reference.state_dict())
            self.proxy_optimizer.load_state_dict(copy.deepcopy(self.reference_optimizer.state_dict()))


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
    explored: np.ndarray | None = None  # (N, d)
    """The designs that the last iteration explored, for people; no checkpoint holds them."""
    frozen: bool = False
    """Whether phi stays, and with it every explored design."""
    relabelled_steps: int = 0
    """Steps of Hw-Phy outside of trajectories: relabelling, and the search for phi."""
    diverged: int = 0
    """Episodes left out because their simulation diverged."""
    control_start: int = 0
    """The iteration after which policy and critic last started afresh."""
    last_reached: int = 0
    """The last iteration in which episodes reached the first milestone of the task."""

    def advance(self, iteration: int, rollout: Rollout, config: Config) -> None:
        """Note that an iteration is over, and what its trajectories took."""
        self.iteration = iteration
        self.env_steps += rollout.steps
        self.diverged += rollout.diverged
        self.frozen = self.frozen or 0 < config.freeze_success <= rollout.success_rate

    def skip(self, iteration: int, rollout: Rollout, config: Config) -> Progress:
        """Note an iteration that leaves nothing to learn from: almost every simulation diverged."""
        self.advance(iteration, rollout, config)
        return Progress(
            iteration=iteration,
            env_steps=self.env_steps,
            phi=self.phi.tolist(),
            episode_return=rollout.mean_return,
            success=rollout.success_rate,
            policy_std=self.learner.policy.mean_std,
        )


def start(task: Task, config: Config, seed: int, design_space: DesignSpace | None = None) -> State:
    """Return the state before the first iteration; everything random in a run comes from `seed`."""
    space = design_space or task.design_space
    weights = torch.Generator().manual_seed(seed)
    policy, critic, control_optimizer = new_control(task, config, weights)
    proxy = Proxy(task, config, weights)
    reference = copy.deepcopy(proxy) if config.search == "drift" else None

    def proxy_optimizer(network: Proxy) -> torch.optim.Adam:
        return torch.optim.Adam(network.parameters(), config.proxy_learning_rate, fused=True)

    learner = Learner(
        policy, critic, proxy, reference,
        control_optimizer, proxy_optimizer(proxy), proxy_optimizer(reference) if reference else None,
    )  # fmt: skip
    return State(0, 0, space.initial, space, config.alpha, config.projection, learner, np.random.default_rng(seed))


def new_control(task: Task, config: Config, weights: torch.Generator) -> tuple[Policy, Critic, torch.optim.Adam]:
    """Return policy and critic as they are before anything is learnt, and their optimiser."""
    policy, critic = Policy(task, config, weights), Critic(task, config, weights)
    parameters = [*policy.parameters(), *critic.parameters()]
    return policy, critic, torch.optim.Adam(parameters, config.learning_rate, fused=True)
