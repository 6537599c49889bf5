"""Search `cma_debiased`: CMA-ES on the divergence without the variance of contact, for hands."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from msgspec import Meta

from morph_core.config import Count, NotNegative, Positive, most
from morph_core.divergence import limited
from morph_core.search import Problem, Search, mean_over_pairs
from morph_core.twin import Twin

if TYPE_CHECKING:
    from morph_core.hw_nn import HwNN

DRAWS = 4
"""Antithetic pairs of designs around a candidate, in each half: the pairs (s, a) are dealt out over them."""
SMALLEST_VARIANCE = 1e-6
"""Number in squared units of z that is added to the variance of z over designs, so that a component that nothing
changes is not divided by 0."""


@dataclass(frozen=True)
class CmaDebiased(Search):
    """CMA-ES on the divergence of the mean physics of designs: E||F - m||^2 also holds the variance that contact gives
    F, which is least for a hand that touches nothing. Two independent halves multiplied with each other leave it out.
    """

    population: Annotated[int, Meta(ge=4), most(1000, "each candidate costs a simulation of all pairs")] = 12
    """Candidate designs per generation of CMA-ES."""
    generations: Annotated[Count, most(1000, "each costs as many simulations as it has candidates")] = 8
    """Generations of CMA-ES per search for phi."""
    sigma0: Annotated[Positive, most(1000.0, "every candidate would lie on the edge of its box")] = 0.5
    """sigma0: first step size of CMA-ES, in units of the explored designs' Sigma."""
    smear: Annotated[Positive, most(1000.0, "every design would lie on the edge of its box")] = 0.5
    """Spread of the designs over which a candidate's physics are averaged, in units of the explored designs' Sigma."""
    drift_clip: Annotated[NotNegative, most(1e6, "no two designs differ by more: it is no limit any more")] = 0.0
    """Limit of the difference between two z, in units of z: a larger one compares a state in contact with one that is
    free. 0 sets no limit."""
    limit: Annotated[Positive, most(1000.0, "a step is never longer than the box")] = 1.0
    """Longest step of phi in one search, in units of the explored designs' Sigma: the policy must be able to follow."""

    name: ClassVar[str] = "cma_debiased"

    def memory(self, hw_nn: "HwNN") -> Twin:
        """Return the twin from which the proxy starts again once phi has followed it: otherwise what the task asked
        before would be asked again."""
        return Twin(copy.deepcopy(hw_nn))

    def candidates(self, problem: Problem) -> np.ndarray:
        """Return the one phi in the middle of CMA-ES's distributions, over the second half of its generations: of many
        noisy costs the least is luck. All is along the axes in which the explored designs vary independently."""
        import cma

        space, costs = problem.space, self.costs(problem)
        free, unit = space.free, problem.spread.sigma * space.scale
        whiten = np.linalg.cholesky(problem.spread.correlations(space)[np.ix_(free, free)])

        def designs(steps: np.ndarray) -> np.ndarray:
            """Return phi (P, d) after steps (P, free) in units of the explored Sigma, along its independent axes."""
            found = np.tile(problem.start, (len(steps), 1))
            found[:, free] += unit[free] * (steps @ whiten.T)
            return space.clip(found)

        options = {"popsize": self.population, "maxiter": self.generations, "seed": problem.seed, "verbose": -9}
        es, means = cma.CMAEvolutionStrategy(np.zeros(len(whiten)), self.sigma0, options), []
        while not es.stop():
            steps = es.ask()
            problem.physics.generation = designs(np.array(steps))
            es.tell(steps, costs(problem.physics.generation).tolist())
            means.append(es.mean)
        step = np.mean(means[len(means) // 2 :], 0)
        return designs(step[None] * min(1.0, self.limit / (np.linalg.norm(step) + 1e-12)))

    def costs(self, problem: Problem) -> Callable[[np.ndarray], np.ndarray]:
        """Return the cost (P,) of candidates phi (P, d), with noise of its own each time it is called.

        mean over pairs of sum_d W_d e1_d e2_d, e_k = F_{phi' + delta_k}(s, a) - m(s, a), with W_d one over the variance
        of z_d over the explored designs. All candidates of a call share the deltas, so that what they cost differs by
        the candidates alone.
        """
        space, dataset, rng = problem.space, problem.dataset, np.random.default_rng(problem.seed)
        unit = problem.spread.sigma * space.scale

        def half(candidates: np.ndarray, width: np.ndarray) -> np.ndarray:
            """Return z (P, n, z_size) of designs around candidates, each time with deltas of its own."""
            delta = width * problem.spread.noise(space, DRAWS, rng)
            delta = np.concatenate([delta, -delta])
            dealt = delta[np.arange(len(dataset.s)) % len(delta)]
            return problem.physics.z_each(dataset.s, dataset.a, space.clip(candidates[:, None] + dealt))

        start = problem.start[None]
        apart = limited((half(start, unit) - half(start, unit))[0] / 2, self.drift_clip)  # half the variance of z
        weight = 1 / (2 * np.nanmean(apart**2, 0) + SMALLEST_VARIANCE)

        def costs(candidates: np.ndarray) -> np.ndarray:
            first, second = (half(candidates, self.smear * unit) - dataset.z for _ in range(2))
            return split_halves(limited(first, self.drift_clip), limited(second, self.drift_clip), weight)

        return costs


def split_halves(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the weighted mean square (P,) of what two differences (P, n, z_size) with independent noise have in
    common: the square of their mean, without the variance of the noise."""
    return mean_over_pairs((first * second * weight).sum(-1))
