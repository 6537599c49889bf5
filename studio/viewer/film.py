"""The film of a run: its whole evolution in twenty seconds, with some of its recorded episodes on the way."""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.run_folder import read_episode

LENGTH = 20.0
"""Length of a film in seconds."""
CLIPS = 4
"""Largest number of episodes in a film."""
_BEGINS_AFTER = 1.2
"""Seconds for which the initial design stands before it changes."""
_LONGEST_CLIP = 2.4
"""Seconds that the steps of an episode take at most: a longer episode is played faster."""
_HOLD = 0.5
"""Seconds for which the end of an episode is seen."""
_NOTICED = 1.05
"""Factor of real time from which on it is said that an episode is played faster."""


@dataclass(frozen=True)
class Clip:
    """A recorded episode in a film."""

    iteration: int
    begins: float
    """Time in the film at which it begins, in seconds."""
    ends: float
    """Time in the film at which it ends, in seconds."""
    speed: float
    """Factor of real time with which it is played."""

    @property
    def words(self) -> str:
        """Return in words what is played, and how fast."""
        faster = f", {self.speed:.1f} times as fast as it was" if self.speed > _NOTICED else ""
        return f"its median episode on Hw-Phy{faster}"


class Film:
    """Plan of a film: which iteration of a run is seen at each moment, and which episode."""

    def __init__(self, history: History) -> None:
        """Plan the film of a run as it is now; an episode that can't be read is left out."""
        self.first, self.latest = history.begins_at, history.iteration
        control_dt = make_task(history.record.task, history.record.task_options).control_dt
        lasting = {i: steps * control_dt for i, steps in _episodes(history).items() if steps}
        taken = sum(min(seconds, _LONGEST_CLIP) + _HOLD for seconds in lasting.values())
        pace = (LENGTH - _BEGINS_AFTER - taken) / max(1, self.latest - self.first)  # s per iteration
        knots = [(0.0, self.first), (_BEGINS_AFTER, self.first)]
        self.clips: list[Clip] = []
        for iteration, seconds in lasting.items():
            begins = knots[-1][0] + pace * (iteration - knots[-1][1])
            ends = begins + min(seconds, _LONGEST_CLIP) + _HOLD
            self.clips.append(Clip(iteration, begins, ends, max(1.0, seconds / _LONGEST_CLIP)))
            knots += [(begins, iteration), (ends, iteration)]
        self._times, self._places = zip(*knots, (LENGTH, self.latest), strict=True)

    def iteration_at(self, seconds: float) -> int:
        """Return the iteration whose design is seen at a moment of the film."""
        return math.floor(np.interp(seconds, self._times, self._places) + 1e-9)

    def clip_at(self, seconds: float) -> Clip | None:
        """Return the episode that is played at a moment of the film; None while the design changes."""
        return next((clip for clip in self.clips if clip.begins <= seconds < clip.ends), None)


def _episodes(history: History) -> dict[int, int]:
    """Return the number of steps of some recorded episodes of a run, evenly spread over it, by iteration."""
    recorded = sorted({e.iteration for e in history.evaluations if e.episode})
    steps = {}
    for iteration in _spread(recorded):
        with contextlib.suppress(ValueError):  # damaged: the film goes on without it
            steps[iteration] = len(read_episode(history.folder, iteration)["qpos"]) - 1
    return steps


def _spread(iterations: Sequence[int]) -> list[int]:
    """Return at most `CLIPS` of some iterations, evenly spread, the first and the last among them."""
    places = np.linspace(0, len(iterations) - 1, min(CLIPS, len(iterations)))
    return [iterations[round(place)] for place in places]
