"""Lines 4-6 of Algorithm 1: the dataset relabelled by the proxy, and the search for the phi that matches it (Eq. 3)."""

import warnings
from dataclasses import dataclass

import numpy as np

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # cma warns that it can't plot
    import cma

from morph_core.config import Config
from morph_core.design import DesignSpace
from morph_core.divergence import divergence
from morph_core.networks import Proxy
from morph_core.rollout import Rollout
from morph_core.task import Task

GRADIENT_STEPS = 200


@dataclass(frozen=True)
class Dataset:
    """Script D: sampled (s, a) with the z that the proxy says."""

    s: np.ndarray  # (n, state_size)
    a: np.ndarray  # (n, action_size)
    z: np.ndarray  # (n, z_size)


def relabel(rollout: Rollout, proxy: Proxy, pairs: int, rng: np.random.Generator) -> Dataset:
    """Line 5: sample (s, a) of the rollout and label them with the updated proxy."""
    t, n = rollout.alive.nonzero()
    chosen = rng.integers(len(t), size=pairs)
    s, a = rollout.s[t[chosen], n[chosen]], rollout.a[t[chosen], n[chosen]]
    return Dataset(s, a, proxy.hardware(s, a))


def derive_design(
    task: Task, space: DesignSpace, dataset: Dataset, phi: np.ndarray, config: Config, seed: int
) -> tuple[np.ndarray, float]:
    """Line 6: return the phi (d,) of least divergence from the dataset, and that divergence.

    The search starts at the present phi, keeps to the box and to the locks, and never ends worse than it started.
    """
    start = space.clip(phi)
    if not space.free.any():
        return start, float(_costs(task, dataset, start[None])[0])
    if config.search == "gradient":
        found = _by_gradient(task, space, dataset, start)
    else:
        found = _by_cma(task, space, dataset, start, config, seed)
    candidates = np.stack([start, found])
    costs = _costs(task, dataset, candidates)
    best = int(np.argmin(costs))
    return candidates[best], float(costs[best])


def _costs(task: Task, dataset: Dataset, candidates: np.ndarray) -> np.ndarray:
    """Return the divergence (P,) of Hw-Phy with each candidate phi (P, d): all of them in one batch."""
    count, pairs = len(candidates), len(dataset.s)
    hw_phy = task.hw_phy(np.repeat(candidates, pairs, 0))
    z = hw_phy(np.tile(dataset.s, (count, 1)), np.tile(dataset.a, (count, 1)))
    return divergence(z.reshape(count, pairs, -1), dataset.z)


def _by_cma(
    task: Task, space: DesignSpace, dataset: Dataset, start: np.ndarray, config: Config, seed: int
) -> np.ndarray:
    free, scale = space.free, space.scale[space.free]

    def complete(free_entries: np.ndarray) -> np.ndarray:
        """Return candidates (P, d) in physical units from free entries (P, f) in units of scale."""
        candidates = np.tile(start, (len(free_entries), 1))
        candidates[:, free] = free_entries * scale
        return space.clip(candidates)

    if free.sum() == 1:  # cma needs two dimensions; along a line a grid is as good
        grid = np.linspace(space.lo[free], space.hi[free], config.search_population * config.search_generations)
        candidates = complete(grid / scale)
        return candidates[np.argmin(_costs(task, dataset, candidates))]
    options = {
        "bounds": [list(space.lo[free] / scale), list(space.hi[free] / scale)],
        "popsize": config.search_population,
        "maxiter": config.search_generations,
        "seed": seed,
        "verbose": -9,
    }
    es = cma.CMAEvolutionStrategy(start[free] / scale, config.search_sigma, options)
    while not es.stop():
        population = es.ask()
        es.tell(population, _costs(task, dataset, complete(np.array(population))).tolist())
    return complete(np.asarray(es.result.xbest)[None])[0]


def _by_gradient(task: Task, space: DesignSpace, dataset: Dataset, start: np.ndarray) -> np.ndarray:
    """Projected gradient descent on D with the step 1 / L of its curvature L at the start."""
    phi, step = start, None
    for _ in range(GRADIENT_STEPS):
        hw_phy = task.hw_phy(phi)
        jacobian = getattr(hw_phy, "jacobian", None)
        if jacobian is None:
            raise ValueError(f'the Hw-Phy of {task.name} is not differentiable: search by "cma", not by "gradient"')
        dz = jacobian(dataset.s, dataset.a)  # (n, z, d)
        residual = hw_phy(dataset.s, dataset.a) - dataset.z
        if step is None:
            curvature = 2 * np.einsum("nzi,nzj->ij", dz, dz) / len(residual)
            step = 1 / max(np.linalg.eigvalsh(curvature)[-1], 1e-12)
        gradient = 2 * np.einsum("nzi,nz->i", dz, residual) / len(residual)
        phi = space.clip(phi - step * gradient)
    return phi
