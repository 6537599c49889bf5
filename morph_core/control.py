"""Policy and critic with their optimiser, and how they learn: PPO (Schulman et al. 2017)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from morph_core.networks import Critic, Policy, minibatches
from morph_core.parts import Ppo, Schedule
from morph_core.rollout import Rollout, advantages
from morph_core.task import Task

if TYPE_CHECKING:
    from morph_core.state import State

REACHED = 0.02
"""Smallest share of an iteration's episodes with which a milestone counts as reached."""


@dataclass(frozen=True)
class Batch:
    """Steps of a rollout before the ends of its episodes, flattened: tensors of B rows."""

    observation: Tensor  # (B, o), ending with the design where the policy sees phi
    time: Tensor  # (B,) t / T
    action: Tensor  # (B, action_size)
    log_prob: Tensor  # (B,)
    advantage: Tensor  # (B,) standardised
    value_target: Tensor  # (B,)

    def __len__(self) -> int:
        return len(self.time)


class Control:
    """Policy pi_theta and critic with their Adam optimiser, which learn by PPO."""

    def __init__(
        self, task: Task, ppo: Ppo, schedule: Schedule, hidden: int, weights: torch.Generator, sees_phi: bool = False
    ) -> None:
        self._task, self._ppo, self._schedule, self._hidden, self._sees_phi = task, ppo, schedule, hidden, sees_phi
        self.start_afresh(weights)

    def start_afresh(self, weights: torch.Generator) -> None:
        """Make policy, critic and optimiser as they are before anything is learnt."""
        self.policy = Policy(self._task, self._ppo, self._hidden, weights, self._sees_phi)
        self.critic = self._new_critic(weights)
        parameters = [p for module in self.modules.values() for p in module.parameters()]
        self.optimizer = torch.optim.Adam(parameters, self._ppo.learning_rate, fused=True)

    def _new_critic(self, weights: torch.Generator) -> Critic:
        return Critic(self._task, self._hidden, weights, len(self._task.design_space) if self._sees_phi else 0)

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Return every network, by the name under which a checkpoint holds it."""
        return {"policy": self.policy, "critic": self.critic}

    def set_learning_rate(self, age: int) -> None:
        """Anneal linearly over the schedule; `age` counts the iterations since policy and critic started afresh."""
        factor = self._schedule.linear(self._ppo.learning_rate_end, age)
        self.optimizer.param_groups[0]["lr"] = self._ppo.learning_rate * factor

    def batch(self, rollout: Rollout) -> Batch:
        """Return the steps alive with advantages from the present critic (generalised advantage estimation)."""
        alive = rollout.alive
        observation = torch.from_numpy(rollout.observation[alive])
        time = torch.from_numpy((alive.nonzero()[0] / self._task.horizon).astype(np.float32))
        action = torch.from_numpy(rollout.action[alive])
        with torch.no_grad():
            values = np.zeros(alive.shape)
            values[alive] = self.critic(observation, time).numpy()
            log_prob = self.policy.log_prob(observation, action)
        advantage = advantages(rollout, values, self._ppo.gamma, self._ppo.gae_lambda)
        target = torch.from_numpy((advantage + values)[alive].astype(np.float32))
        counted = torch.from_numpy(advantage[alive].astype(np.float32))
        standard = (counted - counted.mean()) / (counted.std() + 1e-8)
        return Batch(observation, time, action, log_prob, standard, target)

    def improve(self, batch: Batch, age: int, rng: np.random.Generator) -> None:
        """Take the gradient steps of one iteration, and keep the policy's std below its falling limit."""
        ppo, policy, critic = self._ppo, self.policy, self.critic
        for _ in range(ppo.epochs):
            for index in minibatches(len(batch), ppo.minibatches, rng):
                advantage = batch.advantage[index]
                log_prob = policy.log_prob(batch.observation[index], batch.action[index])
                ratio = (log_prob - batch.log_prob[index]).exp()
                limited = ratio.clamp(1 - ppo.clip_coef, 1 + ppo.clip_coef)
                surrogate = torch.min(ratio * advantage, limited * advantage).mean()
                value_error = critic(batch.observation[index], batch.time[index]) - batch.value_target[index]
                loss = 0.5 * (value_error**2).mean() - surrogate - ppo.entropy_coef * policy.log_std.sum()
                self.optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(policy.parameters(), ppo.max_grad_norm)
                nn.utils.clip_grad_norm_(critic.parameters(), 2 * ppo.max_grad_norm)
                self.optimizer.step()
        policy.limit_std(self._schedule.geometric(ppo.std, ppo.std_end, age))

    def value_slope(self, observation: np.ndarray, designs: np.ndarray) -> np.ndarray:
        """Return dV/dphi (d,), averaged over episodes on `designs` (N, d) at their start.

        `observation` (N, o) is what the task shows of their start states. ValueError for a policy that does not see
        phi.
        """
        seen = torch.from_numpy(self.policy.phi_seen(designs)).requires_grad_()
        value = self.critic(torch.cat([torch.from_numpy(observation), seen], 1), torch.zeros(len(seen)))
        (slopes,) = torch.autograd.grad(value.sum(), seen)
        lo, hi = self._task.design_space.hard_box
        return slopes.numpy().mean(0, dtype=float) * 2 / (hi - lo)

    def learn(self, state: "State", rollout: Rollout, iteration: int) -> np.ndarray:
        """Line 3 for theta: learn from a rollout, and start afresh after being stuck for too long.

        Return the standardised advantages (B,) float32 of the steps alive.
        """
        batch = self.batch(rollout)
        self.improve(batch, iteration - state.control_start, state.rng)
        self._restart_where_stuck(state, rollout, iteration)
        return batch.advantage.numpy()

    def _restart_where_stuck(self, state: "State", rollout: Rollout, iteration: int) -> None:
        """Start afresh where no episode has reached the first milestone of the task for `restart_interval`."""
        first = next(iter(rollout.milestones.values()), None)
        if first is None or first.any(0).mean() >= REACHED:
            state.last_reached = iteration
        if 0 < self._ppo.restart_interval <= iteration - state.last_reached:
            self.begin_again(state, iteration)

    def begin_again(self, state: "State", iteration: int) -> None:
        """Start afresh with weights from the run's random numbers, and anneal from after `iteration` on."""
        self.start_afresh(torch.Generator().manual_seed(int(state.rng.integers(2**63))))
        state.control_start = state.last_reached = iteration
