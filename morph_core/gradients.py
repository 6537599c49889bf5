"""The two gradients: how far they agree (S_c), and what becomes of g_task where they do not."""

from collections.abc import Iterable

import torch
from torch import Tensor

from morph_core.config import Projection

TINY = 1e-12
"""Number that is added to a divisor, so that a zero gradient makes no NaN."""


def flatten(gradients: Iterable[Tensor]) -> Tensor:
    """Return all gradients as one flat vector."""
    return torch.cat([g.reshape(-1) for g in gradients])


def write_gradient(parameters: Iterable[Tensor], gradient: Tensor) -> None:
    """Set `.grad` of the parameters to consecutive pieces of the flat gradient."""
    offset = 0
    for p in parameters:
        p.grad = gradient[offset : offset + p.numel()].view_as(p)
        offset += p.numel()


def cosine(g_task: Tensor, g_hw: Tensor) -> float:
    """Return the cosine S_c(g_task, g_hw) of two flat gradients; 0 where one of them vanishes."""
    return float(g_task @ g_hw / (g_task.norm() * g_hw.norm() + TINY))


def project(g_task: Tensor, g_hw: Tensor, rule: Projection) -> Tensor:
    """Return the flat g_task; where it conflicts with g_hw, projected on the plane normal to that, unless the rule is
    `none`.

    `as_printed` divides by ||g_hw|| as the paper prints it: a projection only where that norm is 1. `one_sided`
    divides by its square, as the paper's words and PCGrad (Yu et al. 2020) have it.
    """
    dot = g_task @ g_hw
    if rule == "none" or dot >= 0:
        return g_task
    square = g_hw @ g_hw
    return g_task - dot / ((square.sqrt() if rule == "as_printed" else square) + TINY) * g_hw
