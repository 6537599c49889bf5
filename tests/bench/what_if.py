"""How soon a what-if question is answered: from a slider's value to the moved body, and to the success on it.

Starts a real server on a copy of a run, opens the panel by a raw websocket client, and drags one slider; a browser's
own rendering comes on top. The CPU seconds of server and evaluating process say what it would take on idle cores.
"""

import contextlib
import shutil
import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil
import tyro
import zstandard
from latency import TOKEN, served
from watching import CAMERA
from websockets.sync.client import ClientConnection, connect


@dataclass(frozen=True)
class WhatIf:
    """What to ask."""

    run: tyro.conf.Positional[Path]
    """Folder of a run that has ended, with checkpoints."""
    drags: int = 10
    before_start: float = 3.0
    """Seconds between the opened page and the first press."""
    slider: str = ""
    """Label of the slider; by default the last one."""


class Browser:
    """The messages of a viewer, as a browser takes them in."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._waiting: deque[dict[str, Any]] = deque()
        self.labels: dict[str, tuple[str, dict[str, Any]]] = {}
        """Inputs and buttons by label: their uuid and what they are."""

    def until(self, claim: Callable[[dict[str, Any]], bool], seconds: float = 60.0) -> float:
        """Take messages in until one is as claimed; return the seconds since this call."""
        began = time.monotonic()
        while not claim(self._next()):
            assert time.monotonic() - began < seconds, "it never came"
        return time.monotonic() - began

    def settle(self, quiet: float = 0.4, longest: float = 2.0) -> None:
        """Take in what is still on its way, until nothing comes for `quiet` seconds, or for `longest` seconds."""
        end = time.monotonic() + longest
        with contextlib.suppress(TimeoutError):
            while time.monotonic() < end:
                self._waiting.clear()
                self._receive(quiet)
        self._waiting.clear()

    def send(self, uuid: str, value: object) -> None:
        """Set a value as a person does."""
        message = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
        self._socket.send(msgspec.msgpack.encode(message))

    def _next(self) -> dict[str, Any]:
        while not self._waiting:
            self._receive()
        return self._waiting.popleft()

    def _receive(self, timeout: float | None = None) -> None:
        frame = bytes(self._socket.recv(timeout))
        size = int.from_bytes(frame[8:16], "little")
        batch = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size]))
        for message in batch["messages"]:
            label = message.get("props", {}).get("label") if isinstance(message.get("props"), dict) else None
            if label:
                self.labels[label] = message["uuid"], message
            self._waiting.append(message)


def changes_robot(message: dict[str, Any]) -> bool:
    """Tell whether a message gives the robot other parts, or its parts other sizes or shapes: playback moves them."""
    if not str(message.get("name", "")).startswith("/robot/"):
        return False
    changed = set(message.get("updates", ()))
    return message["type"] != "SceneNodeUpdateMessage" or bool({"batched_scales", "vertices"} & changed)


def tells_success(message: dict[str, Any]) -> bool:
    """Tell whether a message says how often the policy succeeds on a changed body."""
    content = str(message.get("updates", {}).get("content", ""))
    return message["type"] == "GuiUpdateMessage" and "<b>success</b>" in content and "this body" in content


def main(options: WhatIf) -> None:
    with tempfile.TemporaryDirectory() as runs:
        shutil.copytree(options.run, Path(runs) / options.run.name)
        with served(Path(runs)) as (port, _):
            measure(port, options)


def measure(port: int, options: WhatIf) -> None:
    with connect(
        f"ws://127.0.0.1:{port}/viewer",
        subprotocols=["viser-v1.1.1"],  # pyright: ignore[reportArgumentType]
        origin=f"http://127.0.0.1:{port}",  # pyright: ignore[reportArgumentType]
        additional_headers={"Authorization": f"Bearer {TOKEN}"},
        max_size=None,
    ) as socket:
        socket.send(msgspec.msgpack.encode(CAMERA))
        browser = Browser(socket)
        browser.until(lambda _: "Change this body…" in browser.labels)
        time.sleep(options.before_start)  # the viewer has been told of the run by then
        before = set(browser.labels)
        browser.send(browser.labels["Change this body…"][0], True)
        first = browser.until(lambda m: "<b>success</b>" in str(m.get("updates", {}).get("content", "")))
        print(f"first answer, with the process started for it: {first:.2f} s")
        sliders = [label for label in browser.labels if label not in before]
        uuid, slider = browser.labels[options.slider or sliders[-1]]
        values = np.linspace(slider["props"]["min"], slider["props"]["max"], options.drags + 2)[1:-1]
        processes = [p for p in psutil.process_iter(["cmdline"]) if _serves(p, port)]
        evaluating = [c for p in processes for c in p.children() if "morph_core.evaluator" in c.cmdline()]
        bodies, answers, costs = [], [], []
        for value in values:
            time.sleep(0.5)
            spent = [sum(p.cpu_times()[:2]) for p in (*processes, *evaluating)]
            browser.send(uuid, round(float(value), 2))
            bodies.append(browser.until(changes_robot))
            answers.append(bodies[-1] + browser.until(tells_success))
            costs.append([sum(p.cpu_times()[:2]) - s for p, s in zip((*processes, *evaluating), spent, strict=True)])
    print(f"slider to moved body: median {1e3 * np.median(bodies):.0f} ms, longest {1e3 * max(bodies):.0f} ms")
    print(f"slider to success over 128 episodes: median {np.median(answers):.2f} s, longest {max(answers):.2f} s")
    server, evaluator = np.median(costs, 0)
    print(f"CPU seconds of one drag: server {server:.2f}, evaluating process {evaluator:.2f}")


def _serves(process: psutil.Process, port: int) -> bool:
    words = process.info["cmdline"] or []
    return "serve" in words and str(port) in words


if __name__ == "__main__":
    main(tyro.cli(WhatIf, description=__doc__))
