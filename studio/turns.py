"""Turns at work that takes seconds of computing: few at once, some wait, and whoever comes then is told so at once."""

import contextlib
import threading
from collections.abc import Iterator

AT_ONCE = 2
"""Largest number of pieces of work that are done at once; more of them would only take longer each."""
MOST_WAITING = 8
"""Largest number that wait for their turn: each holds a thread, of which the interface has forty."""


class BusyError(ValueError):
    """So much work waits already that no more is taken on; says what to do."""


class Turns:
    """Turns at work that takes seconds. It is thread-safe."""

    def __init__(self, at_once: int = AT_ONCE, most_waiting: int = MOST_WAITING) -> None:
        self._room = threading.Semaphore(at_once)
        self._lock = threading.Lock()
        self._most = at_once + most_waiting
        self._there = 0

    @contextlib.contextmanager
    def turn(self) -> Iterator[None]:
        """Wait for a turn, and keep it; BusyError, without waiting, where too many wait already."""
        with self._lock:
            if self._there >= self._most:
                raise BusyError(f"{self._most} exports and pages are being made already: try again in a minute")
            self._there += 1
        try:
            with self._room:
                yield
        finally:
            with self._lock:
                self._there -= 1
