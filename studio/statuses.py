"""What runs do and why, from all that know it: their folders, those who saw a trainer die, the queue, and Slurm."""

from collections.abc import Mapping
from pathlib import Path

from morph_core.history import History
from morph_core.protocol import Status
from morph_core.run_folder import RunFolder
from studio.histories import Histories
from studio.inquest import Inquest
from studio.lines import HAS_TRAINER
from studio.overdue import kill_is_offered, stop_waits
from studio.study.local import CANCELLED
from studio.study.slurm import Slurm, slurm_launch
from studio.waiting import Waiting

_TOLD_BY_SLURM: tuple[Status, ...] = ("queued", "stopped", "failed", "lost")
"""States of a run's folder of which Slurm may know more: the run may wait, or be at work where it is not seen."""


class Statuses:
    """What the runs of one folder do, and why."""

    def __init__(
        self, runs: Path, histories: Histories, inquest: Inquest, waiting: Waiting, slurm: Slurm, trainers: int | None
    ) -> None:
        """Ask these about the runs of the folder `runs`, of which so many `trainers` are at work at once."""
        self._runs = runs
        self._histories = histories
        self._inquest = inquest
        self._waiting = waiting
        self._slurm = slurm
        self._trainers = trainers
        self.costs: dict[str, str] = {}
        """What an iteration of the runs that were started here takes, in words."""

    def of(self, history: History, places: Mapping[str, int] | None = None) -> tuple[Status, str]:
        """Return what a run does and why, including what only a witness of its trainer's death can know.

        `places` in the queue are looked up unless they are given.
        """
        folder = history.folder
        with self._histories.turn(folder.id):
            status, reason = self.in_queue(folder, *self._inquest.status(history), places)
        if status == "starting" and folder.id in self.costs:
            reason = f"{reason}; an iteration takes {self.costs[folder.id]}"
        if status in HAS_TRAINER and kill_is_offered(folder):
            reason = (
                f"asked to stop {stop_waits(folder):.0f} s ago and still in iteration {history.iteration + 1}; "
                f"to end it at once: Kill, or morph-studio stop {folder.id} --kill "
                "(what came after its newest checkpoint is then done again)"
            )
        return status, reason

    def places(self) -> Mapping[str, int]:
        """Return the place of each run that waits for a trainer, from 1 on."""
        return self._waiting.places()

    def in_queue(
        self, folder: RunFolder, status: Status, reason: str, places: Mapping[str, int] | None = None
    ) -> tuple[Status, str]:
        """Return what a run does and why, with what the queue, or Slurm, says of it where its folder can't tell.

        `places` in the queue are looked up unless they are given.
        """
        waits = self.places() if places is None else places
        if status not in ("running", "pausing", "paused") and (place := waits.get(folder.id)):
            full = "one trainer is" if self._trainers == 1 else f"{self._trainers or 'enough'} trainers are"
            return "queued", f"number {place} in the queue: {full} at work already"
        if status == "lost" and (folder.path / CANCELLED).exists() and not folder.read_events()[0]:
            return "stopped", "taken out of the queue before it had begun; Resume starts it"
        launch = slurm_launch(folder) if status in _TOLD_BY_SLURM else None
        if launch is None:
            return status, reason
        place = self._slurm.states(self._runs, [folder.id], patient=False).get(folder.id)
        if place is None:
            waiting = f"in Slurm's queue as job {launch.job}; {self._slurm.trouble or 'Slurm has not been asked yet'}"
            return status, waiting if status == "queued" else reason
        if place.where:
            if status == "lost":
                return "running", f"it runs on {place.where}, but its heartbeat does not reach this machine"
            return ("starting", f"on {place.where}") if status == "queued" else (status, reason)
        if not place.given_up:
            return "queued", place.why
        if status == "queued":
            return ("stopped" if (folder.path / CANCELLED).exists() else "failed"), place.why
        return status, f"{reason} ({place.why})" if status == "lost" and place.why else reason
