"""A soak: whether the server grows while it rests with a page open, and while a run is watched.

Memory is the resident one of the server's process, without its trainers. A straight line is fitted through the samples
after a warm-up.
"""

import concurrent.futures
import contextlib
import threading
import time
from collections.abc import Iterator

import httpx
import msgspec
import numpy as np
from websockets.exceptions import ConnectionClosed

from morph_core.history import History
from morph_core.run_folder import RunFolder
from tests.attack.outcome import Outcome
from tests.attack.target import CAMERA, Target, beside, target, wait_for
from tests.studio.conftest import make_run

AT_REST = 1.0
"""Largest growth of the server at rest in MB per hour."""
WATCHED = 5.0
"""Largest growth of the server in MB per 100,000 steps of a run that is watched."""
SHORT = {"at rest": 0.5, "watched": 5.0}
"""Hours and 100,000 steps below which a slope means little: what pages, threads and caches take once is part of it."""
ONCE = 30.0
"""Largest growth in MB of a soak that is that short."""
_KEY = "a-page-that-soaks"
_ENDED_RUNS = 12
_WARM_UP = 1 / 12


def rest(seconds: float, outcome: Outcome, every: float = 5.0) -> None:
    """Let a server with ended runs and one open page rest for some seconds, and note how its memory grows."""
    with target() as server:
        for number in range(_ENDED_RUNS):
            make_run(server.runs, f"20260101-0000{number:02}-reacher-morph-s{number}")
        samples, told = list[tuple[float, float]](), list[int]()
        with _open_page(server, told, outcome):
            began = time.monotonic()
            while (passed := time.monotonic() - began) < seconds:
                samples.append((passed / 3600, server.megabytes()))
                outcome.figures["MB now"] = samples[-1][1]
                time.sleep(every)
                outcome.add(int(time.monotonic() - began) - outcome.tried)
        outcome.figures |= {"told the page, kB": sum(told) / 1e3, "tracebacks": float(len(server.errors()))}
        _judge("at rest", "MB per hour", samples, AT_REST, outcome)
        _last_words(server, outcome)


def watched(steps: int, seconds: float, outcome: Outcome, every: float = 2.0) -> None:
    """Watch a run of the reacher for some environment steps or seconds, and note how the server's memory grows."""
    with target() as server, server.client() as client:
        samples, told = list[tuple[float, float]](), list[int]()
        with _open_page(server, told, outcome):
            answer = client.post("/api/runs", json={"task": "reacher", "iterations": 10**6, "seed": outcome.seed})
            run = answer.raise_for_status().json()["id"]
            history = History(RunFolder(server.runs / run))
            wait_for("the first iteration", lambda: history.poll() is not None and _steps(history), 300)
            began = time.monotonic()
            while time.monotonic() - began < seconds and _steps(history) < steps:
                time.sleep(every)
                history.poll()
                if history.status == "failed":
                    outcome.fault(f"the run that was watched failed: {history.message}")
                    break
                samples.append((_steps(history) / 1e5, server.megabytes()))
            client.post(f"/api/runs/{run}/commands", json={"type": "stop"}).raise_for_status()
        outcome.figures |= {"steps watched": float(_steps(history)), "shown while watching, MB": sum(told) / 1e6}
        _judge("watched", "MB per 100,000 steps", samples, WATCHED, outcome)
        _last_words(server, outcome)


def soak(seconds: int, steps: int, seed: int, quiet: bool = False) -> Outcome:
    """Let one server rest while another one's run is watched."""
    outcome = Outcome("soak", seconds, "seconds", seed, quiet=quiet)
    with concurrent.futures.ThreadPoolExecutor(2) as both:
        work = [both.submit(rest, seconds + 1, outcome), both.submit(watched, steps, seconds, outcome)]
        for done in work:
            done.result()
    return outcome.end()


def slope(samples: list[tuple[float, float]]) -> tuple[float, float, float]:
    """Return the slope of the line through samples (x, MB) after the warm-up, its standard error, and its width."""
    table = np.array(samples)
    begin = table[0, 0] + _WARM_UP * (table[-1, 0] - table[0, 0])
    x, memory = table[table[:, 0] >= begin].T
    off = x - x.mean()
    rise = float(off @ memory / (off @ off))
    residual = memory - memory.mean() - rise * off
    return rise, float(np.sqrt(residual @ residual / max(1, len(x) - 2) / (off @ off))), float(np.ptp(x))


def _judge(name: str, unit: str, samples: list[tuple[float, float]], most: float, outcome: Outcome) -> None:
    if len({x for x, _ in samples}) < 3:
        outcome.fault(f"{name}: too few samples for a slope")
        return
    rise, error, width = slope(samples)
    outcome.figures |= {
        f"{name}, {unit}": round(rise, 3),
        f"{name}, standard error": round(error, 3),
        f"{name}, MB": f"{samples[0][1]:.1f} to {samples[-1][1]:.1f}",
    }
    if width >= SHORT[name] and rise > most:
        outcome.fault(f"{name}: the server grows by {rise:.2f} {unit}, more than {most:g}")
    if width < SHORT[name] and rise * width > ONCE:
        outcome.fault(f"{name}: the server has grown by {rise * width:.0f} MB, more than {ONCE:g}, in a short time")


def _last_words(server: Target, outcome: Outcome) -> None:
    for error in server.errors():
        outcome.fault(f"a traceback in the server's log: {error}")
    if not server.serves_a_newcomer():
        outcome.fault("a browser that comes at the end is not served")


def _steps(history: History) -> int:
    return history.progress[-1].env_steps if history.progress else 0


@contextlib.contextmanager
def _open_page(server: Target, told: list[int], outcome: Outcome) -> Iterator[None]:
    """Keep open what a page of the studio keeps open: the viewer's websocket, and the question for news."""
    with beside(lambda ended: _look(server, ended, told, outcome), lambda ended: _ask(server, ended, told, outcome)):
        yield


def _look(server: Target, ended: threading.Event, told: list[int], outcome: Outcome) -> None:
    try:
        with server.browser(_KEY) as browser:
            browser.send(msgspec.msgpack.encode(CAMERA))
            while not ended.is_set():
                with contextlib.suppress(TimeoutError):
                    told.append(len(browser.recv(timeout=0.5)))
    except (ConnectionClosed, OSError, TimeoutError) as error:
        outcome.fault(f"the page that is open has lost its viewer: {error!r}")


def _ask(server: Target, ended: threading.Event, told: list[int], outcome: Outcome) -> None:
    after: dict[str, str] = {}
    with server.client(60) as client:
        while not ended.is_set():
            try:
                answer = client.get("/api/news", params={"desk": _KEY, "wait": "20", **after}).raise_for_status()
            except httpx.HTTPError as error:
                outcome.fault(f"the page that is open gets no news: {error!r}")
                ended.wait(5)
                continue
            told.append(len(answer.content))
            after = {"after": answer.json()["mark"]}
