"""Exploration `gaussian_iid`: trajectories in the proxy's world, with noise on z that is drawn afresh at every call."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np

from morph_core.config import Positive, most
from morph_core.exploration import Exploration, Pull, Relabelled
from morph_core.parts import Schedule
from morph_core.rollout import Rollout
from morph_core.spread import ExploredDesigns, Spread
from morph_core.task import Hardware, Task

if TYPE_CHECKING:
    from morph_core.state import State

LARGEST_LOG_RATIO = 10.0
"""Largest logarithm of a probability ratio, so that the ratio of a z that the proxy has left far behind does not
overflow."""


@dataclass(frozen=True)
class GaussianIid(Exploration):
    """Trajectories run in the proxy's world with independent Gaussian noise on its z: the first reading of the paper.

    Hardly any of what such noise tries could be done by a design, and phi arrives in no run; `gaussian` settles what
    the paper leaves open so that it does.
    """

    noise: Annotated[Positive, most(1e6, "z would carry no signal")] = 0.1
    """sigma_z: standard deviation of z around the proxy's output, in units of z."""
    clip_coef: Annotated[Positive, most(100.0, "a ratio that may change a hundredfold is not clipped")] = 0.6
    """Clip of the probability ratio of z, as in PPO."""

    name: ClassVar[str] = "gaussian_iid"

    def check(self, task: Task) -> None:
        if not task.runs_on_proxy:
            raise ValueError(
                f"{task.name} can't be explored by \"gaussian_iid\": it can't be simulated in the proxy's world; "
                'choose from: "design"'
            )

    def spread(self, schedule: Schedule, iteration: int, frozen: bool) -> Spread:
        """Return the default spread: no designs are explored, and only a search that averages over some asks."""
        return ExploredDesigns().spread(schedule, iteration, frozen)

    def world(self, task: Task, state: "State", spread: Spread, trajectories: int) -> Hardware:
        return NoisyProxy(state.hw_nn, self.noise, state.rng)

    def pull(self, state: "State", rollout: Rollout, pairs: Relabelled, advantage: np.ndarray) -> Pull:
        """Return the gradient of PPO's clipped surrogate with the probability ratio of z.

        r = N(z; m, sigma) / N(z; m_before, sigma), L = -mean(min(r A, clip(r) A)).
        """
        import torch

        from morph_core.networks import log_normal

        weight = torch.from_numpy(advantage[pairs.row])
        z = torch.from_numpy(pairs.z.astype(np.float32))
        m_before = torch.from_numpy(state.hw_nn(pairs.s, pairs.a).astype(np.float32))
        sigma = torch.tensor(self.noise)
        log_before = log_normal(z, m_before, sigma)

        def pull(m: np.ndarray, index: np.ndarray) -> np.ndarray:
            output = torch.from_numpy(m).requires_grad_()
            log_ratio = log_normal(z[index], output, sigma) - log_before[index]
            ratio = log_ratio.clamp(-LARGEST_LOG_RATIO, LARGEST_LOG_RATIO).exp()
            limited = ratio.clamp(1 - self.clip_coef, 1 + self.clip_coef)
            loss = -torch.min(ratio * weight[index], limited * weight[index]).mean()
            return torch.autograd.grad(loss, output)[0].numpy()

        return pull


@dataclass(frozen=True)
class NoisyProxy:
    """The proxy's world with z ~ N(h_psi(s, a), sigma^2), as `Hardware`."""

    proxy: Hardware
    sigma: float
    rng: np.random.Generator

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        z = self.proxy(s, a)
        return z + self.sigma * self.rng.standard_normal(z.shape)
