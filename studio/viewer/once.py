"""What is pressed is done once: the second click of a double click does nothing."""

import threading
import time
from collections.abc import Callable
from typing import Any

AGAIN = 0.5
"""Seconds within which a second press is that of a double click: what the first one did is not on screen yet."""


def once(act: Callable[[Any], object]) -> Callable[[Any], None]:
    """Return what a press does, but nothing while the last press is being done, nor right after that."""
    at_work = threading.Lock()
    ended = -AGAIN

    def done(event: Any) -> None:
        nonlocal ended
        if not at_work.acquire(blocking=False):  # viser hands each click to a thread of its own
            return
        try:
            if time.monotonic() - ended >= AGAIN:
                act(event)
                ended = time.monotonic()
        finally:
            at_work.release()

    return done
