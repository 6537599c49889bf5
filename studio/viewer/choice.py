"""The run that one browser has chosen, among those that there are."""

import time
from collections.abc import Mapping

from morph_core.history import History
from morph_core.protocol import Status
from studio.viewer.run import NOT_LIVE

_START_PATIENCE = 5.0
"""Seconds after which a run that has not shown up is reported: one that was started is there at once."""
_GONE = "Choose another run, or bring this one back on the page of all runs: then it is shown again."


class Choice:
    """What a viewer was told of the runs, and which of them it shows. It has no lock: its viewer holds one."""

    def __init__(self) -> None:
        self.run: str | None = None
        """Name of the run on screen; None while the start panel is there."""
        self.sought: int | None = None
        """Iteration that is to be shown as soon as the run is known; None for no other one than is shown."""
        self.is_told = False
        """Whether the viewer has been told of the runs: until then nobody knows what is to be seen."""
        self.histories: Mapping[str, History] = {}
        self.statuses: Mapping[str, tuple[Status, str]] = {}
        self._known: set[str] = set()
        self._suggested: str | None = None
        self._awaited_since = 0.0

    @property
    def history(self) -> History | None:
        """Return the history of the run on screen, None without one."""
        return self.histories.get(self.run) if self.run else None

    def take_in(
        self, histories: Mapping[str, History], statuses: Mapping[str, tuple[Status, str]], suggested: str | None
    ) -> None:
        """Take in the runs as they are now; whenever another one is suggested, that is chosen."""
        self.histories, self.statuses, self.is_told = dict(histories), dict(statuses), True
        self._known |= self.histories.keys()
        if suggested != self._suggested:
            self._suggested = suggested
            if suggested is not None:
                self.run = suggested

    def choose(self, run_id: str | None) -> None:
        """Choose the run of that name, or the start panel if it is None."""
        self.run, self.sought = run_id, None
        self._awaited_since = time.monotonic()

    def status_of(self, history: History) -> tuple[Status, str]:
        """Return the status of a run and a sentence on it, those in its folder where no others were told."""
        return self.statuses.get(history.folder.id, (history.status, history.message))

    def is_live(self, history: History) -> bool:
        """Tell whether a run is being trained."""
        return self.status_of(history)[0] not in NOT_LIVE

    @property
    def is_gone(self) -> bool:
        """Tell whether the run on screen was there and is no more."""
        return self.run in self._known and self.run not in self.statuses

    @property
    def missing(self) -> tuple[Status, str]:
        """Return the status of a chosen run of which there is no history, and why it can't be shown."""
        status, message = self.statuses.get(self.run or "", ("starting", "starting…"))
        if self.is_gone:
            return "lost", f"{self.run} is no longer in the folder of runs: it was deleted or moved. {_GONE}"
        if self.run not in self.statuses and time.monotonic() - self._awaited_since > _START_PATIENCE:
            return "lost", f"{self.run} has not shown up in the folder of runs: it was deleted or moved. {_GONE}"
        return status, message
