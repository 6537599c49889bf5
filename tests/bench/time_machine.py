"""How soon a long run opens and can be scrubbed through, and what playing a hand beside 64 ghosts takes of the server.

Writes a run of thousands of iterations that nobody has trained, opens it in a real server by a raw websocket client,
drags the slider of the timeline, and lets the episode of one iteration play. A browser's own rendering comes on top.
"""

import dataclasses
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import tyro
from visitors import Browser, Share, changes_robot, post, process_of, seconds_of, served, visit

from morph_core.catalogue import make_method, make_task
from morph_core.config import recorded
from morph_core.protocol import FORMAT, Evaluation, Progress, RunRecord, StateChanged
from morph_core.run_folder import EventLog, RunFolder, create_run, write_episode

LONGEST_GAP = 0.5
"""Seconds without a pose after which an episode stands at its end before it begins again."""


@dataclass(frozen=True)
class TimeMachine:
    """How much to measure."""

    task: str = "pen_press"
    iterations: int = 5000
    interval: int = 10
    """Iterations between two recorded episodes."""
    steps: int = 80
    """Control steps of each episode."""
    scrubs: int = 20
    seconds: float = 20.0
    """Seconds for which the episode plays, each time."""


def long_run(runs: Path, options: TimeMachine, name: str, iterations: int) -> RunFolder:
    """Write a run whose design walks at random, with evaluations, episodes and what was tried."""
    task, rng = make_task(options.task), np.random.default_rng(0)
    space = task.design_space
    record = RunRecord(
        id=name, task=options.task, method="morph", seed=0, iterations=iterations,
        config=recorded(make_method("morph", task)), format=FORMAT, parameters=list(space.parameters),
        versions={"python": "3"}, created=time.time(),
    )  # fmt: skip
    folder = create_run(runs, record)
    log, phi = EventLog(folder), space.initial
    log.append(StateChanged(status="starting", iteration=0))
    for i in range(1, iterations + 1):
        phi = space.clip(phi + 0.02 * space.scale * rng.standard_normal(len(space)))
        success, cosines = i / iterations, rng.uniform(-1, 1, len(space)).tolist()
        log.append(
            Progress(
                iteration=i, env_steps=4000 * i, phi=phi.tolist(), episode_return=-success, success=success,
                policy_std=0.5, divergence=float(rng.uniform(1e-3, 1)), search_cost=0.1 if i % 10 == 0 else None,
                cosine=cosines[0], cosine_negative=success, cosine_by_parameter=cosines, alpha=1.0, projection="none",
            )
        )  # fmt: skip
        if i % options.interval == 0:
            tried = space.clip(phi + space.scale * rng.standard_normal((64, len(space))))
            arrays = _episode(options, phi, rng) | {"population": tried, "generation": tried}
            log.append(
                Evaluation(
                    iteration=i, env_steps=4000 * i, phi=phi.tolist(), sampled_success=success,
                    sampled_return=-success, deterministic_success=success, deterministic_return=-success,
                    milestones={"lifted": success}, episode=write_episode(folder, i, arrays),
                )
            )  # fmt: skip
    log.append(StateChanged(status="finished", iteration=iterations, message="as asked"))
    log.close()
    return folder


def _episode(options: TimeMachine, phi: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return an episode in which every joint trembles."""
    task = make_task(options.task)
    start = task.qpos(task.reset(task.hw_phy(phi), 1, np.random.default_rng(0)))
    tremble = 0.05 * rng.standard_normal((options.steps + 1, start.shape[1])).cumsum(0) / 10
    return {
        "qpos": start + tremble, "phi": phi, "success": np.zeros(options.steps, bool),
        "contact": np.full((options.steps, 4, 3), np.nan),
    }  # fmt: skip


def main(options: TimeMachine) -> None:
    with tempfile.TemporaryDirectory() as folder:
        runs = Path(folder)
        long = long_run(runs, options, "20260101-000000-long", options.iterations)
        long_run(runs, dataclasses.replace(options, interval=5), "20260102-000000-short", 10)
        with served(runs) as (port, _):
            measure(port, options, long.id)


def measure(port: int, options: TimeMachine, long: str) -> None:
    base = f"http://127.0.0.1:{port}"
    server = process_of(port)
    with visit(port) as connection:
        browser = Browser(connection)
        browser.until(lambda _: "iteration" in browser.labels)
        browser.until(changes_robot)
        time.sleep(3)
        before = server.memory_info().rss
        began = time.monotonic()
        threading.Thread(target=post, args=(base, f"/api/runs/{long}/show", {})).start()
        end = str(options.iterations)
        browser.until(lambda m: f"In force at iteration {end}" in str(m.get("updates", {}).get("content", "")))
        browser.until(lambda m: "data" in m.get("updates", {}) or m["type"] == "GuiUplotMessage")
        print(f"a run of {options.iterations:,} iterations opens in {time.monotonic() - began:.2f} s")
        time.sleep(2)
        grown = (server.memory_info().rss - before) / 1e6
        print(f"memory of the server: {server.memory_info().rss / 1e6:.0f} MB, {grown:+.0f} MB by opening it")
        rng, slider = np.random.default_rng(1), browser.labels["iteration"][0]
        for what, step in (("with an episode", options.interval), ("without one", 1)):
            waits, costs = [], []
            for _ in range(options.scrubs):
                goal = int(rng.integers(1, options.iterations // options.interval)) * options.interval + (step == 1)
                browser.settle()
                spent = seconds_of(server)
                browser.send(slider, goal)
                waits.append(browser.until(changes_robot))
                costs.append(seconds_of(server) - spent)
            print(
                f"scrub to an iteration {what}: moved body after {1e3 * np.median(waits):.0f} ms (median), "
                f"{1e3 * max(waits):.0f} ms (longest); {1e3 * np.median(costs):.0f} ms of processor till then"
            )
        browser.send(slider, options.interval)
        _play(browser, server, options, "nothing beside it")
        browser.send(browser.labels["explored designs"][0], True)
        wait = browser.until(lambda m: str(m.get("name", "")).startswith("/explored/"))
        print(f"64 ghosts stand after {wait:.2f} s")
        _play(browser, server, options, "64 ghosts beside it")


def _play(browser: Browser, server: psutil.Process, options: TimeMachine, beside: str) -> None:
    """Let the episode play; the pauses before it begins again don't count, but what the server does in them does."""
    browser.settle()
    came = [time.monotonic()]
    with Share(server) as share:
        while came[-1] < came[0] + options.seconds:
            if any(str(message.get("name", "")).startswith("/robot/") for message in browser.receive()):
                came.append(time.monotonic())
    gaps = np.diff(came)
    moving = gaps[gaps < LONGEST_GAP]
    percent = share.percent * gaps.sum() / moving.sum()
    print(f"playing with {beside}: {1 / moving.mean():.0f} Hz, {percent:.1f} % of a core")


if __name__ == "__main__":
    main(tyro.cli(TimeMachine, description=__doc__))
