"""What is kept of a long run: its ends, what is marked, and of the rest so much that it lies evenly."""

from collections.abc import Iterable

import numpy as np


def thinned(count: int, most: int, marked: Iterable[int]) -> list[int]:
    """Return which of `count` things in a row are kept, in order, where no more than `most` (>= 2) can be.

    The first and the last are, then the `marked` ones, those named first before others.
    """
    if count <= most:
        return list(range(count))
    kept = set(list(dict.fromkeys([0, count - 1, *marked]))[:most])
    even = np.round(np.linspace(0, count - 1, most - len(kept))).astype(int)
    return sorted(kept | set(even.tolist()))
