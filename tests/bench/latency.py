"""How soon a running run obeys: from POST to the acknowledgement in its event log, against one iteration.

Starts a real server and a real trainer, sends alternating values of alpha through the API, and reads the log.
"""

import time
from dataclasses import dataclass

import numpy as np
import tyro
from visitors import post, served

from morph_core.history import History
from morph_core.run_folder import RunFolder


@dataclass(frozen=True)
class Latency:
    """How often to ask."""

    commands: int = 20
    task: str = "reacher"
    before_start: float = 4.0
    """Seconds between the server's start and the run's: what a person takes to press Start."""


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
