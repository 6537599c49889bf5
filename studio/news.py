"""The list of runs as it changes: what is new in it since somebody has seen it."""

import threading
import time
from dataclasses import dataclass

from studio.lines import Summary
from studio.runs import Runs

_SHARED = 0.8
"""Seconds for which one reading of the folder serves all who wait for news."""


@dataclass(frozen=True)
class Change:
    """What differs between two versions of the list."""

    version: int
    """Number of the version that this change leads to."""
    lines: list[Summary]
    """Lines that are new or have changed."""
    ids: list[str] | None
    """Names of all runs in their order where runs have come or gone; None where none has."""


class News:
    """The newest list of the runs of a folder, and when each of its lines last changed. It is thread-safe."""

    def __init__(self, runs: Runs) -> None:
        self._runs = runs
        self._lock = threading.Lock()
        self._read = -_SHARED
        self._version = 0
        self._ids: list[str] = []
        self._ids_since = 0
        self._lines: dict[str, tuple[int, Summary]] = {}

    def since(self, version: int, fresh: bool = True) -> Change:
        """Return what has changed since a version; everything where there was none.

        The folder is read for this, but where the answer need not be `fresh` and others have just asked.
        """
        with self._lock:
            if fresh or time.monotonic() - self._read > _SHARED:
                self._look()
            if not 0 < version <= self._version:
                version = 0
            lines = [line for since, line in self._lines.values() if since > version]
            return Change(self._version, lines, list(self._ids) if self._ids_since > version else None)

    def _look(self) -> None:
        listed = {line.id: line for line in self._runs.summaries()}
        known, following = self._lines, self._version + 1
        self._lines = {
            name: known[name] if name in known and known[name][1] == line else (following, line)
            for name, line in listed.items()
        }
        ids = list(listed)
        if ids != self._ids or not self._version:
            self._ids, self._ids_since = ids, following
        if self._ids_since == following or any(since == following for since, _ in self._lines.values()):
            self._version = following
        self._read = time.monotonic()
