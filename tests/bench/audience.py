"""What an audience costs, and how often it sees something new: 50 spectators of a browser that watches a training.

Spectators are raw connections of another process, which take in what a spectator's page would. Runs with and without
them take turns, the seed is the same, and so must the designs be. An update is counted in seconds in which the
presenter's own scene moves: a body that stands still is not sent.
"""

import asyncio
import json
import multiprocessing
import threading
import time
import urllib.request
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from urllib.error import HTTPError

import msgspec
import numpy as np
import tyro
import websockets.asyncio.client
from visitors import CAMERA, Share, post, process_of, served, visit

from morph_core.history import History
from morph_core.run_folder import RunFolder

MOVES = 20
"""Frames of the presenter's own scene in a second in which it moves."""


@dataclass(frozen=True)
class Watched:
    """How much to measure."""

    task: str = "reacher"
    spectators: int = 50
    iterations: int = 60
    pairs: int = 3
    """Runs with an audience, and as many with nobody there."""


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: object) -> None:
        """Stay where the cookie is given."""


def cookie_of(port: int, link: str) -> str:
    """Return the cookie that a link gives."""
    try:
        urllib.request.build_opener(_NoRedirect).open(f"http://127.0.0.1:{port}/{link}", timeout=10)
    except HTTPError as answer:
        return answer.headers["set-cookie"].split(";")[0]
    raise AssertionError("the link let nobody in")


async def spectate(port: int, cookie: str, number: int, ended: asyncio.Event, times: list[float]) -> None:
    """Take a seat and take in its events and its scene until it is ended; note when the scene was updated."""
    key = f"a-spectator-of-the-bench-{number:04d}"
    events, requests = await asyncio.open_connection("127.0.0.1", port)
    head = f"GET /audience/events?seat={key} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nCookie: {cookie}\r\n\r\n"
    requests.write(head.encode())
    await events.readuntil(b"event: stage")

    async def hear() -> None:
        while await events.read(65536):
            pass

    async def watch() -> None:
        async with websockets.asyncio.client.connect(
            f"ws://127.0.0.1:{port}/audience/viewer/{key}",
            subprotocols=["viser-v1.1.1"],  # pyright: ignore[reportArgumentType]
            origin=f"http://127.0.0.1:{port}",  # pyright: ignore[reportArgumentType]
            additional_headers={"Cookie": cookie},
            max_size=None,
            proxy=None,
        ) as scene:
            await scene.send(msgspec.msgpack.encode(CAMERA))
            async for _ in scene:
                times.append(time.monotonic())

    tasks = [asyncio.create_task(hear()), asyncio.create_task(watch())]
    await ended.wait()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    requests.close()


def spectators(port: int, cookie: str, count: int, pipe: Connection) -> None:
    """Be so many spectators until the pipe says something; send back when each was shown something new."""

    async def be_there() -> None:
        ended, times = asyncio.Event(), [list[float]() for _ in range(count)]
        seats = [asyncio.create_task(spectate(port, cookie, i, ended, times[i])) for i in range(count)]
        await asyncio.to_thread(pipe.recv)
        ended.set()
        await asyncio.gather(*seats)
        pipe.send(times)

    asyncio.run(be_there())


def present(port: int, ended: threading.Event, times: list[float]) -> None:
    """Be the browser that the audience watches."""
    with visit(port) as viewer:
        while not ended.is_set():
            try:
                viewer.recv(timeout=0.5)
            except TimeoutError:
                continue
            times.append(time.monotonic())


def rates(own: list[float], theirs: list[list[float]]) -> np.ndarray:
    """Return the updates of each spectator in each second in which the presenter's scene moves."""
    seconds = np.arange(int(min(own)) + 2, int(max(own)))
    shown = np.histogram(own, np.append(seconds, seconds[-1] + 1))[0] >= MOVES
    counts = [np.histogram(times, np.append(seconds, seconds[-1] + 1))[0][shown] for times in theirs]
    return np.array(counts)


def measure(port: int, runs: Path, options: Watched, watched: bool) -> tuple[float, float, list[float]]:
    """Return CPU and wall seconds of the trainer between its first and last iteration, and the last phi."""
    ended, own, theirs = threading.Event(), list[float](), list[list[float]]()
    base = f"http://127.0.0.1:{port}"
    presenter = threading.Thread(target=present, args=(port, ended, own))
    here, there = multiprocessing.Pipe()
    crowd = None
    if watched:
        cookie = cookie_of(port, str(post(base, "/api/audience", {})["link"]))
        arguments = (port, cookie, options.spectators, there)
        crowd = multiprocessing.get_context("spawn").Process(target=spectators, args=arguments)
        presenter.start()
        crowd.start()
        time.sleep(6)
    run = post(base, "/api/runs", {"task": options.task, "iterations": options.iterations})["id"]
    history = History(RunFolder(runs / str(run)))
    with Share(process_of(port)) as server:
        while history.status not in ("finished", "failed"):
            time.sleep(0.2)
            history.poll()
    ended.set()
    if crowd is not None:
        here.send("enough")
        theirs = here.recv()
        crowd.join()
        presenter.join()
        each = rates(own, theirs)
        print(
            f"  updates a second of a spectator: median {np.median(each):.0f}, lowest tenth "
            f"{np.quantile(each, 0.1):.0f}, of {each.shape[0]} spectators in {each.shape[1]} moving seconds"
        )
    first, last = history.progress[0], history.progress[-1]
    cpu, wall = last.cpu_seconds - first.cpu_seconds, last.time - first.time
    name = f"{options.spectators} spectators" if watched else "nobody"
    print(f"{name}: trainer {cpu:.2f} CPU-s, {wall:.2f} s; server {server.percent:.0f} % of a core", flush=True)
    return cpu, wall, last.phi


def main(options: Watched) -> None:
    rows: list[tuple[bool, float, float, list[float]]] = []
    with served() as (port, runs):
        for pair in range(options.pairs):
            for watched in (False, True) if pair % 2 == 0 else (True, False):  # the machine's drift cancels
                rows.append((watched, *measure(port, runs, options, watched)))
    alone, seen = (np.array([row[1:3] for row in rows if row[0] is watched]) for watched in (False, True))
    for label, ratio in zip(("CPU", "wall"), np.exp(np.log(seen / alone).mean(0)), strict=True):
        print(f"{label}: {100 * (ratio - 1):+.1f} % with {options.spectators} spectators (mean of the pairs)")
    print(f"same designs: {len({json.dumps(row[3]) for row in rows}) == 1}")


if __name__ == "__main__":
    main(tyro.cli(Watched, description=__doc__))
