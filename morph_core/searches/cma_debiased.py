"""Search `cma_debiased`: CMA-ES on the divergence without the variance of contact, for hands."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from morph_core.config import Count, NotNegative, Positive
from morph_core.divergence import limited
from morph_core.evolution import Evolution, Region, evolve
from morph_core.search import Problem, Search, mean_over_pairs
from morph_core.twin import Twin

if TYPE_CHECKING:
    from morph_core.hw_nn import HwNN

_SMALLEST_VARIANCE = 1e-6
"""Number in squared units of z that is added to the variance of z over designs, so that a component that nothing
changes is not divided by 0."""
_NARROWEST = 0.1
"""Least step size with which a warm CMA-ES begins, as a share of sigma0: it must still find a phi that has moved on."""


@dataclass(frozen=True)
class CmaDebiased(Search):
    """CMA-ES on the divergence of the mean physics of designs: E||F - m||^2 also holds the variance that contact gives
    F, which is least for a hand that touches nothing. Two independent halves multiplied with each other leave it out.
    """

    population: Annotated[int, Meta(ge=4)] = 10
    """Candidate designs per generation of CMA-ES."""
    generations: Count = 6
    """Generations of CMA-ES per search for phi."""
    sigma0: Positive = 0.3
    """sigma0: first step size of CMA-ES, in units of the explored designs' Sigma."""
    smear: Positive = 0.5
    """Spread of the designs over which a candidate's physics are averaged, in units of the explored designs' Sigma."""
    draws: Annotated[int, Meta(ge=2, multiple_of=2)] = 8
    """Number of designs, antithetic pairs around a candidate, over which the pairs (s, a) are dealt out in each half.
    All candidates of a generation share them, so that what they cost differs by the candidates alone."""
    drift_clip: NotNegative = 0.0
    """Limit of the difference between two designs' z, in units of z: a larger one compares a state in contact with one
    that is free. 0 sets no limit."""
    limit: Positive = 0.5
    """Largest change of each entry of phi in one search, in units of the explored designs' Sigma: the policy must be
    able to follow."""
    pull: NotNegative = 0.0
    """Cost of a change of phi by Sigma in one entry, which grows with its square."""
    target: Literal["proxy", "drift"] = "proxy"
    """What the physics are to match: the proxy itself, or the present design's physics changed by the drift, which is
    what the task asks of the proxy. The second leaves out where the proxy does not fit Hw-Phy."""
    settle: Literal["proxy", "nothing"] = "proxy"
    """What happens once phi has moved: the proxy starts again from what its twin learnt of Hw-Phy alone, or nothing."""
    start: Literal["phi", "warm"] = "phi"
    """Where CMA-ES begins: at phi with sigma0, or with the mean and step size with which the last search ended."""

    name: ClassVar[str] = "cma_debiased"

    def memory(self, hw_nn: "HwNN") -> "Ended":
        return Ended(copy.deepcopy(hw_nn), self.settle == "proxy")

    def candidates(self, problem: Problem) -> np.ndarray:
        """Return the one phi in the middle of CMA-ES's last distribution: of many noisy costs the least is luck."""
        memory, space, phi = problem.memory, problem.space, problem.start
        if not isinstance(memory, Ended):
            raise ValueError("the search cma_debiased needs the memory that it made before the first iteration")
        unit = problem.spread.sigma * space.scale
        lo, hi = np.maximum(space.lo, phi - self.limit * unit), np.minimum(space.hi, phi + self.limit * unit)
        mean, sigma0 = phi, self.sigma0
        if self.start == "warm" and memory.mean is not None:
            mean = np.clip(memory.mean, lo, hi)
            sigma0 = float(np.clip(memory.sigma, _NARROWEST * self.sigma0, self.sigma0))
        evolution = Evolution(self.population, self.generations, sigma0, problem.seed)
        ended = evolve(Region(space, mean, unit, lo, hi), evolution, self.costs(problem, memory, unit))
        memory.mean, memory.sigma = ended.mean, ended.sigma
        return ended.mean[None]

    def costs(self, problem: Problem, twin: Twin, unit: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Return the cost (P,) of candidates phi (P, d), with noise of its own each time it is called.

        mean over pairs of sum_d W_d e1_d e2_d, e_k = F_{phi' + delta_k}(s, a) - target, with W_d one over the variance
        of z_d over the explored designs.
        """
        dataset, rng = problem.dataset, np.random.default_rng(problem.seed)
        halves = [problem.physics.z_each(dataset.s, dataset.a, self._smeared(problem, problem.start[None], half))
                  for half in self._noise(problem, unit, rng)]  # fmt: skip
        change = limited((halves[0] - halves[1])[0] / 2, self.drift_clip)  # at two designs each, half their difference
        weight = 1 / (2 * np.nanmean(change**2, 0) + _SMALLEST_VARIANCE)
        drift = limited(twin.drift(dataset), self.drift_clip)

        def costs(candidates: np.ndarray) -> np.ndarray:
            errors = []
            for noise in self._noise(problem, self.smear * unit, rng):
                asked = candidates if self.target == "proxy" else np.concatenate([problem.start[None], candidates])
                z = problem.physics.z_each(dataset.s, dataset.a, self._smeared(problem, asked, noise))
                if self.target == "proxy":
                    errors.append(limited(z - dataset.z, self.drift_clip))
                else:
                    errors.append(limited(z[1:] - z[0], self.drift_clip) - drift)
            far = (((candidates - problem.start) / unit) ** 2).sum(-1)
            return split_halves(*errors, weight) + self.pull * far

        return costs

    def _noise(self, problem: Problem, unit: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
        """Return two independent halves of changes of phi (draws, d), antithetic pairs each."""
        halves = (problem.spread.noise(problem.space, self.draws // 2, rng) for _ in range(2))
        return [unit * np.concatenate([noise, -noise]) for noise in halves]

    def _smeared(self, problem: Problem, candidates: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return a design for each candidate and pair (P, n, d): the pairs are dealt out to the changes in turn."""
        dealt = noise[np.arange(len(problem.dataset.s)) % len(noise)]
        return problem.space.clip(candidates[:, None] + dealt)


def split_halves(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the weighted mean square (P,) of what two differences (P, n, z_size) with independent noise have in
    common: the square of their mean, without the variance of the noise."""
    return mean_over_pairs((first * second * weight).sum(-1))


@dataclass
class Ended(Twin):
    """The twin of the proxy, and how the last CMA-ES ended."""

    settles: bool
    mean: np.ndarray | None = None  # (d,)
    sigma: float = 0.0

    @property
    def facts(self) -> dict[str, object]:
        return {} if self.mean is None else {"mean": self.mean.tolist(), "sigma": self.sigma}

    def recall(self, facts: Mapping[str, Any]) -> None:
        if facts:
            self.mean, self.sigma = np.array(facts["mean"]), facts["sigma"]

    def proxy_was_fitted(self, hw_nn: "HwNN") -> None:
        """Let the reference start as the proxy is, and forget a mean that belonged to another phi."""
        super().proxy_was_fitted(hw_nn)
        self.mean = None

    def phi_was_found(self, hw_nn: "HwNN") -> None:
        if self.settles:
            super().phi_was_found(hw_nn)
