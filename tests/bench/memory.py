"""Does a long run grow? Resident memory of the trainer and of the studio, with a viewer connected all along.

`python tests/bench/memory.py --steps 1e6` starts a real server and a real run, reads like a browser would, and fits a
line through the memory after the warm-up.
"""

import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import tyro
from visitors import post, served
from watching import watch

from morph_core.history import History
from morph_core.run_folder import RunFolder


@dataclass(frozen=True)
class Memory:
    """How long to watch what."""

    task: str = "reacher"
    steps: float = 3e5
    """Environment steps."""
    warm_up: float = 0.25
    """Share of the run before the fit."""
    every: float = 1.0
    """Seconds between two samples."""
    runs: Path | None = None
    """Keep the run in this folder."""


def growth(samples: np.ndarray, warm_up: float) -> tuple[float, float]:
    """Return the slope in MB per 100,000 steps after the warm-up, and its standard error, of samples (n, 2)."""
    steps, memory = samples[samples[:, 0] > warm_up * samples[-1, 0]].T
    x = (steps - steps.mean()) / 1e5
    slope = float(x @ memory / (x @ x))
    residual = memory - memory.mean() - slope * x
    return slope, float(np.sqrt(residual @ residual / max(1, len(x) - 2) / (x @ x)))


def main(options: Memory) -> None:
    ended, taken = threading.Event(), list[int]()
    samples: dict[str, list[tuple[int, float]]] = {"trainer": [], "studio": []}
    with served(options.runs) as (port, runs):
        studio = next(p for p in psutil.Process().children() if "studio.cli" in p.cmdline())
        viewer = threading.Thread(target=watch, args=(port, ended, taken))
        viewer.start()
        time.sleep(2)
        order = {"task": options.task, "iterations": 10**6}
        run = str(post(f"http://127.0.0.1:{port}", "/api/runs", order)["id"])
        folder = RunFolder(runs / run)
        history = History(folder)
        while not history.progress or history.progress[-1].env_steps < options.steps:
            time.sleep(options.every)
            history.poll()
            if history.status == "failed":
                raise SystemExit(history.message)
            heartbeat = folder.heartbeat()
            if heartbeat and history.progress:
                steps = history.progress[-1].env_steps
                for name, process in (("trainer", psutil.Process(heartbeat.pid)), ("studio", studio)):
                    samples[name].append((steps, process.memory_info().rss / 1e6))
        post(f"http://127.0.0.1:{port}", f"/api/runs/{run}/commands", {"type": "stop"})
        while history.status not in ("stopped", "finished", "failed"):
            time.sleep(0.1)
            history.poll()
        ended.set()
        viewer.join()
    print(f"{options.task}: {history.progress[-1].env_steps:,} steps, {sum(taken) / 1e6:.1f} MB seen by the viewer")
    for name, rows in samples.items():
        table = np.array(rows)
        slope, error = growth(table, options.warm_up)
        print(
            f"{name}: {table[0, 1]:.0f} MB at the start, {table[-1, 1]:.0f} MB at the end, "
            f"{slope:+.2f} +- {error:.2f} MB per 100,000 steps after {options.warm_up:.0%} ({len(table)} samples)"
        )


if __name__ == "__main__":
    main(tyro.cli(Memory, description=__doc__))
