"""Search `scatter`: random designs around phi, of which the one nearest to the proxy is taken."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from morph_core.config import Count, Positive
from morph_core.search import Problem, Search


@dataclass(frozen=True)
class Scatter(Search):
    """Random designs around phi: the one whose physics are nearest to the proxy is the next phi."""

    tries: Count = 64
    """Designs per search."""
    radius: Positive = 1.0
    """Standard deviation of the designs around phi, in units of each parameter's scale."""

    name: ClassVar[str] = "scatter"

    def candidates(self, problem: Problem) -> np.ndarray:
        rng, space = np.random.default_rng(problem.seed), problem.space
        offsets = self.radius * space.scale * rng.standard_normal((self.tries, len(space)))
        return np.concatenate([problem.start[None], space.clip(problem.start + offsets)])
