"""Line 3 of Algorithm 1: Eq. 2 with PPO for policy and critic, and with projected gradients for the proxy."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from morph_core.config import Config
from morph_core.exploration import Pull, Relabelled, annealed
from morph_core.gradients import cosine, flatten, project, write_gradient
from morph_core.rollout import Rollout, advantages
from morph_core.state import Learner, State, new_control
from morph_core.task import Hardware, Task

REACHED = 0.02
"""Share of an iteration's episodes from which on a milestone counts as reached."""


@dataclass(frozen=True)
class Batch:
    """The steps of a rollout that count, flattened: tensors of B rows."""

    observation: Tensor  # (B, o)
    time: Tensor  # (B,) t / T
    action: Tensor  # (B, action_size)
    log_prob: Tensor  # (B,)
    advantage: Tensor  # (B,) standardised
    value_target: Tensor  # (B,)

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class ProxyUpdate:
    """What happened to psi in one iteration."""

    divergence: float
    cosine: float
    cosine_negative: float
    cosine_by_parameter: list[float | None] | None


def set_learning_rates(state: State, iteration: int, config: Config) -> None:
    """Anneal linearly over the schedule to `learning_rate_end` of the first ones."""

    def factor(age: int) -> float:
        return 1 - (1 - config.learning_rate_end) * min(1.0, (age - 1) / max(1, config.schedule_iterations - 1))

    learner = state.learner
    learner.control_optimizer.param_groups[0]["lr"] = config.learning_rate * factor(iteration - state.control_start)
    for optimizer in (learner.proxy_optimizer, learner.reference_optimizer):
        if optimizer:
            optimizer.param_groups[0]["lr"] = config.proxy_learning_rate * factor(iteration)


def make_batch(task: Task, learner: Learner, rollout: Rollout, config: Config) -> Batch:
    """Estimate advantages with the present critic and flatten what is alive."""
    alive = rollout.alive
    observation = torch.from_numpy(rollout.observation[alive])
    time = torch.from_numpy((alive.nonzero()[0] / task.horizon).astype(np.float32))
    action = torch.from_numpy(rollout.action[alive])
    with torch.no_grad():
        values = np.zeros(alive.shape)
        values[alive] = learner.critic(observation, time).numpy()
        log_prob = learner.policy.log_prob(observation, action)
    advantage = advantages(rollout, values, config.gamma, config.gae_lambda)
    target = torch.from_numpy((advantage + values)[alive].astype(np.float32))
    counted = torch.from_numpy(advantage[alive].astype(np.float32))
    standard = (counted - counted.mean()) / (counted.std() + 1e-8)
    return Batch(observation, time, action, log_prob, standard, target)


def minibatches(size: int, count: int, rng: np.random.Generator) -> list[Tensor]:
    """Return `count` shuffled, nearly equal index tensors over range(size)."""
    return [torch.from_numpy(part) for part in np.array_split(rng.permutation(size), min(count, size))]


def improve_control(state: State, batch: Batch, iteration: int, config: Config) -> None:
    """PPO (Schulman et al. 2017) on theta and the critic."""
    learner = state.learner
    policy, critic = learner.policy, learner.critic
    for _ in range(config.epochs):
        for index in minibatches(len(batch), config.minibatches, state.rng):
            advantage = batch.advantage[index]
            log_prob = policy.log_prob(batch.observation[index], batch.action[index])
            ratio = (log_prob - batch.log_prob[index]).exp()
            limited = ratio.clamp(1 - config.clip_coef, 1 + config.clip_coef)
            surrogate = torch.min(ratio * advantage, limited * advantage).mean()
            value_error = critic(batch.observation[index], batch.time[index]) - batch.value_target[index]
            loss = 0.5 * (value_error**2).mean() - surrogate - config.entropy_coef * policy.log_std.sum()
            learner.control_optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(policy.parameters(), config.max_grad_norm)
            nn.utils.clip_grad_norm_(critic.parameters(), 2 * config.max_grad_norm)
            learner.control_optimizer.step()
    age = iteration - state.control_start
    policy.limit_std(annealed(config.policy_std, config.policy_std_end, age, config))


def restart_control(task: Task, state: State, rollout: Rollout, iteration: int, config: Config) -> None:
    """Let policy and critic start afresh where they have been stuck before the first milestone of the task."""
    first = next(iter(rollout.milestones.values()), None)
    if first is None or first.any(0).mean() >= REACHED:
        state.last_reached = iteration
    if 0 < config.restart_interval <= iteration - state.last_reached:
        weights = torch.Generator().manual_seed(int(state.rng.integers(2**63)))
        learner = state.learner
        learner.policy, learner.critic, learner.control_optimizer = new_control(task, config, weights)
        state.control_start = state.last_reached = iteration


def improve_proxy(
    task: Task, state: State, pairs: Relabelled, hw_phy: Hardware, pull: Pull, config: Config
) -> ProxyUpdate:
    """Minimise L_task + alpha D over psi; where both gradients conflict, g_task is projected by the rule in force.

    The sampled (s, a) are data, so that D does not depend on theta: cosine and projection are over psi alone.
    """
    learner = state.learner
    proxy, psi = learner.proxy, list(learner.proxy.parameters())
    features = torch.from_numpy(task.proxy_input(pairs.s, pairs.a))
    target = torch.from_numpy(pairs.z_phi.astype(np.float32))  # (B, z_size)
    cosines, divergences = [], []
    for _ in range(config.epochs):
        for index in minibatches(len(features), config.minibatches, state.rng):
            m = proxy(features[index])
            error = m.detach() - target[index]
            g_hw = flatten(torch.autograd.grad(m, psi, 2 * error / len(index), retain_graph=True))
            g_task = flatten(torch.autograd.grad(m, psi, pull(m, index)))
            cosines.append(cosine(g_task, g_hw))
            divergences.append(float((error**2).sum(-1).mean()))
            write_gradient(psi, project(g_task, g_hw, state.projection) + state.alpha * g_hw)
            learner.proxy_optimizer.step()
            if learner.reference and learner.reference_optimizer:
                learner.reference_optimizer.zero_grad()
                ((learner.reference(features[index]) - target[index]) ** 2).sum(-1).mean().backward()
                learner.reference_optimizer.step()
    index = torch.linspace(0, len(pairs) - 1, min(config.search_pairs, len(pairs))).long()  # spread evenly
    with torch.no_grad():
        m = proxy(features[index])
    shares = cosine_by_parameter(
        hw_phy, pairs.s[index], pairs.a[index], g_task=pull(m, index).numpy(), g_hw=(m - target[index]).numpy()
    )
    return ProxyUpdate(
        float(np.mean(divergences)), float(np.mean(cosines)), float(np.mean(np.array(cosines) < 0)), shares
    )


def cosine_by_parameter(
    hw_phy: Hardware, s: np.ndarray, a: np.ndarray, g_task: np.ndarray, g_hw: np.ndarray
) -> list[float | None] | None:
    """Return each design parameter's share: the cosine of two gradients of z (n, z_size) along dz/dphi_i.

    None where Hw-Phy is not differentiable, and for a parameter that moves nothing in these n pairs.
    """
    jacobian = getattr(hw_phy, "jacobian", None)
    if jacobian is None:
        return None
    along_task, along_hw = (np.einsum("nzi,nz->ni", jacobian(s, a), g) for g in (g_task, g_hw))
    norms = np.linalg.norm(along_task, axis=0) * np.linalg.norm(along_hw, axis=0)
    dots = (along_task * along_hw).sum(0)
    return [float(dot / norm) if norm > 0 else None for dot, norm in zip(dots, norms, strict=True)]


def fit_proxy(task: Task, state: State, config: Config, pairs: int = 512) -> float:
    """Fit the proxy to Hw-Phy with the present phi before line 1; return the last divergence."""
    proxy = state.learner.proxy
    optimizer = torch.optim.Adam(proxy.parameters(), 2e-3)
    hw_phy = task.hw_phy(state.phi)
    loss = torch.zeros(())
    for step in range(config.proxy_prefit):
        s, a = task.sample_pairs(pairs, state.rng)
        z = hw_phy(s, a)
        state.relabelled_steps += len(z)
        sound = np.isfinite(z).all(1)
        if not sound.any():
            continue
        target = torch.from_numpy(z[sound].astype(np.float32))
        loss = ((proxy(torch.from_numpy(task.proxy_input(s[sound], a[sound]))) - target) ** 2).sum(-1).mean()
        optimizer.param_groups[0]["lr"] = 2e-3 * (1 - step / config.proxy_prefit) + 1e-5
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    state.learner.pair()
    return float(loss.detach())
