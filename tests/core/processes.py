"""Trainers in processes of their own that need not load torch first: a server that has loaded it forks them."""

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Sequence
from multiprocessing.context import ForkServerProcess
from pathlib import Path

from morph_core import train
from morph_core.run_folder import RunFolder

_FORK = multiprocessing.get_context("forkserver")
_FORK.set_forkserver_preload(["morph_core.train", "morph_core.catalogue", "cma"])


def _train(words: Sequence[str], errors: Path) -> None:
    """Be `python -m morph_core.train WORDS` in a new process, whose standard error goes to a file."""
    descriptor = os.open(errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 2)
    sys.argv = ["morph_core.train", *words]
    sys.exit(train.main())


class TrainerProcess:
    """A trainer that is at work on a run folder, with what tests need of `subprocess.Popen`."""

    def __init__(self, folder: RunFolder, *words: str) -> None:
        self._errors = folder.path.with_name(f"{folder.path.name}.{time.monotonic_ns()}.errors")
        self._process: ForkServerProcess = _FORK.Process(
            target=_train, args=(["--run", str(folder.path), *words], self._errors)
        )
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    def wait(self, seconds: float = 200) -> int:
        """Wait for its end and return its exit status; a process that a signal has ended gives the negative number."""
        self._process.join(seconds)
        assert self._process.exitcode is not None, f"the trainer still runs after {seconds} s"
        return self._process.exitcode

    def errors(self) -> str:
        """Return what it has said to standard error."""
        return self._errors.read_text()

    def send_signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        os.kill(self.pid, number)
