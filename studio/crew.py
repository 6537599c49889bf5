"""The trainers of one folder of runs: no more are started at once than the machine has room for, the others wait."""

import contextlib
import platform
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path

from morph_core.run_folder import RunFolder, RunFolderError, find_run, list_runs
from studio.histories import Histories
from studio.inquest import Inquest
from studio.study.launcher import launcher_of
from studio.study.local import CANCELLED
from studio.trainers import spawn_trainer
from studio.waiting import Wait, Waiting


class Crew:
    """Starts the trainers of the runs of one folder, or lets them wait."""

    def __init__(
        self,
        runs: Path,
        histories: Histories,
        inquest: Inquest,
        waiting: Waiting,
        has_trainer: Callable[[str], bool],
        spawn: Callable[..., subprocess.Popen[bytes]] = spawn_trainer,
        trainers: int | None = None,
    ) -> None:
        """Start trainers by `spawn`. While so many `trainers` are at work on this machine, whoever has started them,
        further runs wait; None lets none wait. `has_trainer` tells whether a run has one, on any machine."""
        self._runs = runs
        self._histories = histories
        self._inquest = inquest
        self._waiting = waiting
        self._has_trainer = has_trainer
        self._spawn = spawn
        self._trainers = trainers
        self.starting = threading.RLock()
        """Lock under which trainers are started, so that no two take the last place."""

    def begin(self, folder: RunFolder, further: int | None = None, from_start: bool = False) -> None:
        """Start a trainer, or let the run wait where as many are at work as may be, or others wait."""
        with self.starting:
            if not launcher_of(folder.path):
                (folder.path / CANCELLED).unlink(missing_ok=True)
            if self._waiting.all() or not self._has_room(folder.id):
                self._waiting.add(Wait(folder.id, further, from_start))
                return
            with self._histories.turn(folder.id):
                self.launch(folder, further, from_start)

    def tend(self) -> None:
        """Start what waits for a trainer, in order, as far as there is room."""
        if not self._waiting.all():
            return
        with self.starting:
            while (waiting := self._waiting.all()) and self._has_room():
                first = waiting[0]
                if not self._waiting.take(first.run):
                    continue
                with contextlib.suppress(RunFolderError):  # removed while it waited
                    folder = find_run(self._runs, first.run)
                    with self._histories.turn(folder.id):
                        if not self._inquest.is_alive(self._histories.get(folder.id)):  # else somebody was faster
                            self._launch_or_wait(folder, first)

    def launch(self, folder: RunFolder, further: int | None = None, from_start: bool = False) -> None:
        """Start a trainer, however many are at work."""
        self._inquest.begin(folder, lambda: self._spawn(folder, further=further, from_start=from_start))

    def _has_room(self, besides: str = "") -> bool:
        """Tell whether one more trainer may be started on this machine; the run `besides` has none yet."""
        if self._trainers is None:
            return True
        return sum(self._is_at_work(run) for run in list_runs(self._runs) if run != besides) < self._trainers

    def _is_at_work(self, run_id: str) -> bool:
        """Tell whether a run has a trainer on this machine."""
        try:
            if not self._has_trainer(run_id):
                return False
            beat = self._histories.get(run_id).heartbeat
        except RunFolderError:
            return False
        return beat is None or beat.host == platform.node()

    def _launch_or_wait(self, folder: RunFolder, wait: Wait) -> None:
        """Start a trainer; where the system has no room for another process, the run waits on."""
        try:
            self.launch(folder, wait.further, wait.from_start)
        except OSError:
            self._waiting.add(wait)
            raise
