"""The evolution played: a thread that goes on through the iterations at an even pace, for as long as it plays."""

import logging
import threading
import time
from collections.abc import Callable

PACES = (1, 500)
"""Lowest and highest pace, in iterations per second."""
_TICK = 1 / 15
"""Seconds between two steps."""

log = logging.getLogger(__name__)


class Evolution:
    """What plays the iterations. Its methods may be called from any thread."""

    def __init__(self, step: Callable[[float], bool]) -> None:
        """Begin paused; `step(iterations)` goes so many iterations on and returns whether there are more."""
        self._step = step
        self._pace = 10.0
        self._ended: threading.Event | None = None

    @property
    def playing(self) -> bool:
        """Tell whether the evolution plays."""
        return self._ended is not None and not self._ended.is_set()

    def set_pace(self, pace: float) -> None:
        """Set the pace in iterations per second, kept within `PACES`."""
        self._pace = min(max(pace, PACES[0]), PACES[1])

    def play(self) -> None:
        """Begin to play, unless it plays already."""
        if not self.playing:
            self._ended = threading.Event()
            threading.Thread(target=self._run, args=(self._ended,), name="viewer-evolution", daemon=True).start()

    def pause(self) -> None:
        """Stay at the iteration that is shown."""
        if self._ended is not None:
            self._ended.set()

    def _run(self, ended: threading.Event) -> None:
        before = time.monotonic()
        try:
            while not ended.wait(_TICK):
                now = time.monotonic()
                elapsed, before = now - before, now
                if not self._step(elapsed * self._pace):
                    break
        except Exception:
            log.exception("the evolution could not be played on")
        finally:
            ended.set()
