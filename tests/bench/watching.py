"""What watching costs the trainer: CPU seconds of the same run with viewers connected and with none.

The viewers are raw websocket clients that take in everything a browser would: what a browser's own rendering takes
from the machine is not what the trainer pays. Runs take turns, the seed is the same, and so must the designs be.
"""

import json
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from visitors import post, served, visit

from morph_core.history import History
from morph_core.run_folder import RunFolder


@dataclass(frozen=True)
class Watching:
    """How much to measure."""

    task: str = "reacher"
    viewers: int = 2
    iterations: int = 40
    pairs: int = 3
    """Runs with viewers, and as many without."""


def watch(port: int, ended: threading.Event, taken: list[int]) -> None:
    """Read everything the viewer sends until the run has ended."""
    with visit(port) as viewer:
        while not ended.is_set():
            try:
                taken.append(len(viewer.recv(timeout=0.5)))
            except TimeoutError:
                continue


def cost(port: int, runs: Path, task: str, viewers: int, iterations: int) -> tuple[float, float, list[float], int]:
    """Return CPU and wall seconds of the trainer between its first and last iteration, the last phi, and bytes seen."""
    ended, taken = threading.Event(), list[int]()
    threads = [threading.Thread(target=watch, args=(port, ended, taken)) for _ in range(viewers)]
    for thread in threads:
        thread.start()
    time.sleep(2)
    run = post(f"http://127.0.0.1:{port}", "/api/runs", {"task": task, "iterations": iterations})["id"]
    history = History(RunFolder(runs / str(run)))
    while history.status not in ("finished", "failed"):
        time.sleep(0.1)
        history.poll()
    ended.set()
    for thread in threads:
        thread.join()
    first, last = history.progress[0], history.progress[-1]
    return last.cpu_seconds - first.cpu_seconds, last.time - first.time, last.phi, sum(taken)


def main(options: Watching) -> None:
    rows = []
    with served() as (port, runs):
        for pair in range(options.pairs):
            order = (0, options.viewers) if pair % 2 == 0 else (options.viewers, 0)  # the machine's drift cancels
            for viewers in order:
                cpu, wall, phi, taken = cost(port, runs, options.task, viewers, options.iterations)
                rows.append((viewers, cpu, wall, phi))
                print(f"{viewers} viewers: trainer {cpu:.2f} CPU-s, {wall:.2f} s, {taken / 1e6:.1f} MB seen")
    alone, watched = (np.array([row[1:3] for row in rows if bool(row[0]) is seen]) for seen in (False, True))
    for label, ratio in zip(("CPU", "wall"), np.exp(np.log(watched / alone).mean(0)), strict=True):
        print(f"{label}: {100 * (ratio - 1):+.1f} % with {options.viewers} viewers (mean of the pairs)")
    print(f"same designs: {len({json.dumps(row[3]) for row in rows}) == 1}")


if __name__ == "__main__":
    main(tyro.cli(Watching, description=__doc__))
