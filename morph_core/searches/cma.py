"""Search `cma`: the paper's, CMA-ES on the divergence."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from morph_core.config import Count, Positive, most
from morph_core.search import Problem, Search


@dataclass(frozen=True)
class Cma(Search):
    """CMA-ES on the divergence, as in the paper; it never ends worse than it started."""

    population: Annotated[int, Meta(ge=4), most(1000, "each candidate costs a simulation of all pairs")] = 12
    """Candidate designs per generation of CMA-ES."""
    generations: Annotated[Count, most(1000, "each costs as many simulations as it has candidates")] = 20
    """Generations of CMA-ES per search for phi."""
    sigma0: Annotated[Positive, most(1000.0, "every candidate would lie on the edge of its box")] = 0.1
    """sigma0: first step size of CMA-ES, in units of each parameter's scale."""

    name: ClassVar[str] = "cma"

    def candidates(self, problem: Problem) -> np.ndarray:
        return np.stack([problem.start, self._best(problem)])

    def _best(self, problem: Problem) -> np.ndarray:
        space, physics = problem.space, problem.physics
        free, scale = space.free, space.scale[space.free]
        low, high = space.lo[free] / scale, space.hi[free] / scale

        def complete(free_entries: np.ndarray) -> np.ndarray:
            """Return candidates (P, d) in physical units from free entries (P, f) in units of scale."""
            candidates = np.tile(problem.start, (len(free_entries), 1))
            candidates[:, free] = free_entries * scale
            return space.clip(candidates)

        if free.sum() == 1:  # cma needs two dimensions; along a line a grid is as good
            grid = np.linspace(space.lo[free], space.hi[free], self.population * self.generations)
            candidates = complete(grid / scale)
            return candidates[np.argmin(physics.costs(problem.dataset, candidates))]

        import cma

        options = {
            "bounds": [list(low), list(high)],
            "popsize": self.population,
            "maxiter": self.generations,
            "seed": problem.seed,
            "verbose": -9,
        }
        es = cma.CMAEvolutionStrategy(problem.start[free] / scale, self.sigma0, options)
        while not es.stop():
            population = es.ask()
            physics.generation = complete(np.array(population))
            es.tell(population, physics.costs(problem.dataset, physics.generation).tolist())
        best = es.result.xbest  # None where every simulation of every candidate diverged
        return problem.start if best is None else complete(np.asarray(best)[None])[0]
