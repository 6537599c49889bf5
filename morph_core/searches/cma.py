"""Search `cma`: the paper's, CMA-ES on the divergence."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from morph_core.config import Count, Positive
from morph_core.evolution import Evolution, Region, evolve
from morph_core.search import Problem, Search


@dataclass(frozen=True)
class Cma(Search):
    """CMA-ES on the divergence, as in the paper; it never ends worse than it started."""

    population: Annotated[int, Meta(ge=4)] = 12
    """Candidate designs per generation of CMA-ES."""
    generations: Count = 20
    """Generations of CMA-ES per search for phi."""
    sigma0: Positive = 0.1
    """sigma0: first step size of CMA-ES, in units of each parameter's scale."""

    name: ClassVar[str] = "cma"

    def candidates(self, problem: Problem) -> np.ndarray:
        return np.stack([problem.start, self._best(problem)])

    def _best(self, problem: Problem) -> np.ndarray:
        space = problem.space
        region = Region(space, problem.start, space.scale, space.lo, space.hi)
        evolution = Evolution(self.population, self.generations, self.sigma0, problem.seed)
        return evolve(region, evolution, lambda candidates: problem.physics.costs(problem.dataset, candidates)).best
