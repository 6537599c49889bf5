"""Hw-NN with its optimiser: the proxy fitted to Hw-Phy, and improved by Eq. 2 with projected gradients."""

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from morph_core.divergence import divergence, divergence_gradient
from morph_core.exploration import Metric, Pull, Relabelled
from morph_core.gradients import cosine, flatten, project, write_gradient
from morph_core.networks import Proxy, minibatches
from morph_core.parts import Ppo, ProxyFit
from morph_core.task import DifferentiableHardware, Hardware, Task

if TYPE_CHECKING:
    from morph_core.state import State

SMALLEST_LEARNING_RATE = 1e-5
"""Learning rate of Adam at the end of the fit before line 1."""


@dataclass(frozen=True)
class ProxyUpdate:
    """What happened to psi in one iteration."""

    divergence: float
    """D: mean squared distance of both hardware models, in squared units of z, over the gradient steps."""
    cosine: float
    """S_c of g_task, before it is projected, and g_hw: mean over the gradient steps."""
    cosine_negative: float
    """Share of the gradient steps with a negative cosine."""
    cosine_by_parameter: list[float | None] | None
    """How both gradients agree along dz/dphi of each design parameter, after the last step; None where Hw-Phy is not
    differentiable."""


class HwNN:
    """Proxy h_psi(z | s, a) as `Hardware`, and how it learns."""

    def __init__(self, task: Task, fit: ProxyFit, hidden: int, weights: torch.Generator) -> None:
        self.proxy = Proxy(task, hidden, weights)
        self.optimizer = torch.optim.Adam(self.proxy.parameters(), fit.learning_rate, fused=True)
        self._task, self._fit = task, fit

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return z (N, z_size) float64 for states and executed actions."""
        with torch.no_grad():
            return self.proxy(self.features(s, a)).numpy().astype(float)

    def __deepcopy__(self, memo: dict[int, object]) -> "HwNN":
        """Return a twin with the same weights, whose optimiser has seen nothing yet."""
        twin = object.__new__(HwNN)
        twin.proxy = copy.deepcopy(self.proxy)
        twin.optimizer = torch.optim.Adam(twin.proxy.parameters(), self._fit.learning_rate, fused=True)
        twin._task, twin._fit = self._task, self._fit
        return twin

    def features(self, s: np.ndarray, a: np.ndarray) -> Tensor:
        """Return what the network sees (N, proxy_input_size) float32 of (s, a) (N, ...)."""
        return torch.from_numpy(self._task.proxy_input(s, a))

    def last_features(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return what the last layer sees (N, k) float32, scaled so that `last_weights` times this is z."""
        with torch.no_grad():
            return self.proxy.last_features(self.features(s, a)).numpy()

    @property
    def last_weights(self) -> np.ndarray:
        """Return the weights (z_size, k) float32 of the last layer, its bias included."""
        return self.proxy.last_weights.detach().numpy()

    def set_learning_rate(self, factor: float) -> None:
        """Set Adam's learning rate to `factor` times the first one."""
        self.optimizer.param_groups[0]["lr"] = self._fit.learning_rate * factor

    def copy_weights(self, other: "HwNN") -> None:
        """Take over the weights of another proxy of the same shape."""
        self.proxy.load_state_dict(other.proxy.state_dict())

    def copy_moments(self, other: "HwNN") -> None:
        """Take over what another proxy's optimiser has seen."""
        self.optimizer.load_state_dict(copy.deepcopy(other.optimizer.state_dict()))

    def learn(self, features: Tensor, target: Tensor) -> None:
        """Take one gradient step on the divergence alone, from features (B, proxy_input_size) and z (B, z_size)."""
        self.optimizer.zero_grad()
        divergence(self.proxy(features), target).backward()
        self.optimizer.step()

    def fit(self, hw_phy: Hardware, rng: np.random.Generator) -> int:
        """Fit the proxy to Hw-Phy over the whole workspace, before line 1; return the steps of Hw-Phy that it took."""
        fit, steps = self._fit, 0
        optimizer = torch.optim.Adam(self.proxy.parameters(), fit.prefit_learning_rate)
        for step in range(fit.prefit):
            s, a = self._task.sample_pairs(fit.prefit_pairs, rng)
            z = hw_phy(s, a)
            steps += len(z)
            sound = np.isfinite(z).all(1)
            if not sound.any():
                continue
            target = torch.from_numpy(z[sound].astype(np.float32))
            left = 1 - step / fit.prefit
            optimizer.param_groups[0]["lr"] = fit.prefit_learning_rate * left + SMALLEST_LEARNING_RATE
            optimizer.zero_grad()
            divergence(self.proxy(self.features(s[sound], a[sound])), target).backward()
            optimizer.step()
        return steps

    def improve(
        self,
        state: "State",
        pairs: Relabelled,
        pull: Pull,
        metric: Metric,
        hw_phy: Hardware,
        ppo: Ppo,
        shown_pairs: int,
    ) -> ProxyUpdate:
        """Line 3: minimise L_task + alpha D over psi; where both gradients conflict, g_task is projected.

        The sampled (s, a) are data, so that D does not depend on theta: cosine and projection are over psi alone.
        `shown_pairs` of the pairs tell how the gradients agree along each design parameter. The divergence that is
        told is the mean squared distance at the pairs, whatever the metric.
        """
        psi = list(self.proxy.parameters())
        features = self.features(pairs.s, pairs.a)
        target = torch.from_numpy(pairs.z_phi.astype(np.float32))  # (B, z_size)
        weight = as_tensor(metric.weight)
        cosines, divergences = [], []
        for _ in range(ppo.epochs):
            for index in minibatches(len(features), ppo.minibatches, state.rng):
                m = self.proxy(features[index])
                z = m.detach()
                dl_dm = torch.from_numpy(pull(z.numpy(), index.numpy()))
                dd_dm = divergence_gradient(z, target[index], None if weight is None else weight[index])
                g_hw = flatten(torch.autograd.grad(m, psi, dd_dm, retain_graph=True))
                if metric.further is not None:
                    g_hw = g_hw + self._further_gradient(metric.further, metric.further_weight, len(index), state.rng)
                g_task = flatten(torch.autograd.grad(m, psi, dl_dm))
                cosines.append(cosine(g_task, g_hw))
                divergences.append(float(divergence(z, target[index])))
                write_gradient(psi, project(g_task, g_hw, state.projection) + state.alpha * g_hw)
                self.optimizer.step()
                state.memory.learn(features[index], target[index])
        shown = torch.linspace(0, len(pairs) - 1, min(shown_pairs, len(pairs))).long()  # spread evenly
        with torch.no_grad():
            m = self.proxy(features[shown])
        index = shown.numpy()  # to NumPy, a tensor of one number is a number
        difference = m - target[shown] if weight is None else weight[shown] * (m - target[shown])
        shares = cosine_by_parameter(
            hw_phy, pairs.s[index], pairs.a[index], g_task=pull(m.numpy(), index), g_hw=difference.numpy()
        )
        negative = float(np.mean(np.array(cosines) < 0))
        return ProxyUpdate(float(np.mean(divergences)), float(np.mean(cosines)), negative, shares)

    def _further_gradient(
        self, pairs: Relabelled, weight: np.ndarray | None, count: int, rng: np.random.Generator
    ) -> Tensor:
        """Return the flat gradient of D over psi at `count` pairs drawn from `pairs`."""
        index = rng.integers(len(pairs), size=count)
        m = self.proxy(self.features(pairs.s[index], pairs.a[index]))
        target = torch.from_numpy(pairs.z_phi[index].astype(np.float32))
        counted = as_tensor(None if weight is None else weight[index])
        dd_dm = divergence_gradient(m.detach(), target, counted)
        return flatten(torch.autograd.grad(m, list(self.proxy.parameters()), dd_dm))


def as_tensor(array: np.ndarray | None) -> Tensor | None:
    """Return an array as float32 tensor; None stays None."""
    return None if array is None else torch.from_numpy(array.astype(np.float32))


def cosine_by_parameter(
    hw_phy: Hardware, s: np.ndarray, a: np.ndarray, g_task: np.ndarray, g_hw: np.ndarray
) -> list[float | None] | None:
    """Return each design parameter's share: the cosine of two gradients of z (n, z_size) along dz/dphi_i.

    None where Hw-Phy is not differentiable, and for a parameter that moves nothing in these n pairs.
    """
    if not isinstance(hw_phy, DifferentiableHardware):
        return None
    along_task, along_hw = (np.einsum("nzi,nz->ni", hw_phy.jacobian(s, a), g) for g in (g_task, g_hw))
    norms = np.linalg.norm(along_task, axis=0) * np.linalg.norm(along_hw, axis=0)
    dots = (along_task * along_hw).sum(0)
    return [float(dot / norm) if norm > 0 else None for dot, norm in zip(dots, norms, strict=True)]
