"""The files that browsers are sending to viser: few at a time, none for long, and none of a browser that has left."""

import time
from collections.abc import Callable
from dataclasses import dataclass

MOST = 4
"""Largest number of files that are on their way at once, from all browsers together."""
MOST_OF_ONE = 2
"""Largest number of files that are on their way at once from one browser."""
SECONDS = 120.0
"""Seconds that a file may take from its announcement to its last part."""


@dataclass
class _Upload:
    owner: object
    expected: int  # bytes
    began: float  # s
    parts: int
    received: int = 0  # bytes


class Uploads:
    """The uploads that are announced and not finished. What is given up is handed to `forget`, by its name."""

    def __init__(self, forget: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._forget = forget
        self._clock = clock
        self._open: dict[str, _Upload] = {}

    def begin(self, name: str, owner: object, size: int, parts: int) -> bool:
        """Tell whether `owner` may send a file of `size` bytes now."""
        self.give_up_late()
        own = sum(upload.owner is owner for upload in self._open.values())
        if name in self._open or len(self._open) >= MOST or own >= MOST_OF_ONE:
            return False
        self._open[name] = _Upload(owner, size, self._clock(), parts)
        return True

    def take(self, name: str, owner: object, size: int) -> bool:
        """Tell whether a part of `size` bytes belongs to an upload of `owner` and fits into what was announced."""
        self.give_up_late()
        upload = self._open.get(name)
        if upload is None or upload.owner is not owner:
            return False
        upload.received += size
        upload.parts -= 1
        if upload.received > upload.expected or upload.parts < 0:
            self._drop(name)
            return False
        if upload.parts == 0:
            del self._open[name]  # viser hands it on
        return True

    def leave(self, owner: object) -> None:
        """Give up what `owner` has not finished."""
        for name in [name for name, upload in self._open.items() if upload.owner is owner]:
            self._drop(name)

    def give_up_late(self) -> None:
        """Give up what takes too long."""
        now = self._clock()
        for name in [name for name, upload in self._open.items() if now - upload.began > SECONDS]:
            self._drop(name)

    def _drop(self, name: str) -> None:
        del self._open[name]
        self._forget(name)
