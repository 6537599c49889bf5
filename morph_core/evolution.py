"""CMA-ES (Hansen's pycma) over the free entries of phi, the others kept."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from morph_core.design import DesignSpace


@dataclass(frozen=True)
class Evolution:
    """How long a run of CMA-ES lasts, and how widely it begins."""

    population: int
    generations: int
    sigma0: float
    """First step size, in units of `Region.unit`."""
    seed: int


@dataclass(frozen=True)
class Region:
    """Where candidates may lie."""

    space: DesignSpace
    phi: np.ndarray  # (d,) inside; its locked entries are those of every candidate
    unit: np.ndarray  # (d,)
    """Unit in which CMA-ES sees each entry of phi."""
    lo: np.ndarray  # (d,)
    hi: np.ndarray  # (d,)

    def complete(self, entries: np.ndarray) -> np.ndarray:
        """Return candidates (P, d) in physical units from free entries (P, f) in those of CMA-ES."""
        free = self.space.free
        candidates = np.tile(self.phi, (len(entries), 1))
        candidates[:, free] = entries * self.unit[free]
        return self.space.clip(candidates)


@dataclass(frozen=True)
class Evolved:
    """Where a run of CMA-ES ended."""

    best: np.ndarray  # (d,) the candidate of least cost
    mean: np.ndarray  # (d,) the middle of the last distribution
    sigma: float
    """Last step size, in units of `Region.unit`."""


def evolve(region: Region, evolution: Evolution, costs: Callable[[np.ndarray], np.ndarray]) -> Evolved:
    """Minimise the costs (P,) of candidates phi (P, d), beginning at `region.phi`."""
    free = region.space.free
    unit = region.unit[free]
    if free.sum() == 1:  # cma needs two dimensions; along a line a grid is as good
        grid = np.linspace(region.lo[free], region.hi[free], evolution.population * evolution.generations)
        candidates = region.complete(grid / unit)
        best = candidates[np.argmin(costs(candidates))]
        return Evolved(best, best, evolution.sigma0)

    import cma

    options = {
        "bounds": [list(region.lo[free] / unit), list(region.hi[free] / unit)],
        "popsize": evolution.population,
        "maxiter": evolution.generations,
        "seed": evolution.seed,
        "verbose": -9,
    }
    es = cma.CMAEvolutionStrategy(region.phi[free] / unit, evolution.sigma0, options)
    while not es.stop():
        population = es.ask()
        es.tell(population, costs(region.complete(np.array(population))).tolist())
    best, mean = region.complete(np.stack([es.result.xbest, es.result.xfavorite]))
    return Evolved(best, mean, float(es.sigma))
