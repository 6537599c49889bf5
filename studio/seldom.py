"""Warnings that a stranger can cause as often as he likes, and that are written down at most once a minute."""

import logging
import threading
import time
from collections.abc import Callable

SECONDS = 60.0
"""Seconds between two lines about the same."""


class Seldom:
    """A warning that says at most once a minute how often it would have been given."""

    def __init__(self, log: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self._log = log
        self._clock = clock
        self._lock = threading.Lock()
        self._last = float("-inf")
        self._kept_back = 0

    def warn(self, sentence: str, *, traceback: bool = False) -> None:
        """Write a warning, or count it; with the traceback of the exception that is handled, as an error."""
        with self._lock:
            if self._clock() - self._last < SECONDS:
                self._kept_back += 1
                return
            more, self._kept_back, self._last = self._kept_back, 0, self._clock()
        level = logging.ERROR if traceback else logging.WARNING
        kept_back = f" ({more} more since the last line)" if more else ""
        self._log.log(level, "%s%s", sentence, kept_back, exc_info=traceback)


class SaidOnce(logging.Filter):
    """Lets a line without a traceback pass once a minute, and `unsaid` never."""

    def __init__(self, unsaid: str, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._unsaid = unsaid
        self._clock = clock
        self._said: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Tell whether a line is to be written."""
        sentence, now = str(record.msg), self._clock()
        if record.exc_info:
            return True
        if sentence == self._unsaid or now - self._said.get(sentence, -SECONDS) < SECONDS:
            return False
        self._said[sentence] = now
        return True
