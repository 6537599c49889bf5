"""A wish that work that goes on elsewhere be given up: set once, from any thread."""

import threading
from collections.abc import Callable


class CancelledError(Exception):
    """The work was given up, because nobody waits for it any more."""


class Cancellation:
    """A wish to give up. Whoever does the work says what is to happen then."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._done = False
        self._callbacks: list[Callable[[], None]] = []

    @property
    def is_set(self) -> bool:
        """Tell whether the work is to be given up."""
        return self._done

    def cancel(self) -> None:
        """Let the work be given up."""
        with self._lock:
            self._done = True
            callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback()

    def call(self, callback: Callable[[], None]) -> None:
        """Call `callback` once the work is to be given up: now, if that is so already."""
        with self._lock:
            if not self._done:
                self._callbacks.append(callback)
                return
        callback()

    def forget(self, callback: Callable[[], None]) -> None:
        """Call `callback` no more."""
        with self._lock:
            if callback in self._callbacks:
                self._callbacks.remove(callback)

    def check(self) -> None:
        """Raise CancelledError if the work is to be given up."""
        if self._done:
            raise CancelledError("given up: nobody waits for it any more")
