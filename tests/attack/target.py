"""The server that is attacked: `morph-studio serve` as a process of its own, with its log and its memory."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import httpx
import msgspec
import psutil
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from morph_core.run_folder import RunFolder, list_runs, process_alive

T = TypeVar("T")
ROOT = Path(__file__).parents[2]
TOKEN = "a-token-of-the-attack-of-enough-length"
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1, 1, 1], "fov": 1.0, "near": 0.1, "far": 100.0,
    "look_at": [0, 0, 0], "up_direction": [0, 0, 1], "image_height": 600, "image_width": 800,
}  # fmt: skip
"""The first message of a browser; only then it counts as connected."""


@dataclass
class Target:
    """A server at work."""

    port: int
    runs: Path
    log: Path
    empty: Path
    """Folder in which the server works, and into which it writes nothing."""
    process: psutil.Process

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def client(self, seconds: float = 30.0) -> httpx.Client:
        """Return a client that knows the token."""
        return httpx.Client(base_url=self.url, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=seconds)

    def browser(self, key: str = "", seconds: float = 30.0) -> ClientConnection:
        """Open the viewer's websocket as a browser of the studio's page does, before its first message."""
        return connect(
            f"ws://127.0.0.1:{self.port}/viewer" + (f"/{key}" if key else ""),
            origin=Origin(self.url),
            additional_headers={"Authorization": f"Bearer {TOKEN}"},
            subprotocols=[Subprotocol("viser-v1.1.1")],
            max_size=None,
            proxy=None,
            open_timeout=seconds,
            close_timeout=1,
        )

    def megabytes(self) -> float:
        """Return how much memory the server has, in MB."""
        return self.process.memory_info().rss / 1e6

    def is_up(self, seconds: float = 10.0) -> bool:
        """Tell whether the server answers within some seconds."""
        try:
            return self.process.is_running() and httpx.get(f"{self.url}/healthz", timeout=seconds).status_code == 200
        except httpx.HTTPError:
            return False

    def serves_a_newcomer(self, seconds: float = 60.0) -> bool:
        """Tell whether a browser that comes now is sent what a viewer is made of."""
        try:
            with self.browser(seconds=seconds) as browser:
                browser.send(msgspec.msgpack.encode(CAMERA))
                deadline, came = time.monotonic() + seconds, 0
                while came < 5000 and time.monotonic() < deadline:
                    came += len(browser.recv(timeout=seconds))
                return came >= 5000
        except (OSError, TimeoutError, psutil.Error):
            return False

    def errors(self) -> list[str]:
        """Return the tracebacks that the server has written to its log, each as its last lines."""
        lines, found, began = self.log.read_text(errors="replace").splitlines(), list[str](), None
        for number, line in enumerate(lines):
            if line.startswith("Traceback"):
                began = number
            elif began is not None and line and not line[0].isspace():
                found.append(" | ".join(part.strip() for part in lines[max(began, number - 5) : number + 1])[:600])
                began = None
        return found


@contextlib.contextmanager
def beside(*works: Callable[[threading.Event], object]) -> Iterator[None]:
    """Do each work in a thread of its own meanwhile; each gets the event that tells it to end."""
    ended = threading.Event()
    threads = [threading.Thread(target=work, args=(ended,)) for work in works]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join(60)


@contextlib.contextmanager
def target(*, asleep: bool = False, **environment: str) -> Iterator[Target]:
    """Serve a folder of runs that is gone afterwards, with trainers or such that sleep; end the server and them."""
    with tempfile.TemporaryDirectory() as home:
        runs, log, port, empty = Path(home) / "runs", Path(home) / "server.log", free_port(), Path(home) / "empty"
        empty.mkdir()
        ours = {key: value for key, value in os.environ.items() if not key.startswith(("MORPH_", "PORT"))}
        code = os.pathsep.join(filter(None, [str(ROOT), ours.get("PYTHONPATH")]))
        ours |= {"MORPH_TOKEN": TOKEN, "XDG_STATE_HOME": home, "PYTHONUNBUFFERED": "1", "PYTHONPATH": code}
        module = "tests.attack.asleep" if asleep else "studio.cli"
        command = [sys.executable, "-m", module, "serve", "--no-browser", "--port", str(port), "--runs", str(runs)]
        with log.open("wb") as written:
            server = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=written, stderr=written, cwd=empty, env=ours | environment
            )
        try:
            wait_for("the server's start", lambda: f":{port}/" in log.read_text(errors="replace"), 120)
            yield Target(port, runs, log, empty, psutil.Process(server.pid))
        finally:
            server.send_signal(signal.SIGINT)
            try:
                server.wait(20)
            except subprocess.TimeoutExpired:
                server.kill()
                server.wait()
            end_trainers(runs)


def end_trainers(runs: Path) -> None:
    """Kill every trainer of a folder of runs."""
    for name in list_runs(runs):
        beat = RunFolder(runs / name).heartbeat()
        if beat and process_alive(beat.pid, beat.process_started):
            os.kill(beat.pid, signal.SIGKILL)


def free_port() -> int:
    """Return a port of this machine on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(what: str, claim: Callable[[], T], seconds: float) -> T:
    """Return the first true value of `claim`; raise TimeoutError that says what was awaited."""
    deadline = time.monotonic() + seconds
    while not (value := claim()):
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited {seconds:.0f} s in vain for {what}")
        time.sleep(0.05)
    return value
