"""A real server and its visitors: requests to its API, and browsers that take messages in but draw nothing."""

import contextlib
import json
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import psutil
import zstandard
from websockets.sync.client import connect
from websockets.sync.connection import Connection

TOKEN = "bench-token-of-more-than-enough-length"
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, 5], "fov": 1.0, "near": 0.01, "far": 100.0,
    "image_height": 600, "image_width": 800, "look_at": [0, 0, 0], "up_direction": [0, 0, 1],
}  # fmt: skip
"""The first message of a browser; only then it counts as connected."""


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


def process_of(port: int) -> psutil.Process:
    """Return the process of the server on a port."""
    (server,) = [p for p in psutil.process_iter(["cmdline"]) if _serves(p.info["cmdline"] or [], port)]
    return server


def post(base: str, path: str, body: dict[str, object]) -> dict[str, object]:
    """POST JSON to the API and return its answer."""
    headers = {"Authorization": f"Bearer {TOKEN}", "Content-Type": "application/json"}
    request = urllib.request.Request(base + path, json.dumps(body).encode(), headers)
    with urllib.request.urlopen(request, timeout=10) as response:
        return json.load(response)


@contextlib.contextmanager
def visit(port: int) -> Iterator[Connection]:
    """Open the viewer of a server as a browser does."""
    with connect(
        f"ws://127.0.0.1:{port}/viewer",
        subprotocols=["viser-v1.1.1"],  # pyright: ignore[reportArgumentType]
        origin=f"http://127.0.0.1:{port}",  # pyright: ignore[reportArgumentType]
        additional_headers={"Authorization": f"Bearer {TOKEN}"},
        max_size=None,
    ) as connection:
        connection.send(msgspec.msgpack.encode(CAMERA))
        yield connection


class Browser:
    """The messages of a viewer, as a browser takes them in."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
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
                self.receive(quiet)
        self._waiting.clear()

    def receive(self, timeout: float | None = None) -> list[dict[str, Any]]:
        """Wait for the messages that come next, all at once, and return them."""
        batch = self._connection.recv(timeout)
        assert isinstance(batch, bytes)
        size = int.from_bytes(batch[8:16], "little")
        messages = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(batch[16 : 16 + size]))["messages"]
        for message in messages:
            label = message.get("props", {}).get("label") if isinstance(message.get("props"), dict) else None
            if label:
                self.labels[label] = message["uuid"], message
        self._waiting.extend(messages)
        return messages

    def send(self, uuid: str, value: object) -> None:
        """Set a value as a person does."""
        message = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
        self._connection.send(msgspec.msgpack.encode(message))

    def _next(self) -> dict[str, Any]:
        while not self._waiting:
            self.receive()
        return self._waiting.popleft()


def changes_robot(message: dict[str, Any]) -> bool:
    """Tell whether a message gives the robot other parts, or its parts other sizes or shapes: playback moves them."""
    if not str(message.get("name", "")).startswith("/robot/"):
        return False
    changed = set(message.get("updates", ()))
    return message["type"] != "SceneNodeUpdateMessage" or bool({"batched_scales", "vertices"} & changed)


class Share:
    """The share of one core that a process takes while this stands open."""

    def __init__(self, process: psutil.Process) -> None:
        self._process = process

    def __enter__(self) -> "Share":
        self._began, self._spent = time.monotonic(), seconds_of(self._process)
        return self

    def __exit__(self, *_: object) -> None:
        spent = seconds_of(self._process) - self._spent
        self.percent = 100 * spent / (time.monotonic() - self._began)


def seconds_of(process: psutil.Process) -> float:
    """Return the CPU seconds that a process has taken so far."""
    return sum(process.cpu_times()[:2])


def _serves(words: list[str], port: int) -> bool:
    return "serve" in words and str(port) in words
