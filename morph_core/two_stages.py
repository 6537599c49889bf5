"""PPO over two stages (Transform2Act): an episode's first action is its design, all others control it."""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from morph_core.control import Batch, Control
from morph_core.design import DesignSpace
from morph_core.networks import LARGEST_STD, SMALLEST_STD, Critic, log_normal, minibatches, mlp
from morph_core.parts import Ppo, Schedule
from morph_core.passes import clip_gradients
from morph_core.rollout import Rollout, advantages
from morph_core.task import Task

if TYPE_CHECKING:
    from morph_core.state import State

ROUNDING = 1e-9
"""Share of a parameter's range by which designs differ that are the same but for rounding."""


def design_of(space: DesignSpace, p: np.ndarray) -> np.ndarray:
    """Return designs (..., d) of p (..., d) in the mapped space: -1 and 1 are the bounds, and whatever lies beyond
    comes back from them; locked entries at their value."""
    return space.clip(space.lo + (space.hi - space.lo) * (np.sin(math.pi / 2 * p) + 1) / 2)


def mapped(space: DesignSpace, phi: np.ndarray) -> np.ndarray:
    """Return the p (..., d) in [-1, 1] of designs (..., d)."""
    place = (phi - space.lo) / (space.hi - space.lo)
    return np.arcsin(np.clip(2 * place - 1, -1, 1)) * 2 / math.pi


class DesignPolicy(nn.Module):
    """Policy of the first stage: a normal distribution of the step from `start` in the mapped space.

    What it sees, the initial design in the mapped space, is the same in every episode.
    """

    seen: Tensor
    start: Tensor

    def __init__(self, task: Task, hidden: int, std: float, rng: torch.Generator) -> None:
        super().__init__()
        space = task.design_space
        self.mean = mlp(len(space), hidden, len(space), nn.Tanh, rng)
        last: Any = self.mean[-1]
        nn.init.orthogonal_(last.weight, 0.01, generator=rng)
        self.log_std = nn.Parameter(torch.full((len(space),), math.log(std)))
        start = torch.from_numpy(mapped(space, space.initial))
        self.register_buffer("seen", start.float())
        self.register_buffer("start", start)
        self.lead_to(space, space.initial)

    @property
    def std(self) -> Tensor:
        """Return the standard deviation (d,) of the step, kept within the limits of an action's."""
        return self.log_std.exp().clamp(SMALLEST_STD, LARGEST_STD)

    def mean_design(self, space: DesignSpace) -> np.ndarray:
        """Return the design (d,) of the mean step."""
        with torch.no_grad():
            return design_of(space, self.start.numpy() + self.mean(self.seen).numpy())

    def lead_to(self, space: DesignSpace, phi: np.ndarray) -> None:
        """Let steps begin elsewhere unless the mean step leads to phi (d,), so that it does."""
        off = (self.mean_design(space) - phi) / (space.hi - space.lo)
        if np.abs(off).max() < ROUNDING:
            return
        with torch.no_grad():
            self.start.copy_(torch.from_numpy(mapped(space, phi)) - self.mean(self.seen))

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return steps (count, d) float32."""
        with torch.no_grad():
            mean = self.mean(self.seen).numpy()
            return mean + self.std.numpy() * rng.standard_normal((count, len(mean)), dtype=np.float32)

    def log_prob(self, step: Tensor, free: Tensor) -> Tensor:
        """Return the log probability (B,) of steps (B, d) in the entries that are `free`, a mask (d,)."""
        return log_normal(step[:, free], self.mean(self.seen)[free], self.std[free])


class TwoStageCritic(Critic):
    """Critic V(s, phi, t) of the control stage, and V of the design stage: a flag tells one from the other."""

    def __init__(self, task: Task, ppo: Ppo, hidden: int, rng: torch.Generator) -> None:
        super().__init__(task, ppo, hidden, rng, len(task.design_space) + 1)
        self._observation_size = task.observation_size

    def forward(self, observation: Tensor, time: Tensor) -> Tensor:
        """Return values (...) of the control stage for observations (..., o) at times (...) in [0, 1)."""
        return super().forward(torch.cat([observation, torch.zeros_like(time)[..., None]], -1), time)

    def of_design_stage(self, seen: Tensor) -> Tensor:
        """Return the value () of the design stage, in which nothing is observed but the initial design (d,)."""
        nothing = torch.zeros(self._observation_size)
        return super().forward(torch.cat([nothing, seen, torch.ones(1)]), torch.zeros(()))


@dataclass(frozen=True)
class TwoStageBatch(Batch):
    """Steps of both stages: the rows of the control stage come first, then one row for each episode's design."""

    step: Tensor  # (N, d)
    free: Tensor  # (d,) bool: which entries of the design may move
    step_log_prob: Tensor  # (N,)
    design_advantage: Tensor  # (N,) standardised
    design_target: Tensor  # (N,)

    def __len__(self) -> int:
        return len(self.time) + len(self.step)


class TwoStageControl(Control):
    """Design policy, policy and critic, which learn by one PPO over both stages."""

    critic: TwoStageCritic

    def __init__(
        self, task: Task, ppo: Ppo, schedule: Schedule, hidden: int, weights: torch.Generator, design_std: float,
        balanced: bool,
    ) -> None:  # fmt: skip
        self._balanced = balanced
        # Made once: it stays where policy and critic start afresh.
        self.design_policy = DesignPolicy(task, hidden, design_std, weights)
        super().__init__(task, ppo, schedule, hidden, weights, sees_phi=True)

    def _new_critic(self, weights: torch.Generator) -> TwoStageCritic:
        return TwoStageCritic(self._task, self._ppo, self._hidden, weights)

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Return every network, by the name under which a checkpoint holds it."""
        return {**super().modules, "design_policy": self.design_policy}

    def two_stages(self, rollout: Rollout, step: np.ndarray, free: np.ndarray) -> TwoStageBatch:
        """Return the steps alive of the control stage and the steps (N, d) of the design stage before them.

        Advantages go straight through both stages, and are standardised together; `balanced` ones of the design are
        undiscounted returns less the value, and each stage's are standardised apart.
        """
        control, alive = self.batch(rollout), rollout.alive
        episodes = alive.shape[1]
        with torch.no_grad():
            values = np.zeros((len(alive) + 1, episodes))
            values[0] = float(self.critic.of_design_stage(self.design_policy.seen))
            values[1:][alive] = self.critic(control.observation, control.time).numpy()
            log_prob = self.design_policy.log_prob(torch.from_numpy(step), torch.from_numpy(free))
        through = replace(
            rollout,
            reward=np.concatenate([np.zeros((1, episodes)), rollout.reward]),
            alive=np.concatenate([np.ones((1, episodes), dtype=bool), alive]),
        )
        advantage = advantages(through, values, self._ppo.gamma, self._ppo.gae_lambda)
        if self._balanced:
            advantage[0] = rollout.returns - values[0]
        of_design, of_control = _tensor(advantage[0]), _tensor(advantage[1:][alive])
        target = of_design + _tensor(values[0])
        if self._balanced:
            of_design, of_control = _standardised(of_design), _standardised(of_control)
        else:
            together = _standardised(torch.cat([of_design, of_control]))
            of_design, of_control = together[:episodes], together[episodes:]
        return TwoStageBatch(
            **vars(replace(control, advantage=of_control)),
            step=torch.from_numpy(step), free=torch.from_numpy(free), step_log_prob=log_prob,
            design_advantage=of_design, design_target=target,
        )  # fmt: skip

    def improve_both(self, batch: TwoStageBatch, age: int, rng: np.random.Generator) -> None:
        """Take the gradient steps of one iteration over both stages, and keep the policy's std below its limit."""
        ppo = self._ppo
        for _ in range(ppo.epochs):
            for index in minibatches(len(batch), ppo.minibatches, rng):
                self.optimizer.zero_grad()
                self._loss(batch, index).backward()
                for module in self.modules.values():
                    largest = 2 * ppo.max_grad_norm if module is self.critic else ppo.max_grad_norm
                    clip_gradients(module.parameters(), largest)
                self.optimizer.step()
        self.policy.limit_std(self._schedule.geometric(ppo.std, ppo.std_end, age))

    def _loss(self, batch: TwoStageBatch, index: Tensor) -> Tensor:
        """Return PPO's loss, the mean over rows of either stage."""
        rows, clip = len(batch.time), self._ppo.clip_coef
        i, design = index[index < rows], index[index >= rows] - rows
        now = self.policy.log_prob(batch.observation[i], batch.action[i])
        now_design = self.design_policy.log_prob(batch.step[design], batch.free)
        before = torch.cat([batch.log_prob[i], batch.step_log_prob[design]])
        ratio = (torch.cat([now, now_design]) - before).exp()
        advantage = torch.cat([batch.advantage[i], batch.design_advantage[design]])
        surrogate = torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()
        value = self.critic.of_design_stage(self.design_policy.seen)
        value_error = torch.cat(
            [
                self.critic(batch.observation[i], batch.time[i]) - batch.value_target[i],
                value - batch.design_target[design],
            ]
        )
        entropy = self.policy.log_std.sum()  # of actions alone: there are so few designs that it would outweigh them
        return 0.5 * (value_error**2).mean() - surrogate - self._ppo.entropy_coef * entropy

    def learn_both(self, state: "State", rollout: Rollout, step: np.ndarray, iteration: int) -> None:
        """Learn from a rollout and the steps (N, d) that led to its designs, and start afresh after being stuck for too
        long."""
        batch = self.two_stages(rollout, step, state.design_space.free)
        self.improve_both(batch, iteration - state.control_start, state.rng)
        self._restart_where_stuck(state, rollout, iteration)


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))


def _standardised(values: Tensor) -> Tensor:
    return (values - values.mean()) / (values.std() + 1e-8)
