"""Search `cma_debiased`: CMA-ES on the divergence without the variance of contact, for hands."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from morph_core.config import Count, NotNegative, Positive
from morph_core.divergence import limited
from morph_core.search import Problem, Search, mean_over_pairs
from morph_core.twin import Twin

if TYPE_CHECKING:
    from morph_core.hw_nn import HwNN

_SMALLEST_VARIANCE = 1e-6
"""Number in squared units of z that is added to the variance of z over designs, so that a component that nothing
changes is not divided by 0."""
_NARROWEST = 0.1
"""Least standard deviation with which a warm CMA-ES begins, as a share of sigma0: what the proxy asks moves on."""


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
    """Longest step of phi in one search, in units of the explored designs' Sigma: the policy must be able to follow."""
    pull: NotNegative = 0.0
    """Cost of a step of phi by the explored designs' Sigma, which grows with its square."""
    target: Literal["proxy", "drift"] = "proxy"
    """What the physics are to match: the proxy itself, or the present design's physics changed by the drift, which is
    what the task asks of the proxy. The second leaves out where the proxy does not fit Hw-Phy."""
    settle: Literal["proxy", "nothing"] = "proxy"
    """What happens once phi has moved: the proxy starts again from what its twin learnt of Hw-Phy alone, or nothing."""
    start: Literal["fresh", "warm"] = "fresh"
    """How widely CMA-ES begins: with sigma0 along every axis, or as wide along each as the last search ended, at
    most with sigma0."""

    name: ClassVar[str] = "cma_debiased"

    def memory(self, hw_nn: "HwNN") -> "Ended":
        return Ended(copy.deepcopy(hw_nn), self.settle == "proxy")

    def candidates(self, problem: Problem) -> np.ndarray:
        """Return the one phi in the middle of CMA-ES's distributions, over the second half of its generations: of many
        noisy costs the least is luck. All is along the axes in which the explored designs vary independently."""
        memory, space = problem.memory, problem.space
        if not isinstance(memory, Ended):
            raise ValueError("the search cma_debiased needs the memory that it made before the first iteration")
        import cma

        free = space.free
        whiten = np.linalg.cholesky(problem.spread.correlations(space)[np.ix_(free, free)])
        costs, unit = self.costs(problem, memory), problem.spread.sigma * space.scale
        axes = max(2, len(whiten))  # cma needs two; the second of a single parameter means nothing

        def designs(steps: np.ndarray) -> np.ndarray:
            """Return phi (P, d) after steps (P, axes) in units of the explored Sigma, along its independent axes."""
            found = np.tile(problem.start, (len(steps), 1))
            found[:, free] += unit[free] * (steps[:, : len(whiten)] @ whiten.T)
            return space.clip(found)

        options = {
            "popsize": self.population,
            "maxiter": self.generations,
            "seed": problem.seed,
            "verbose": -9,
            "CMA_stds": self._first_stds(memory, axes),
        }
        es, means = cma.CMAEvolutionStrategy(np.zeros(axes), self.sigma0, options), []
        while not es.stop():
            steps = np.array(es.ask())
            es.tell(list(steps), (costs(designs(steps)) + self.pull * (steps**2).sum(-1)).tolist())
            means.append(es.mean)
        memory.stds = np.asarray(es.result.stds)
        step = np.mean(means[len(means) // 2 :], 0)
        step *= min(1.0, self.limit / (np.linalg.norm(step) + 1e-12))
        return designs(step[None])

    def _first_stds(self, memory: "Ended", axes: int) -> np.ndarray:
        """Return the first standard deviations (axes,), as shares of sigma0."""
        if self.start == "fresh" or memory.stds is None or len(memory.stds) != axes:  # a user has locked one since
            return np.ones(axes)
        return np.clip(memory.stds / self.sigma0, _NARROWEST, 1.0)

    def costs(self, problem: Problem, twin: Twin) -> Callable[[np.ndarray], np.ndarray]:
        """Return the cost (P,) of candidates phi (P, d), with noise of its own each time it is called.

        mean over pairs of sum_d W_d e1_d e2_d, e_k = F_{phi' + delta_k}(s, a) - target, with W_d one over the variance
        of z_d over the explored designs.
        """
        dataset, rng = problem.dataset, np.random.default_rng(problem.seed)
        unit = problem.spread.sigma * problem.space.scale
        halves = [problem.physics.z_each(dataset.s, dataset.a, self._smeared(problem, problem.start[None], half))
                  for half in self._noise(problem, unit, rng)]  # fmt: skip
        change = limited((halves[0] - halves[1])[0] / 2, self.drift_clip)  # at two designs each, half their difference
        weight = 1 / (2 * np.nanmean(change**2, 0) + _SMALLEST_VARIANCE)
        drift = limited(twin.drift(dataset), self.drift_clip)

        def errors(candidates: np.ndarray, noise: np.ndarray) -> np.ndarray:
            if self.target == "proxy":
                z = problem.physics.z_each(dataset.s, dataset.a, self._smeared(problem, candidates, noise))
                return limited(z - dataset.z, self.drift_clip)
            asked = np.concatenate([problem.start[None], candidates])
            z = problem.physics.z_each(dataset.s, dataset.a, self._smeared(problem, asked, noise))
            return limited(z[1:] - z[0], self.drift_clip) - drift

        def costs(candidates: np.ndarray) -> np.ndarray:
            first, second = (errors(candidates, noise) for noise in self._noise(problem, self.smear * unit, rng))
            return split_halves(first, second, weight)

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
    stds: np.ndarray | None = None  # (axes,)
    """Standard deviations of its last distribution, in units of the explored designs' Sigma; None before the first."""

    @property
    def facts(self) -> dict[str, object]:
        return {} if self.stds is None else {"stds": self.stds.tolist()}

    def recall(self, facts: Mapping[str, Any]) -> None:
        self.stds = np.array(facts["stds"]) if facts else None

    def phi_was_found(self, hw_nn: "HwNN") -> None:
        if self.settles:
            super().phi_was_found(hw_nn)
