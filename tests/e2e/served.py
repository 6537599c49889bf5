"""`morph-studio serve` as a real process, and what its run folders say."""

import contextlib
import os
import random
import re
import signal
import socket
import subprocess
import sysconfig
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from playwright.sync_api import Page

from morph_core.protocol import Heartbeat
from morph_core.run_folder import RunFolder, list_runs, process_alive

T = TypeVar("T")
MORPH_STUDIO = Path(sysconfig.get_path("scripts")) / "morph-studio"


PATIENCE = 3
"""Times that something may take on a machine that does much else."""


def wait_for(what: str, claim: Callable[[], T], seconds: float) -> T:
    """Return the first true value of `claim`, which takes so many seconds at most where nothing else is at work; fail
    with `what` was awaited."""
    deadline = time.monotonic() + PATIENCE * seconds
    while not (value := claim()):
        assert time.monotonic() < deadline, f"waited {PATIENCE * seconds} s in vain for {what}"
        time.sleep(0.1)
    return value


def fits(page: Page, width: int) -> None:
    """Wait until a page is as wide as its window, so that nothing of it lies beside."""
    wait_for(f"a page {width} px wide", lambda: page.evaluate("document.documentElement.scrollWidth") == width, 10)


def free_port() -> int:
    """Return a port that is free now, below those that the system gives to connections, which could take it next."""
    for port in random.sample(range(10_000, 30_000), 100):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise OSError("none of 100 ports is free")


class Server:
    """`morph-studio serve` on one port and one folder of runs; may be killed and started again."""

    def __init__(self, runs: Path) -> None:
        self.runs = runs
        self.port = free_port()
        self.url = ""
        self._process: subprocess.Popen[str] | None = None
        self._lines: list[str] = []

    def start(self) -> None:
        """Start it and read its one URL."""
        environment = {key: value for key, value in os.environ.items() if not key.startswith(("MORPH_", "PORT"))}
        command = [MORPH_STUDIO, "serve", "--no-browser", "--port", str(self.port), "--runs", self.runs]
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
        )
        self._lines = []
        threading.Thread(target=self._read, args=(self._process,), daemon=True).start()
        self.url = wait_for("the server's URL", self._url, 30)

    def kill(self) -> None:
        """End it as a crash would."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def stop(self) -> None:
        """End it as Ctrl-C would, and every trainer that it has left running."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(20)
            except subprocess.TimeoutExpired:
                self.kill()
        for run in list_runs(self.runs):
            beat = RunFolder(self.runs / run).heartbeat()
            if beat and process_alive(beat.pid, beat.process_started):
                os.kill(beat.pid, signal.SIGKILL)

    def only_run(self) -> RunFolder:
        (name,) = list_runs(self.runs)
        return RunFolder(self.runs / name)

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self._lines.append(line)

    def _url(self) -> str:
        assert self._process is not None
        assert self._process.poll() is None, "".join(self._lines)
        found = re.search(rf"http://\S+:{self.port}\S*", "".join(self._lines))
        return found.group() if found else ""


def events_of(run: RunFolder, kind: type[T]) -> list[T]:
    return [event for event in run.read_events()[0] if isinstance(event, kind)]


def beat_of(run: RunFolder) -> Heartbeat:
    beat = run.heartbeat()
    assert beat is not None
    return beat
