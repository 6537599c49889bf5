"""The divergence D of two hardware models: mean squared distance of their outputs on sampled (s, a)."""

import numpy as np


def divergence(z: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return mean_n ||z_n - target_n||^2 over the samples: (...) for z (..., n, z_size)."""
    return ((z - target) ** 2).sum(-1).mean(-1)
