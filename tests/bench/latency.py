"""How soon a running run obeys: from POST to the acknowledgement in its event log, against one iteration.

Starts a real server and a real trainer, sends alternating values of alpha through the API, and reads the log.
"""

import contextlib
import json
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from morph_core.history import History
from morph_core.run_folder import RunFolder

TOKEN = "bench-token-of-more-than-enough-length"


@dataclass(frozen=True)
class Latency:
    """How often to ask."""

    commands: int = 20
    task: str = "reacher"
    before_start: float = 4.0
    """Seconds between the server's start and the run's: what a person takes to press Start."""


def post(base: str, path: str, body: dict[str, object]) -> dict[str, object]:
    """POST JSON to the API and return its answer."""
    headers = {"Authorization": f"Bearer {TOKEN}", "Content-Type": "application/json"}
    request = urllib.request.Request(base + path, json.dumps(body).encode(), headers)
    with urllib.request.urlopen(request, timeout=10) as response:
        return json.load(response)


@contextlib.contextmanager
def served(kept: Path | None = None) -> Iterator[tuple[int, Path]]:
    """Run a real server; give its port and its folder of runs: `kept`, or one that is gone afterwards."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with contextlib.nullcontext(str(kept)) if kept else tempfile.TemporaryDirectory() as runs:
        command = [sys.executable, "-m", "studio.cli", "serve", "--no-browser", "--port", str(port), "--runs", runs]
        server = subprocess.Popen([*command, "--token", TOKEN], stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout is not None
            server.stdout.readline()
            yield port, Path(runs)
        finally:
            server.terminate()
            server.wait()


def main(options: Latency) -> None:
    with served() as (port, runs):
        base = f"http://127.0.0.1:{port}"
        time.sleep(options.before_start)
        began = time.monotonic()
        run = str(post(base, "/api/runs", {"task": options.task, "iterations": 100_000})["id"])
        history = History(RunFolder(runs / run))
        while history.heartbeat is None:
            time.sleep(0.01)
            history.poll()
        print(f"start to the first stage: {time.monotonic() - began:.2f} s")
        while history.heartbeat is None or history.heartbeat.eta_seconds is None:
            time.sleep(0.01)
            history.poll()
        print(f"start to progress and ETA: {time.monotonic() - began:.2f} s")
        measure(base, run, history, options.commands)
        post(base, f"/api/runs/{run}/commands", {"type": "stop"})
        while history.status != "stopped":
            time.sleep(0.05)
            history.poll()


def measure(base: str, run: str, history: History, commands: int) -> None:
    """Send the commands one by one and print how long each took beyond the iteration it had to wait for."""
    delays = []
    for i in range(commands):
        time.sleep(0.13)
        sent = time.time()
        number = post(base, f"/api/runs/{run}/commands", {"type": "set_alpha", "alpha": 1.0 + i % 2})["id"]
        while not (answers := [a for a in history.acknowledged if a.id == number]):
            time.sleep(0.005)
            history.poll()
        delays.append(answers[0].time - sent)
    times = np.array([p.time for p in history.progress])
    iteration = float(np.max(np.diff(times)))
    print(f"iteration: median {np.median(np.diff(times)) * 1e3:.0f} ms, longest {iteration * 1e3:.0f} ms")
    print(f"POST to acknowledged: median {np.median(delays) * 1e3:.0f} ms, longest {max(delays) * 1e3:.0f} ms")
    print(f"longest beyond the longest iteration: {(max(delays) - iteration) * 1e3:.0f} ms")


if __name__ == "__main__":
    main(tyro.cli(Latency, description=__doc__))
