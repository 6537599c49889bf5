"""Search `drift`: least squares on how far the task draws the proxy away from Hw-Phy, where contact is rough."""

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from msgspec import Meta

from morph_core.config import Count, NotNegative, Positive, most
from morph_core.divergence import limited
from morph_core.search import Problem, Search
from morph_core.twin import Twin

if TYPE_CHECKING:
    from morph_core.hw_nn import HwNN

_SMALLEST_CHANGE = 1e-3
"""Number in units of z that is added to the typical change of z between two designs, so that a component that nothing
changes is not divided by 0."""


@dataclass(frozen=True)
class Drift(Search):
    """Least squares of the drift of the proxy on dz/dphi, averaged over explored designs: where contact makes the
    divergence rough, every candidate costs more than the present phi, and a search for the least cost stands still."""

    drift_clip: Annotated[NotNegative, most(1e6, "no two designs differ by more: it is no limit any more")] = 0.0
    """Limit of the difference between two designs' z, in units of z: a larger one compares a state in contact with one
    that is free. 0 sets no limit."""
    designs: Annotated[int, Meta(ge=4, multiple_of=4), most(1000, "each costs a simulation of its pairs")] = 24
    """Number of designs, in two halves of antithetic pairs, over which dz/dphi is averaged."""
    groups: Annotated[Count, most(1000, "each has designs of its own to simulate")] = 1
    """Number of groups into which the relabelled pairs are split, each with so many designs of its own: for the same
    steps of Hw-Phy the least squares see more designs."""
    ridge: Annotated[NotNegative, most(1e6, "a step would be too short to be seen")] = 0.2
    """Ridge of the least squares, as a share of the mean curvature of a single estimate of dz/dphi: noise of few
    designs in a group adds to that, and makes steps shorter."""
    limit: Annotated[Positive, most(1000.0, "a step is never longer than the box")] = 1.5
    """Longest step of phi in one search, in units of the explored designs' Sigma."""

    name: ClassVar[str] = "drift"

    def memory(self, hw_nn: "HwNN") -> "Twin":
        return Twin(copy.deepcopy(hw_nn))

    def candidates(self, problem: Problem) -> np.ndarray:
        """Return the one phi to which the drift leads, however rough the divergence is on the way.

        With J1, J2 two independent estimates of dz/dphi, each averaged over half of the designs, solve
        ((J1'J2 + J2'J1) / 2 + ridge) x = (J1 + J2)' drift / 2. J'J of one estimate would be too large by the variance
        of its noise. The derivative is averaged over many designs, because at a single one contact makes it
        meaningless. All is in units of the explored designs' spread, in which the ridge prefers the directions they
        vary in.
        """
        if not isinstance(problem.memory, Twin):
            raise ValueError("the search drift needs the memory that it made before the first iteration")
        space, dataset = problem.space, problem.dataset
        rng = np.random.default_rng(problem.seed)
        groups = np.array_split(np.arange(len(dataset.s)), min(self.groups, len(dataset.s)))
        tried = [self._tried(problem, rows, rng) for rows in groups]
        # every component of z in units of its own change: contact shakes some more than others
        unit = np.sqrt((np.concatenate([change for _, change in tried], 1) ** 2).mean((0, 1))) + _SMALLEST_CHANGE
        drift = limited(problem.memory.drift(dataset), self.drift_clip) / unit
        # the two estimates J1, J2 of dz/dphi, by regression on whitened noise
        free = space.free
        whiten = np.linalg.cholesky(problem.spread.correlations(space)[np.ix_(free, free)])
        estimates = []  # of each group, twice (n z_size, f)
        for noise, change in tried:
            white = np.linalg.solve(whiten, noise[:, free].T).T
            flat = (change / unit).reshape(len(noise), -1)
            estimates.append([flat[half::2].T @ white[half::2] / len(white[half::2]) for half in (0, 1)])
        first, second = (np.concatenate(parts) for parts in zip(*estimates, strict=True))
        # least squares with a ridge, and a limit to its step
        curvature = (first.T @ second + second.T @ first) / 2
        pull = (first + second).T @ drift.ravel() / 2
        ridge = self.ridge * (np.sum(first**2) + np.sum(second**2)) / (2 * free.sum())
        values, vectors = np.linalg.eigh(curvature)
        step = vectors @ ((vectors.T @ pull) / np.maximum(values, ridge + 1e-12))
        step *= min(1.0, self.limit / (np.linalg.norm(step) + 1e-12))
        found = problem.start.copy()
        found[free] += (problem.spread.sigma * space.scale)[free] * (whiten @ step)
        return space.clip(found)[None]

    def _tried(self, problem: Problem, rows: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return noise (P, d), and how far z of the dataset's `rows` changes (P, n, z_size) from phi to phi + noise.

        The change is half of that between the designs of an antithetic pair.
        """
        space, dataset = problem.space, problem.dataset
        noise = problem.spread.noise(space, self.designs // 2, rng)
        offset = problem.spread.sigma * space.scale * noise
        designs = space.clip(problem.start + np.concatenate([offset, -offset]))
        z = problem.physics.z(dataset.s[rows], dataset.a[rows], designs)
        return noise, limited(np.nan_to_num(z[: len(noise)] - z[len(noise) :]) / 2, self.drift_clip)
