"""Three networks: policy pi_theta, critic, and the proxy Hw-NN h_psi."""

import copy
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from morph_core.config import InitialWeights
from morph_core.parts import Ppo
from morph_core.passes import Passes
from morph_core.task import Task

SMALLEST_STD, LARGEST_STD = 0.02, 2.0
LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


def mlp(
    inputs: int, hidden: int, outputs: int, activation: type[nn.Module], rng: torch.Generator,
    weights: InitialWeights = "uniform",
) -> nn.Sequential:  # fmt: skip
    """Return two hidden layers of `hidden` units, initialised from `rng`."""
    first, second, last = nn.Linear(inputs, hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, outputs)
    for layer in (first, second, last):
        if weights == "orthogonal":
            gain = 1.0 if layer is last else math.sqrt(2)
            nn.init.orthogonal_(layer.weight, gain, generator=rng)  # pyright: ignore[reportArgumentType]
            nn.init.zeros_(layer.bias)
            continue
        bound = 1 / math.sqrt(layer.in_features)
        nn.init.uniform_(layer.weight, -bound, bound, generator=rng)
        nn.init.uniform_(layer.bias, -bound, bound, generator=rng)
    return nn.Sequential(first, activation(), second, activation(), last)


def log_normal(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Return log N(x; mean, std^2), summed over the last dimension."""
    return log_normal_of((x - mean) / std, std)


def log_normal_of(u: Tensor, std: Tensor) -> Tensor:
    """Return log N(x; mean, std^2) of u = (x - mean) / std, summed over the last dimension."""
    return (-0.5 * u**2 - torch.log(std) - LOG_SQRT_2PI).sum(-1)


class Policy(nn.Module):
    """Policy pi_theta(a | s) = N(mu_theta(s), sigma_a), in units of the largest action.

    One that `sees_phi` is pi_theta(a | s, phi): its observations end with `phi_seen`.
    """

    hard_box: Tensor | None

    def __init__(self, task: Task, ppo: Ppo, hidden: int, rng: torch.Generator, sees_phi: bool = False) -> None:
        super().__init__()
        box = torch.from_numpy(task.design_space.hard_box) if sees_phi else torch.empty(2, 0)
        self.register_buffer("hard_box", box if sees_phi else None)  # which a checkpoint holds, so that exports know it
        seen = task.observation_size + box.shape[1]
        self.mean = mlp(seen, hidden, task.action_size, nn.Tanh, rng, ppo.initial_weights)
        nn.init.orthogonal_(self.mean[-1].weight, 0.01, generator=rng)  # pyright: ignore[reportArgumentType]
        with torch.no_grad():
            self.mean[-1].bias.copy_(torch.from_numpy(task.initial_action))  # pyright: ignore
        self.log_std = nn.Parameter(torch.full((task.action_size,), math.log(ppo.std)))

    @property
    def sees_phi(self) -> bool:
        """Whether observations end with the design."""
        return self.hard_box is not None

    def phi_seen(self, phi: np.ndarray) -> np.ndarray:
        """Return what is seen of designs phi (..., d), float32: each entry's place in the task's own box, from -1 to 1.

        ValueError for a policy that does not see phi.
        """
        if self.hard_box is None:
            raise ValueError("this policy does not see phi")
        lo, hi = self.hard_box.numpy()
        return (2 * (phi - lo) / (hi - lo) - 1).astype(np.float32)

    def at(self, phi: np.ndarray) -> "Policy":
        """Return the policy of one design phi (d,), which sees the observation alone: where this one sees phi, its
        first layer's bias takes in what phi adds there."""
        if not self.sees_phi:
            return self
        seen, policy = torch.from_numpy(self.phi_seen(phi)), copy.deepcopy(self)
        policy.hard_box = None
        first: Any = policy.mean[0]
        with torch.no_grad():
            first.bias += first.weight[:, -len(seen) :] @ seen
            first.weight = nn.Parameter(first.weight[:, : -len(seen)].contiguous())
        return policy

    @property
    def std(self) -> Tensor:
        """Return the standard deviation of each action, kept within its limits."""
        return self.log_std.exp().clamp(SMALLEST_STD, LARGEST_STD)

    @property
    def mean_std(self) -> float:
        """Return the mean of the actions' standard deviations."""
        return float(self.std.detach().mean())

    def act(self, observation: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
        """Return actions (N, action_size); the mean where `rng` is None."""
        with torch.no_grad():
            mean = Passes(self.mean).forward(torch.from_numpy(observation)).numpy()
            if rng is None:
                return mean
            return mean + self.std.numpy() * rng.standard_normal(mean.shape, dtype=np.float32)

    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return log pi(a | s) of actions (..., action_size) at observations (..., o)."""
        return log_normal(action, self.mean(observation), self.std)

    def limit_std(self, largest: float) -> None:
        """Lower the standard deviations that are larger than `largest`."""
        with torch.no_grad():
            self.log_std.clamp_(max=math.log(largest))


class Critic(nn.Module):
    """Critic V(s, t), which sees the time, because an episode ends at the horizon whatever the state.

    `further` counts the entries that follow the task's own in an observation, such as the design.
    """

    def __init__(self, task: Task, ppo: Ppo, hidden: int, rng: torch.Generator, further: int = 0) -> None:
        super().__init__()
        self.value = mlp(task.observation_size + further + 1, hidden, 1, nn.Tanh, rng, ppo.initial_weights)

    def forward(self, observation: Tensor, time: Tensor) -> Tensor:
        """Return values (...) for observations (..., o) at times (...) in [0, 1)."""
        return self.value(self.told(observation, time))[..., 0]

    @staticmethod
    def told(observation: Tensor, time: Tensor) -> Tensor:
        """Return what the critic's network sees (..., o + 1) of observations (..., o) at times (...)."""
        return torch.cat([observation, time[..., None]], -1)


class Proxy(nn.Module):
    """Network of the proxy Hw-NN, h_psi(z | s, a)."""

    def __init__(self, task: Task, hidden: int, rng: torch.Generator) -> None:
        super().__init__()
        self._task = task
        self.net = mlp(task.proxy_input_size, hidden, task.z_size, nn.SiLU, rng)

    def forward(self, features: Tensor) -> Tensor:
        """Return z (N, z_size) for `task.proxy_input` features."""
        return self.net(features) * self._task.z_scale

    def last_features(self, features: Tensor) -> Tensor:
        """Return what the last layer sees (N, k), a 1 for its bias included, times the scale of z: its weights times
        this is z."""
        hidden = self.net[:-1](features)
        return torch.cat([hidden, torch.ones_like(hidden[:, :1])], 1) * self._task.z_scale

    @property
    def last_weights(self) -> Tensor:
        """Return the weights (z_size, k) of the last layer, with its bias as the last column."""
        last: Any = self.net[-1]
        return torch.cat([last.weight, last.bias[:, None]], 1)


def minibatches(size: int, count: int, rng: np.random.Generator) -> list[Tensor]:
    """Return `count` shuffled, nearly equal index tensors over range(size)."""
    return [torch.from_numpy(part) for part in np.array_split(rng.permutation(size), min(count, size))]
