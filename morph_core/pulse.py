"""Whether a trainer is alive, as its reader sees it: a heartbeat that changes is alive, whatever any clock says."""

import platform
import time
from collections.abc import Callable

from morph_core.protocol import Heartbeat
from morph_core.run_folder import SAID_ENDED, process_alive, process_there

BEATS_WITHIN = 5.0
"""Seconds in which the heartbeat of a living trainer of this machine changes."""
LOST_AFTER = 60.0
"""Seconds in which the heartbeat of a trainer on another host changes: disks that hosts share show it late."""
LARGEST_SKEW = 60.0
"""Seconds by which the clock of another host may differ from the one here, for a heartbeat that is seen only once."""
WATCHED = 3.0
"""Seconds for which a heartbeat is watched before a second trainer is started."""


class Pulse:
    """What one reader has seen of a run's heartbeats, by its own monotonic clock."""

    def __init__(self) -> None:
        """Have seen nothing yet."""
        self._beat: Heartbeat | None = None
        self._since = 0.0  # s, when the present heartbeat was first seen
        self._changes = 0
        self._changes_when_missed: int | None = None

    def see(self, beat: Heartbeat | None) -> None:
        """Take in the heartbeat as it stands now."""
        if beat != self._beat:
            self._changes += self._beat is not None
            self._beat, self._since = beat, time.monotonic()

    @property
    def is_doubtful(self) -> bool:
        """Whether this heartbeat can be told to be dead only by watching it: its process is not seen from here, or its
        number may have been given to another one."""
        beat = self._beat
        if beat is None or beat.status in SAID_ENDED:
            return False
        return beat.host != platform.node() or process_there(beat.pid)

    @property
    def is_alive(self) -> bool:
        """Whether a trainer holds the run: its process is there, or its heartbeat changes."""
        beat = self._beat
        if beat is None or beat.status in SAID_ENDED:
            return False
        unchanged, age = time.monotonic() - self._since, abs(time.time() - beat.time)
        if beat.host != platform.node():
            return unchanged < LOST_AFTER and (self._changes > 0 or age < LOST_AFTER + LARGEST_SKEW)
        if process_alive(beat.pid, beat.process_started):
            self._changes_when_missed = None
            return True
        if process_there(beat.pid):  # another one has its number, or the clock by which its start is told was set
            return unchanged < BEATS_WITHIN and (self._changes > 0 or age < BEATS_WITHIN)
        if self._changes_when_missed is None:
            self._changes_when_missed = self._changes
        # Beating on without a process: one of a container that has this host's name. The first change may be the last
        # word of a process that is gone.
        return unchanged < BEATS_WITHIN and self._changes > self._changes_when_missed + 1


def at_work(beat: Callable[[], Heartbeat | None], watched: float = WATCHED) -> bool:
    """Tell whether a trainer writes this heartbeat, watching it where one look can't tell."""
    pulse, first = Pulse(), beat()
    pulse.see(first)
    if not pulse.is_doubtful:
        return pulse.is_alive
    deadline = time.monotonic() + watched
    while time.monotonic() < deadline:
        if first and first.host == platform.node() and process_alive(first.pid, first.process_started):
            return True
        time.sleep(0.1)
        if (found := beat()) != first:
            return found is not None and found.status not in SAID_ENDED
    return False
