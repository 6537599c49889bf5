"""The divergence D of two hardware models: mean squared distance of their outputs on sampled (s, a).

The functions of D take arrays and tensors alike.
"""

from typing import Any, TypeVar

import numpy as np

Z = TypeVar("Z", bound=Any)
"""An array or a tensor."""


def squared_distance(z: Z, target: Z) -> Z:
    """Return ||z_n - target_n||^2 of each sample: (..., n) for z (..., n, z_size)."""
    return ((z - target) ** 2).sum(-1)


def divergence(z: Z, target: Z) -> Z:
    """Return D = mean_n ||z_n - target_n||^2 over the samples: (...) for z (..., n, z_size)."""
    return squared_distance(z, target).mean(-1)


def divergence_gradient(z: Z, target: Z, weight: Z | None = None) -> Z:
    """Return dD/dz (n, z_size) for z (n, z_size), where each squared difference counts `weight` (n, z_size) times."""
    gradient = 2 * (z - target) / len(z)
    return gradient if weight is None else weight * gradient


def limited(difference: np.ndarray, limit: float) -> np.ndarray:
    """Return differences of z clipped to +-limit; 0 means no limit."""
    return np.clip(difference, -limit, limit) if limit else difference
