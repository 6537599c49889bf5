"""What a folder of many runs costs the studio: how soon they are listed, and how much memory the server takes.

`python tests/bench/many_runs.py` makes 600 small runs, serves them, and asks for what the viewer's page, the runs page
and the command line ask for: of a server that has never seen them, and of one that was started again, which finds what
the first one has written down of them. With `--browser` a real Chromium opens the runs page, too.
`--runs 500 --iterations 5000` writes 2 GB.
"""

import functools
import json
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import psutil
import tyro
from visitors import TOKEN, served

from morph_core.catalogue import make_method, make_task
from morph_core.config import recorded
from morph_core.protocol import FORMAT, AnyEvent, Evaluation, Progress, RunRecord, StateChanged, encode
from morph_core.run_folder import create_run
from studio.index import FILE as INDEX
from studio.shelf.marks import Marks, write_marks

TASKS = ("reacher", "pen_press", "mouse_click")
METHODS = ("morph", "direct", "no_hw_opt")
CURVES = 27
"""Number of curves that differ."""


@dataclass(frozen=True)
class ManyRuns:
    """How many runs of which size."""

    runs: int = 600
    iterations: int = 100
    """Iterations of each run; every fifth is evaluated."""
    folder: Path | None = None
    """Keep the runs in this folder, and take those that are there."""
    browser: bool = False
    """Open the runs page in Chromium, too."""


def write_run(folder: Path, number: int, iterations: int) -> None:
    """Write a run that has ended, with one of `CURVES` curves."""
    task, name, seed = make_task(TASKS[number % 3]), METHODS[number // 3 % 3], number // 9
    day = 1.79e9 + 3600.0 * number
    run_id = f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime(day))}-{task.name}-{name}-s{seed}"
    record = RunRecord(
        format=FORMAT, id=run_id, task=task.name, method=name, seed=seed, iterations=iterations,
        config=recorded(make_method(name, task)), parameters=list(task.design_space.parameters),
        versions={"python": "3"}, created=day,
    )  # fmt: skip
    ended = StateChanged(
        status=("finished", "stopped", "failed")[number % 7 // 5 + number % 2], iteration=iterations,
        seq=10 * iterations, time=day,
    )  # fmt: skip
    run = create_run(folder, record)
    run.events.write_bytes(_learnt(number % CURVES, iterations) + encode(ended) + b"\n")
    if number % 10 == 0:
        write_marks(
            run.path, Marks(starred=number % 20 == 0, name=f"Design {number}", tags=("to print",), note="look again")
        )


@functools.cache
def _learnt(number: int, iterations: int) -> bytes:
    """Return the log of a run that learns, without its end: thousands of lines take longer to make than to write."""
    rng = np.random.default_rng(number)
    space, learns = make_task(TASKS[number % 3]).design_space, METHODS[number // 3 % 3] != "no_hw_opt"
    goal = space.clip(space.initial + rng.normal(0, 2, len(space)) * space.scale)
    middle, noise = rng.normal(0.5, 0.01, iterations), rng.normal(0, 0.02, iterations)
    events: list[AnyEvent] = [StateChanged(status="starting", iteration=0)]
    for i in range(1, iterations + 1):
        way = 1 / (1 + np.exp(-10 * (i / iterations - middle[i - 1]))) * learns
        phi = (space.initial + way * (goal - space.initial)).tolist()
        success = float(np.clip(way + noise[i - 1], 0, 1))
        events.append(
            Progress(
                iteration=i, env_steps=8000 * i, phi=phi, episode_return=success - 1, success=success, policy_std=0.5,
                cpu_seconds=0.4 * i, divergence=0.1, search_cost=0.2, cosine=0.3, cosine_negative=0.1,
            )
        )  # fmt: skip
        if i % 5 == 0:
            events.append(
                Evaluation(
                    iteration=i, env_steps=8000 * i, phi=phi, sampled_success=success, sampled_return=success - 1,
                    deterministic_success=success, deterministic_return=success - 1, episodes=64,
                )
            )  # fmt: skip
    return b"".join(encode(msgspec.structs.replace(e, seq=n)) + b"\n" for n, e in enumerate(events, 1))


def timed(what: str, ask: Callable[[], object], times: int = 1) -> None:
    """Print how long it takes to ask, as the median of several times."""
    seconds = []
    for _ in range(times):
        begin = time.perf_counter()
        ask()
        seconds.append(time.perf_counter() - begin)
    print(f"{what}: {np.median(seconds) * 1e3:.0f} ms")


def main(options: ManyRuns) -> None:
    with nullcontext(options.folder) if options.folder else tempfile.TemporaryDirectory() as folder:
        runs = Path(folder)
        if not runs.exists() or not any(runs.iterdir()):
            runs.mkdir(parents=True, exist_ok=True)
            for number in range(options.runs):
                write_run(runs, number, options.iterations)
        (runs / INDEX).unlink(missing_ok=True)
        for which in ("never seen", "seen by a server before"):
            print(f"--- runs {which}")
            with served(runs) as (port, _):
                measure(f"http://127.0.0.1:{port}", options.browser)


def measure(base: str, browser: bool) -> None:
    """Print what the server takes for what its pages ask."""
    studio = next(p for p in psutil.Process().children() if "studio.cli" in p.cmdline())

    def memory() -> str:
        return f"{studio.memory_info().rss / 1e6:.0f} MB"

    def ask(path: str, **headers: str) -> bytes:
        request = urllib.request.Request(base + path, headers={"Authorization": f"Bearer {TOKEN}", **headers})
        try:
            with urllib.request.urlopen(request, timeout=60) as response:
                versions.append(response.headers.get("ETag", ""))
                return response.read()
        except urllib.error.HTTPError as error:
            return b"" if error.code == 304 else error.read()

    versions: list[str] = []
    ask("/healthz")
    time.sleep(3)
    print(f"memory at the start: {memory()}")
    timed("list of runs, first time", lambda: ask("/api/runs"))
    timed("list of runs, again", lambda: ask("/api/runs"), 5)
    timed("list of runs, unchanged", lambda: ask("/api/runs", **{"If-None-Match": versions[-1]}), 5)
    timed("table, first time", lambda: ask("/api/table"))
    timed("table, again", lambda: ask("/api/table"), 5)
    rows = json.loads(ask("/api/table"))
    timed("table, unchanged", lambda: ask("/api/table", **{"If-None-Match": versions[-1]}), 5)
    print(f"{len(rows)} runs; memory once they are listed: {memory()}")
    names = [row["id"] for row in rows]
    pictures = iter(names[:50])
    timed("one thumbnail", lambda: ask(f"/api/runs/{next(pictures)}/thumbnail.png"), 50)
    timed("traces of 20 runs", lambda: ask("/api/traces?" + "&".join(f"run={name}" for name in names[:20])))
    timed("traces of 100 runs", lambda: ask("/api/traces?" + "&".join(f"run={name}" for name in names[:100])))
    for name in names:
        ask(f"/api/runs/{name}/thumbnail.png")
    print(f"memory with all thumbnails: {memory()}")
    if browser:
        open_page(base)
        print(f"memory after the page: {memory()}")


def open_page(base: str) -> None:
    """Print how soon a browser shows the runs page with its first rows."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        page = chromium.new_page(
            viewport={"width": 1280, "height": 800}, extra_http_headers={"Authorization": f"Bearer {TOKEN}"}
        )
        for which in ("first time", "again"):
            begin = time.perf_counter()
            page.goto(f"{base}/runs")
            page.locator(".tabulator-row").nth(5).wait_for()
            print(f"runs page, {which}: {(time.perf_counter() - begin) * 1e3:.0f} ms to its rows")
        chromium.close()


if __name__ == "__main__":
    main(tyro.cli(ManyRuns, description=__doc__))
