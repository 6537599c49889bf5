"""What spectators look at by themselves: the evolution of a run as a page that asks the server for nothing."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import anyio
import anyio.to_thread

from morph_core.history import History
from studio.show.evolution import build_evolution

KEPT = 4
"""Number of pages that are kept, the last ones that somebody wanted: each has one to five megabytes."""
REST = 30.0
"""Fewest seconds between two pages of a run that goes on."""
SHARE = 0.05
"""Largest share of the time in which the page of one run is written: trainers keep the processor."""


@dataclass(frozen=True)
class _Written:
    """A page, how far its run had come, when it was ready by the monotonic clock, and how long it took in seconds."""

    content: bytes
    iteration: int
    at: float
    took: float

    def is_due(self, history: History) -> bool:
        """Tell whether the run has gone on, and the page is old enough to be written anew."""
        age = time.monotonic() - self.at
        return history.iteration != self.iteration and age >= max(REST, self.took / SHARE)


class Evolutions:
    """The pages of runs, each written once for all who look at it. It lives in the server's event loop."""

    def __init__(self, find: Callable[[str], History]) -> None:
        """Write none yet; `find` returns a run, or raises RunFolderError."""
        self._find = find
        self._turn = anyio.Lock()
        self._written: dict[str, _Written] = {}  # the last wanted one at the end

    async def page(self, run_id: str) -> bytes:
        """Return the page of a run. Raise ValueError where it can't be read."""
        history = await anyio.to_thread.run_sync(self._find, run_id)
        async with self._turn:
            known = self._written.pop(run_id, None)
            if known is None or known.is_due(history):
                begun = time.monotonic()
                page = await anyio.to_thread.run_sync(build_evolution, [history])
                known = _Written(page.content, history.iteration, time.monotonic(), time.monotonic() - begun)
            self._written[run_id] = known
            while len(self._written) > KEPT:
                del self._written[next(iter(self._written))]
        return known.content
