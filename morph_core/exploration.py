"""How z is explored, so that the policy gradient can reach psi: one world to collect in, one pull on the proxy each."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from morph_core.config import Config
from morph_core.design import DesignSpace
from morph_core.networks import Proxy, log_normal
from morph_core.rollout import Rollout, collect
from morph_core.state import State
from morph_core.task import Hardware, Task

HALVINGS = 8
"""Steps back from a design that can't be built."""

Pull = Callable[[Tensor, Tensor], Tensor]
"""proxy outputs m (B, z_size) of the samples with indices (B,) -> dL_task/dm (B, z_size)"""


def annealed(first: float, last: float, iteration: int, config: Config, hold: float = 0.0) -> float:
    """Return a value that goes geometrically from first to last over the schedule, after a `hold` share of it."""
    share = min(1.0, (iteration - 1) / max(1, config.schedule_iterations - 1))
    return first * (last / first) ** (max(0.0, share - hold) / max(1e-9, 1 - hold))


def design_sigma(iteration: int, config: Config) -> float:
    """Sigma of the explored designs in units of each parameter's scale, while phi is not frozen."""
    return annealed(config.design_sigma, config.design_sigma_end, iteration, config, config.schedule_hold)


def design_noise(space: DesignSpace, count: int, correlation: float, rng: np.random.Generator) -> np.ndarray:
    """Return standard normal noise (count, d); the parameters of a group have the share `correlation` in common."""
    noise = rng.standard_normal((count, len(space)))
    for group in space.groups if correlation else []:
        common = rng.standard_normal((count, 1))
        noise[:, group] = np.sqrt(1 - correlation) * noise[:, group] + np.sqrt(correlation) * common
    return noise


def explore_designs(state: State, count: int, sigma: float, correlation: float = 0.0) -> np.ndarray:
    """Return designs (N, d) around phi: antithetic pairs, inside the box, locked entries kept."""
    space = state.design_space
    half = design_noise(space, count // 2, correlation, state.rng)
    state.explored = space.clip(state.phi + sigma * space.scale * np.concatenate([half, -half]))
    return state.explored


def nearest_buildable(task: Task, phi: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return `target` (d,), or the nearest point halved back towards phi that can be built."""
    for _ in range(HALVINGS):
        if task.buildable(target):
            return target
        target = (phi + target) / 2
    return phi


def episode_advantage(returns: np.ndarray, config: Config) -> np.ndarray:
    """Return what episodes (N,) count: their standardised returns, or CMA-ES's weights of their ranks."""
    if config.utility == "log_rank":
        rank = (-returns).argsort().argsort()  # 0 is the best
        returns = np.maximum(0.0, np.log(len(returns) / 2 + 1) - np.log(rank + 1))
    limit = config.advantage_limit
    return np.clip((returns - returns.mean()) / (returns.std(ddof=1) + 1e-8), -limit, limit)


@dataclass(frozen=True)
class Relabelled:
    """Sampled (s, a) of a rollout with what the explored world and Hw-Phy with the present phi say of them."""

    row: np.ndarray  # (B,) int, among the rollout's steps alive
    episode: np.ndarray  # (B,) int
    s: np.ndarray  # (B, state_size)
    a: np.ndarray  # (B, action_size)
    z: np.ndarray  # (B, z_size)
    z_phi: np.ndarray  # (B, z_size) F_phi(s, a)
    steps: int
    """Steps of Hw-Phy that this took."""

    def __len__(self) -> int:
        return len(self.row)


def relabel_on_hardware(rollout: Rollout, hw_phy: Hardware, pairs: int, rng: np.random.Generator) -> Relabelled:
    """Sample (s, a), or take all where `pairs` is 0, and ask Hw-Phy; those whose simulation diverges are left out."""
    t, n = rollout.alive.nonzero()
    row = np.arange(len(t))
    if 0 < pairs < len(row):
        row = np.sort(rng.choice(row, pairs, replace=False))
    at = t[row], n[row]
    z_phi = hw_phy(rollout.s[at], rollout.a[at])
    sound = np.isfinite(z_phi).all(1)
    at = at[0][sound], at[1][sound]
    return Relabelled(row[sound], at[1], rollout.s[at], rollout.a[at], rollout.z[at], z_phi[sound], len(row))


def clip_drift(drift: np.ndarray, config: Config) -> np.ndarray:
    """Return differences of z, each limited to what contact leaves comparable."""
    return np.clip(drift, -config.drift_clip, config.drift_clip) if config.drift_clip else drift


def linearised_pull(rollout: Rollout, pairs: Relabelled, config: Config) -> Pull:
    """The pull of exploration `design`, linearised at F_phi.

    L_task = -kappa A (z - F_phi) . (m - F_phi) / sigma_z^2, with A the episode's standardised return and z what the
    episode's own design did. With the divergence its optimum is m = F_phi + eta E[A (z - F_phi) | s, a],
    eta = kappa / (2 alpha sigma_z^2). The plain score A log h is unbounded for negative A and diverges.
    """
    advantage = episode_advantage(rollout.returns, config)[pairs.episode]
    slope = -config.kappa / config.z_sigma**2 * advantage[:, None] * clip_drift(pairs.z - pairs.z_phi, config)
    gradient = torch.from_numpy(slope.astype(np.float32))
    return lambda m, index: gradient[index] / len(m)


def clipped_pull(pairs: Relabelled, m_before: Tensor, advantage: Tensor, config: Config) -> Pull:
    """The pull of exploration `gaussian`: PPO's clipped surrogate with the probability ratio of z."""
    advantage = advantage[torch.from_numpy(pairs.row)]
    z = torch.from_numpy(pairs.z.astype(np.float32))
    sigma = torch.tensor(config.z_noise)
    log_before = log_normal(z, m_before, sigma)

    def pull(m: Tensor, index: Tensor) -> Tensor:
        m = m.detach().requires_grad_()
        ratio = (log_normal(z[index], m, sigma) - log_before[index]).clamp(-10, 10).exp()
        limited = ratio.clamp(1 - config.z_clip_coef, 1 + config.z_clip_coef)
        loss = -torch.min(ratio * advantage[index], limited * advantage[index]).mean()
        return torch.autograd.grad(loss, m)[0]

    return pull


@dataclass(frozen=True)
class GaussianProxy:
    """The proxy's world with z ~ N(h_psi(s, a), z_noise^2), as `Hardware`."""

    proxy: Proxy
    sigma: float
    rng: np.random.Generator

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        z = self.proxy.hardware(s, a)
        return z + self.sigma * self.rng.standard_normal(z.shape)


def run_trajectories(task: Task, state: State, world: Hardware, config: Config) -> Rollout:
    """Sample H trajectories of the present policy in a world."""
    start = task.reset(world, config.trajectories, state.rng)
    return collect(task, lambda observation: state.learner.policy.act(observation, state.rng), world, start)


def explored_world(task: Task, state: State, config: Config, sigma: float) -> Hardware:
    """Line 2: the hardware in whose world this iteration's trajectories run."""
    if config.exploration == "gaussian":
        return GaussianProxy(state.learner.proxy, config.z_noise, state.rng)
    return task.hw_phy(explore_designs(state, config.trajectories, sigma, config.design_correlation))
