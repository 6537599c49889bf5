"""Lines 4-6 of Algorithm 1: the dataset relabelled by the proxy, and the search for the phi that matches it (Eq. 3)."""

import warnings
from dataclasses import dataclass

import numpy as np

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # cma warns that it can't plot
    import cma

from morph_core.config import Config
from morph_core.design import DesignSpace
from morph_core.exploration import clip_drift, design_noise, nearest_buildable
from morph_core.rollout import Rollout
from morph_core.state import Learner
from morph_core.task import Task

GRADIENT_STEPS = 200
_SMALLEST_CHANGE = 1e-3
"""Of z between two designs, in units of z: keeps a component that nothing changes from being divided by 0."""


@dataclass(frozen=True)
class Dataset:
    """Script D: sampled (s, a) with the z that the proxy says."""

    s: np.ndarray  # (n, state_size)
    a: np.ndarray  # (n, action_size)
    z: np.ndarray  # (n, z_size)
    drift: np.ndarray | None = None
    """(n, z_size) how far the task has drawn z away from what the proxy's reference says; for `search=drift`."""


@dataclass(frozen=True)
class Search:
    """What a search for phi came to."""

    phi: np.ndarray  # (d,)
    cost: float
    """The divergence of Hw-Phy with this phi from the dataset."""
    steps: int
    """Steps of Hw-Phy that it took."""


def relabel(rollout: Rollout, learner: Learner, pairs: int, rng: np.random.Generator) -> Dataset:
    """Line 5: sample (s, a) of the rollout and label them with the updated proxy."""
    t, n = rollout.alive.nonzero()
    chosen = rng.integers(len(t), size=pairs)
    s, a = rollout.s[t[chosen], n[chosen]], rollout.a[t[chosen], n[chosen]]
    z = learner.proxy.hardware(s, a)
    return Dataset(s, a, z, z - learner.reference.hardware(s, a) if learner.reference else None)


def derive_design(
    task: Task, space: DesignSpace, dataset: Dataset, phi: np.ndarray, config: Config, seed: int, sigma: float = 1.0
) -> Search:
    """Line 6: return the phi of least divergence from the dataset.

    The search starts at the present phi and keeps to the box and to the locks. By "cma" and "gradient" it never ends
    worse than it started; "drift" goes where the task draws the proxy, however rough the divergence is on the way.
    `sigma` is that of the explored designs, in units of each parameter's scale.
    """
    start, physics = space.clip(phi), _Physics(task)
    if not space.free.any():
        candidates = start[None]
    elif config.search == "drift":
        candidates = _by_drift(physics, space, dataset, start, sigma, config, np.random.default_rng(seed))[None]
    elif config.search == "gradient":
        candidates = np.stack([start, _by_gradient(physics, space, dataset, start)])
    else:
        candidates = np.stack([start, _by_cma(physics, space, dataset, start, config, seed)])
    candidates = np.stack([nearest_buildable(task, start, candidate) for candidate in candidates])
    costs = physics.costs(dataset, candidates)
    best = int(np.argmin(costs))
    return Search(candidates[best], float(costs[best]), physics.steps)


class _Physics:
    """Hw-Phy of many designs at once, its steps counted."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.steps = 0

    def z(self, s: np.ndarray, a: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        """Return z (P, n, z_size) of candidates phi (P, d) for (s, a) (n, ...), all of them in one batch."""
        count, pairs = len(candidates), len(s)
        self.steps += count * pairs
        hw_phy = self.task.hw_phy(np.repeat(candidates, pairs, 0))
        return hw_phy(np.tile(s, (count, 1)), np.tile(a, (count, 1))).reshape(count, pairs, -1)

    def costs(self, dataset: Dataset, candidates: np.ndarray) -> np.ndarray:
        """Return the divergence (P,) of Hw-Phy with each candidate phi (P, d).

        Where a candidate's simulation diverges, it counts as far from the dataset as the farthest that did not.
        """
        square = ((self.z(dataset.s, dataset.a, candidates) - dataset.z) ** 2).sum(-1)
        sound = np.isfinite(square)
        return np.where(sound, square, square[sound].max() if sound.any() else np.inf).mean(-1)


def _by_drift(
    physics: _Physics,
    space: DesignSpace,
    dataset: Dataset,
    start: np.ndarray,
    sigma: float,
    config: Config,
    rng: np.random.Generator,
) -> np.ndarray:
    """Least squares of the drift on dz/dphi, averaged over the explored designs: contact leaves nothing to a point's.

    Everything is in units of the explored designs' spread, in which the ridge prefers the directions they vary in.
    The product of two independent halves of the average is free of the noise that would bias its square.
    """
    if dataset.drift is None:
        raise ValueError("search=drift needs the proxy's reference")
    noise = design_noise(space, config.drift_designs // 2, config.design_correlation, rng)
    spread = sigma * space.scale * noise
    z = physics.z(dataset.s, dataset.a, space.clip(start + np.concatenate([spread, -spread])))
    change = clip_drift(np.nan_to_num(z[: len(noise)] - z[len(noise) :]) / 2, config)  # (P, n, z_size)
    unit = np.sqrt((change**2).mean((0, 1))) + _SMALLEST_CHANGE  # contact shakes some components more than others
    drift = clip_drift(dataset.drift, config) / unit
    change = (change / unit).reshape(len(noise), -1)
    free = space.free
    whiten = np.linalg.cholesky(_correlations(space, config.design_correlation)[np.ix_(free, free)])
    white = np.linalg.solve(whiten, noise[:, free].T).T
    first, second = (change[half::2].T @ white[half::2] / len(white[half::2]) for half in (0, 1))  # (n z_size, f)
    curvature = (first.T @ second + second.T @ first) / 2
    pull = (first + second).T @ drift.ravel() / 2
    ridge = config.drift_ridge * (np.sum(first**2) + np.sum(second**2)) / (2 * free.sum())
    values, vectors = np.linalg.eigh(curvature)
    step = vectors @ ((vectors.T @ pull) / np.maximum(values, ridge + 1e-12))
    step *= min(1.0, config.drift_limit / (np.linalg.norm(step) + 1e-12))
    found = start.copy()
    found[free] += (sigma * space.scale)[free] * (whiten @ step)
    return space.clip(found)


def _correlations(space: DesignSpace, correlation: float) -> np.ndarray:
    """Return the correlations (d, d) of `design_noise`."""
    matrix = np.eye(len(space))
    for group in space.groups:
        matrix[np.ix_(group, group)] += correlation * (1 - np.eye(group.sum()))
    return matrix


def _by_cma(
    physics: _Physics, space: DesignSpace, dataset: Dataset, start: np.ndarray, config: Config, seed: int
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
        return candidates[np.argmin(physics.costs(dataset, candidates))]
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
        es.tell(population, physics.costs(dataset, complete(np.array(population))).tolist())
    return complete(np.asarray(es.result.xbest)[None])[0]


def _by_gradient(physics: _Physics, space: DesignSpace, dataset: Dataset, start: np.ndarray) -> np.ndarray:
    """Projected gradient descent on D with the step 1 / L of its curvature L at the start."""
    phi, step = start, None
    for _ in range(GRADIENT_STEPS):
        hw_phy = physics.task.hw_phy(phi)
        jacobian = getattr(hw_phy, "jacobian", None)
        if jacobian is None:
            raise ValueError(f'the Hw-Phy of {physics.task.name} has no gradient in phi: search by "cma" or "drift"')
        dz = jacobian(dataset.s, dataset.a)  # (n, z, d)
        residual = hw_phy(dataset.s, dataset.a) - dataset.z
        if step is None:
            curvature = 2 * np.einsum("nzi,nzj->ij", dz, dz) / len(residual)
            step = 1 / max(np.linalg.eigvalsh(curvature)[-1], 1e-12)
        gradient = 2 * np.einsum("nzi,nz->i", dz, residual) / len(residual)
        phi = space.clip(phi - step * gradient)
    return phi
