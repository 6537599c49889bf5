"""Search `gradient`: descent on the divergence where Hw-Phy is differentiable, the paper's stated alternative."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from morph_core.config import Count, most
from morph_core.search import Problem, Search
from morph_core.task import DifferentiableHardware, Task


@dataclass(frozen=True)
class Gradient(Search):
    """Projected gradient descent on the divergence; it needs a Hw-Phy that is differentiable in phi."""

    steps: Annotated[Count, most(100_000, "more take minutes in every search")] = 200
    """Gradient steps per search for phi."""

    name: ClassVar[str] = "gradient"

    def check(self, task: Task) -> None:
        _differentiable(task, task.design_space.initial)

    def candidates(self, problem: Problem) -> np.ndarray:
        return np.stack([problem.start, self._descended(problem)])

    def _descended(self, problem: Problem) -> np.ndarray:
        """Descend with the step 1 / L of the divergence's curvature L at the start."""
        dataset, phi, step = problem.dataset, problem.start, None
        for _ in range(self.steps):
            hw_phy = _differentiable(problem.physics.task, phi)
            dz = hw_phy.jacobian(dataset.s, dataset.a)  # (n, z, d)
            residual = hw_phy(dataset.s, dataset.a) - dataset.z
            problem.physics.steps += len(residual)
            if step is None:
                curvature = 2 * np.einsum("nzi,nzj->ij", dz, dz) / len(residual)
                step = 1 / max(np.linalg.eigvalsh(curvature)[-1], 1e-12)
            gradient = 2 * np.einsum("nzi,nz->i", dz, residual) / len(residual)
            phi = problem.space.clip(phi - step * gradient)
        return phi


def _differentiable(task: Task, phi: np.ndarray) -> DifferentiableHardware:
    """Return Hw-Phy with phi (d,); raise ValueError where it has no gradient in phi."""
    hw_phy = task.hw_phy(phi)
    if not isinstance(hw_phy, DifferentiableHardware):
        raise ValueError(f'the Hw-Phy of {task.name} has no gradient in phi: search by "cma" or "drift"')
    return hw_phy
