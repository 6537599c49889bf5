"""Policy and critic with their optimiser, and how they learn: PPO (Schulman et al. 2017)."""

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from morph_core.networks import LARGEST_STD, SMALLEST_STD, Critic, Policy, log_normal_of, minibatches
from morph_core.parts import Ppo, Schedule
from morph_core.passes import Passes, clip_gradients
from morph_core.rollout import Rollout, advantages
from morph_core.task import Task

if TYPE_CHECKING:
    from morph_core.state import State

_HALF = torch.tensor(0.5)
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

    def of(self, index: Tensor) -> "Batch":
        """Return the steps with these indices (B',)."""
        return Batch(*(column.index_select(0, index) for column in vars(self).values()))


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
        further = len(self._task.design_space) if self._sees_phi else 0
        return Critic(self._task, self._ppo, self._hidden, weights, further)

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

    @torch.no_grad()
    def improve(self, batch: Batch, age: int, rng: np.random.Generator) -> None:
        """Take the gradient steps of one iteration, and keep the policy's std below its falling limit."""
        ppo, policy, critic = self._ppo, self.policy, self.critic
        mean, value = Passes(policy.mean), Passes(critic.value)
        of_policy, of_critic = list(policy.parameters()), list(critic.parameters())
        told = critic.told(batch.observation, batch.time)
        for _ in range(ppo.epochs):
            for index in minibatches(len(batch), ppo.minibatches, rng):
                some = batch.of(index)
                self._set_policy_gradient(mean, some)
                value_error = value.forward(told.index_select(0, index)) - some.value_target[:, None]
                value.backward(value_error * (1 / len(some)))  # of half the mean square
                clip_gradients(of_policy, ppo.max_grad_norm)
                clip_gradients(of_critic, 2 * ppo.max_grad_norm)
                self.optimizer.step()
        policy.limit_std(self._schedule.geometric(ppo.std, ppo.std_end, age))

    def value_slope(self, observation: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """Return dV/dphi (d,) of the critic's mean value at the start of episodes on phi (d,).

        `observation` (N, o) is what the task shows of their start states. ValueError for a policy that does not see
        phi.
        """
        seen = torch.from_numpy(self.policy.phi_seen(phi)).requires_grad_()
        told = torch.cat([torch.from_numpy(observation), seen.expand(len(observation), -1)], 1)
        value = self.critic(told, torch.zeros(len(told))).mean()
        (slope,) = torch.autograd.grad(value, seen)
        lo, hi = self._task.design_space.hard_box
        return slope.numpy().astype(float) * 2 / (hi - lo)

    def _set_policy_gradient(self, passes: Passes, batch: Batch) -> None:
        """Set the gradient of PPO's loss, the negative clipped surrogate less the entropy bonus, in the policy."""
        clip, log_std, advantage = self._ppo.clip_coef, self.policy.log_std, batch.advantage
        free = log_std.exp()
        std = free.clamp(SMALLEST_STD, LARGEST_STD)
        u = (batch.action - passes.forward(batch.observation)).div_(std)
        ratio = (log_normal_of(u, std) - batch.log_prob).exp_()
        limited = ratio.clamp(1 - clip, 1 + clip)
        # The smaller of both pulls; of two equal ones half, the other half being the limited one's, inside the clip.
        pulls = torch.heaviside(limited * advantage - ratio * advantage, _HALF)
        pulls.masked_fill_(limited == ratio, 1.0)
        slope = advantage * (-1 / len(batch)) * ratio * pulls  # dL / dlog pi
        slope = slope[:, None].repeat(1, u.shape[1])  # for each action, as autograd adds them up
        pull = slope * u  # dlog pi / dmean = u / std, dlog pi / dstd = (u^2 - 1) / std
        passes.backward(pull / std)
        of_std = pull.mul_(u.div_(std)).sum(0) - slope.sum(0) / std
        log_std.grad = of_std * (free == std) * free - self._ppo.entropy_coef

    def learn(self, state: "State", rollout: Rollout, iteration: int) -> np.ndarray:
        """Line 3 for theta: learn from a rollout, and start afresh after being stuck for too long.

        Return the standardised advantages (B,) float32 of the steps alive.
        """
        began = time.monotonic()
        batch = self.batch(rollout)
        self.improve(batch, iteration - state.control_start, state.rng)
        state.learnt_in = time.monotonic() - began
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
