"""Numbers that a run can go on with: what is NaN, infinite or too large to learn from is named."""

from collections.abc import Mapping

import numpy as np

LARGEST = 1e15
"""Largest magnitude of a number that is learnt from: sums of its squares are still single-precision numbers."""


def check_steps(numbers: Mapping[str, np.ndarray], alive: np.ndarray) -> None:
    """Raise FloatingPointError that names the first number (T, N, ...) that no learning can go on with.

    `numbers` are by their name, those first that others follow from; steps that are not `alive` (T, N) don't count.
    """
    found: list[tuple[int, str, float]] = []
    for name, values in numbers.items():
        wrong = ~(np.abs(values) <= LARGEST) & alive.reshape(alive.shape + (1,) * (values.ndim - alive.ndim))
        if wrong.any():
            first = int(wrong.any(axis=tuple(range(1, wrong.ndim))).argmax())
            found.append((first, name, float(values[first][wrong[first]][0])))
    if found:
        step, name, value = min(found, key=lambda entry: entry[0])
        raise FloatingPointError(f"{name} {unsound(value)} in step {step + 1} of an episode")


def unsound(value: float) -> str:
    """Return in words what is wrong with a number that no learning can go on with."""
    if np.isnan(value):
        return "became NaN"
    return "became infinite" if np.isinf(value) else f"became {value:g}, beyond {LARGEST:g}"
