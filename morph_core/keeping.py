"""The checkpoints of a run that are kept: few enough for the disk of a long run, and all that somebody has chosen."""

import contextlib
import math
from collections.abc import Collection, Sequence

import msgspec

from morph_core import durable, inside
from morph_core.run_folder import CHECKPOINT, MARKS, SMALL_BYTES, RunFolder

MOST = 128
"""Largest number of checkpoints that are kept for their place in the run alone; one of a hand has a megabyte."""
PINS = "pins"
"""Folder in that of a run whose files are named like the checkpoints from which other runs were branched."""


class _Stars(msgspec.Struct, frozen=True):
    """What the marks of a run say of its designs."""

    starred_designs: tuple[int, ...] = ()


def dropped(saved: Sequence[int], interval: int, chosen: Collection[int]) -> list[int]:
    """Return which of the `saved` iterations, ascending, are kept no longer.

    The two newest are kept, and the first, those that are `chosen`, and every n-th: the smallest n, of the regular
    `interval` times a power of two, that leaves at most MOST. A run with no more than these loses none.
    """
    if len(saved) <= MOST:
        return []
    doublings = max(0, math.ceil(math.log2(saved[-1] / (interval * MOST))))
    every = interval << doublings
    kept = {saved[0], *saved[-2:], *chosen}
    return [iteration for iteration in saved if iteration % every and iteration not in kept]


def pin(folder: RunFolder, checkpoint: int) -> None:
    """Keep a checkpoint from which another run was branched, where the folder can be written to."""
    with contextlib.suppress(OSError):
        inside.folder(folder.path, PINS)
        inside.touch(folder.path, f"{PINS}/{checkpoint:06d}")


def tidy(folder: RunFolder, interval: int, best: int | None) -> None:
    """Remove the checkpoints of a run that are kept no longer; `best` is the iteration of the best evaluation.

    None is removed while it can't be read which are starred or branched from.
    """
    saved = folder.checkpoint_iterations()
    if len(saved) <= MOST:
        return
    try:
        starred, pinned = _starred(folder), _pinned(folder)
    except (OSError, ValueError, RecursionError):
        return
    wanted = [*starred, *([best] if best is not None else [])]
    nearest = (max((iteration for iteration in saved if iteration <= asked), default=saved[0]) for asked in wanted)
    for iteration in dropped(saved, interval, {*pinned, *nearest}):
        with contextlib.suppress(OSError):  # then it is removed the next time
            durable.remove_folder(folder.checkpoint(iteration))


def _pinned(folder: RunFolder) -> set[int]:
    return {int(name) for name in inside.names(folder.path, PINS) if CHECKPOINT.fullmatch(name)}


def _starred(folder: RunFolder) -> tuple[int, ...]:
    """Return the iterations whose designs are starred."""
    try:
        return msgspec.json.decode(inside.read(folder.path, MARKS, SMALL_BYTES), type=_Stars).starred_designs
    except FileNotFoundError:
        return ()
