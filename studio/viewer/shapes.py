"""Unit meshes that every primitive is an instance of: capsules of like proportions share one."""

import numpy as np

from morph_core import shapes
from morph_core.shapes import Shape, box, cylinder, sphere

__all__ = ["Shape", "box", "capsule", "capsule_bucket", "capsule_half_length", "cylinder", "sphere"]

_CAPSULE_OCTAVES = (-4, 14)
"""Lowest and highest bucket of a capsule's aspect: log2(half-length / radius), counted in half octaves."""


def capsule_bucket(radius: float, half_length: float) -> int:
    """Return the bucket whose capsule, scaled to this one's radius and length, keeps its ends round within 19 %."""
    lowest, highest = _CAPSULE_OCTAVES
    return int(np.clip(round(2 * np.log2(max(half_length, 1e-9) / max(radius, 1e-9))), lowest, highest))


def capsule_half_length(bucket: int) -> float:
    """Return the half-length of the bucket's cylinder in units of its radius."""
    return 2.0 ** (bucket / 2)


def capsule(bucket: int) -> Shape:
    """Return a capsule along z with a radius of one; its length is the bucket's."""
    return shapes.capsule(capsule_half_length(bucket))
