"""A stop that is not obeyed: between two iterations is the only time at which a trainer looks into its inbox."""

import time

from morph_core.protocol import Stop
from morph_core.run_folder import RunFolder, RunFolderError

KILL_OFFERED_AFTER = 30.0
"""Seconds after which a stop that the trainer has not obeyed is followed by the offer to end it at once."""


def stop_waits(folder: RunFolder) -> float:
    """Return for how many seconds a stop has been waiting in a run's inbox; 0 where there is none."""
    try:
        asked = [path.lstat().st_mtime for path, order in folder.pending() if order and isinstance(order.command, Stop)]
    except (OSError, RunFolderError):  # obeyed this very moment
        return 0.0
    return max(0.0, time.time() - min(asked)) if asked else 0.0


def kill_is_offered(folder: RunFolder) -> bool:
    """Tell whether a stop has waited so long that the trainer may be ended at once."""
    return stop_waits(folder) >= KILL_OFFERED_AFTER


def forget_stops(folder: RunFolder) -> None:
    """Take the stops out of the inbox of a trainer that is gone: the next one would obey them."""
    for path, order in folder.pending():
        if order and isinstance(order.command, Stop):
            path.unlink(missing_ok=True)
