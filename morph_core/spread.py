"""Designs drawn around phi: how widely, which of them can be built, and what the returns of their episodes count."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from morph_core.config import Positive, Settings, Share, Utility, most
from morph_core.design import DesignSpace
from morph_core.parts import Schedule

if TYPE_CHECKING:
    from morph_core.state import State
    from morph_core.task import Task

HALVINGS = 8
"""Steps back from a design that can't be built, before phi stays where it is."""


@dataclass(frozen=True)
class Spread:
    """The distribution of the explored designs around phi."""

    sigma: float
    """Sigma: standard deviation of the designs, in units of each parameter's scale."""
    correlation: float
    """Share of the variance that the parameters of a group have in common."""

    def noise(self, space: DesignSpace, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return standard normal noise (count, d) with this correlation."""
        noise = rng.standard_normal((count, len(space)))
        for group in space.groups if self.correlation else []:
            common = rng.standard_normal((count, 1))
            noise[:, group] = np.sqrt(1 - self.correlation) * noise[:, group] + np.sqrt(self.correlation) * common
        return noise

    def correlations(self, space: DesignSpace) -> np.ndarray:
        """Return the correlations (d, d) of the noise."""
        matrix = np.eye(len(space))
        for group in space.groups:
            matrix[np.ix_(group, group)] += self.correlation * (1 - np.eye(group.sum()))
        return matrix

    def designs(self, state: "State", count: int) -> np.ndarray:
        """Return designs (count, d) around phi: antithetic pairs, inside the box, locked entries kept."""
        space = state.design_space
        half = self.noise(space, count // 2, state.rng)
        state.explored = space.clip(state.phi + self.sigma * space.scale * np.concatenate([half, -half]))
        return state.explored


@dataclass(frozen=True)
class ExploredDesigns(Settings):
    """Designs that are tried around phi, and what each of their episodes counts."""

    sigma: Annotated[Positive, most(1000.0, "every design would lie on the edge of its box")] = 1.2
    """Sigma: spread of the designs drawn around phi at the start, in units of each parameter's scale."""
    sigma_end: Annotated[Positive, most(1000.0, "every design would lie on the edge of its box")] = 0.2
    """Sigma: spread of the designs at the end of the schedule, to which it falls geometrically, in units of each
    parameter's scale."""
    hold: Share = 0.0
    """Share of the schedule for which the explored designs keep their first Sigma."""
    correlation: Share = 0.0
    """Share of the variance of the explored designs that the parameters of a group have in common."""
    utility: Utility = "standardised"
    """Rule by which returns become weights: standardised, or CMA-ES's log-rank weights."""
    advantage_limit: Annotated[Positive, most(1000.0, "no standardised return of an iteration is larger")] = 3.0
    """Limit to which standardised returns are clipped, on both sides of 0."""

    def spread(self, schedule: Schedule, iteration: int, frozen: bool = False) -> Spread:
        """Return the distribution of an iteration; while phi is frozen all designs are phi."""
        sigma = schedule.geometric(self.sigma, self.sigma_end, iteration, self.hold)
        return Spread(0.0 if frozen else sigma, self.correlation)

    def advantage(self, returns: np.ndarray) -> np.ndarray:
        """Return what episodes (N,) count: their standardised returns, or CMA-ES's weights of their ranks."""
        if self.utility == "log_rank":
            rank = (-returns).argsort().argsort()  # 0 is the best
            returns = np.maximum(0.0, np.log(len(returns) / 2 + 1) - np.log(rank + 1))
        limit = self.advantage_limit
        return np.clip((returns - returns.mean()) / (returns.std(ddof=1) + 1e-8), -limit, limit)


def nearest_buildable(task: "Task", phi: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return `target` (d,), or the nearest point halved back towards phi that can be built."""
    for _ in range(HALVINGS):
        if task.buildable(target):
            return target
        target = (phi + target) / 2
    return phi


def drawn_back(task: "Task", phi: np.ndarray, designs: np.ndarray) -> np.ndarray:
    """Return designs (N, d); each that can't be built is its nearest point halved back towards phi (d,) that can."""
    built = designs.copy()
    for index in np.flatnonzero(~task.buildable(designs)):
        built[index] = nearest_buildable(task, phi, designs[index])
    return built
