"""Many at once: strangers who never finish a request, imports of zips that unpack to much, and abandoned uploads.

The studio answers others meanwhile, and what it has taken of memory it gives back.
"""

import concurrent.futures
import contextlib
import io
import random
import socket
import threading
import time
import zipfile
from collections.abc import Iterator

import httpx
import msgspec
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from studio.export.design_file import LARGEST
from studio.patience import MOST_WAITING
from tests.attack.frames import messages
from tests.attack.outcome import Outcome
from tests.attack.target import CAMERA, Target, target

UNFINISHED = (
    b"",
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Long: ",
    b"POST /api/runs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 100000\r\n\r\nhalf",
    b"POST /api/runs HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhe",
    b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET / HT",
)
"""How strangers begin: with nothing, a header, a body, a chunk, or a second header; more comes a byte at a time."""
LEFT_OPEN = 20
"""Largest number of descriptors that strangers may leave behind; a page that came meanwhile has a few."""
PATIENCE = 10.0
"""Seconds within which others are answered, on a machine that does other things."""
IMPORTS_AT_ONCE = 12
_NO_BUTTON = "none"
GROWTH = 100.0
"""Largest growth in MB while zips are imported, however many at once."""
UPLOADING = 250.0
"""Largest growth in MB while files are sent that never end: four of 32 MiB, what is on its way, and eight pages."""
LEFT = 120.0
"""Largest growth in MB once those who sent them have left: what the C library keeps for the next ones, however many
rounds there are; the studio holds nothing of it."""


def attack_strangers(connections: int, seed: int, quiet: bool = False, seconds: float = 45.0) -> Outcome:
    """Hold so many connections that never finish a request for some seconds, beginning anew where one is closed."""
    outcome, rng = Outcome("strangers", connections, "connections", seed, quiet=quiet), random.Random(seed)
    with target() as server, _Asker(server, outcome, "longest wait of others, s"):
        descriptors, ended, anew = server.process.num_fds(), time.monotonic() + seconds, 0
        crowd: list[socket.socket | None] = [None] * connections
        most = 0
        while time.monotonic() < ended:
            for i, stranger in enumerate(crowd):
                if stranger is None:
                    crowd[i] = _stranger(server, rng)
                    anew += 1
                    outcome.add(int(outcome.tried < connections))
                elif not _drips(stranger):
                    stranger.close()
                    crowd[i] = None
            most = max(most, server.process.num_fds() - descriptors)
            time.sleep(0.5)
        if not server.serves_a_newcomer():
            outcome.fault("a browser that comes meanwhile is not served")
        for stranger in filter(None, crowd):
            stranger.close()
        time.sleep(3)
        left = server.process.num_fds() - descriptors
        if most > 2 * MOST_WAITING or left > LEFT_OPEN:
            outcome.fault(f"{most} connections of strangers were open at once, and {left} after they had left")
        outcome.figures |= {
            "connections begun": float(anew),
            "most open at once": float(most),
            "open 3 s after they left": float(left),
            "log, bytes": float(server.log.stat().st_size),
        }
    return outcome.end()


def attack_memory(rounds: int, seed: int, quiet: bool = False) -> Outcome:
    """Import zips that unpack to much, and begin uploads that never end, twelve at once, so many times each."""
    outcome = Outcome("memory", 2 * rounds, "rounds", seed, quiet=quiet)
    with target(asleep=True, MORPH_TRAINERS="1") as server, _Asker(server, outcome, "longest wait of others, s"):
        with server.client() as client:
            client.get("/api/tasks")
        server.serves_a_newcomer()
        time.sleep(1)
        began = server.megabytes()
        with _peak(server) as peak:
            for _ in range(rounds):
                _import_at_once(server, outcome)
                outcome.add()
        _judge(outcome, "12 imports at once, MB", peak[0] - began, GROWTH)
        with _peak(server) as peak:
            for _ in range(rounds):
                if not _abandon_uploads(server):
                    outcome.fault("no browser was shown a button for uploads, so that nothing was sent")
                outcome.add()
        _judge(outcome, "12 uploads at once, MB", peak[0] - began, UPLOADING)
        time.sleep(3)
        _judge(outcome, "after all have left, MB", server.megabytes() - began, LEFT)
        for error in server.errors():
            outcome.fault(f"a traceback in the server's log: {error}")
    return outcome.end()


def _judge(outcome: Outcome, name: str, grown: float, most: float) -> None:
    outcome.figures[name] = f"{grown:+.0f}"
    if grown > most:
        outcome.fault(f"{name}: {grown:+.0f}, more than {most:.0f}")


def _import_at_once(server: Target, outcome: Outcome) -> None:
    """Send zips of which one holds an endless design and one much besides it, all at once."""
    bombs = []
    for entries in ({"design.json": LARGEST - 1, "x.stl": 200 << 20}, {"design.json": 200 << 20}):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, size in entries.items():
                archive.writestr(name, bytes(size))
        bombs.append(buffer.getvalue())

    def send(number: int) -> int:
        with server.client(120) as client:
            return client.post("/api/designs", content=bombs[number % 2]).status_code

    with concurrent.futures.ThreadPoolExecutor(IMPORTS_AT_ONCE) as pool:
        for status in pool.map(send, range(IMPORTS_AT_ONCE)):
            if not 400 <= status < 500:
                outcome.fault(f"a zip that unpacks to 200 MiB is answered with {status}")


def _abandon_uploads(server: Target) -> int:
    """Let twelve browsers announce three files of 32 MiB each, send all but their last parts, and leave.

    Return how many of them were shown a button for it.
    """
    with concurrent.futures.ThreadPoolExecutor(IMPORTS_AT_ONCE) as pool:
        return sum(pool.map(lambda number: _abandon(server, number), range(IMPORTS_AT_ONCE)))


def _abandon(server: Target, number: int) -> bool:
    button = _NO_BUTTON
    with contextlib.suppress(ConnectionClosed, TimeoutError, OSError), server.browser() as browser:
        browser.send(msgspec.msgpack.encode(CAMERA))
        button = _upload_button(browser)
        for file in range(3):
            where = {"source_component_uuid": button, "transfer_uuid": f"{number}-{file}"}
            start = {"filename": "d.zip", "mime_type": "application/zip", "part_count": 64, "size_bytes": 32 << 20}
            browser.send(msgspec.msgpack.encode({"type": "FileTransferStartUpload", **where, **start}))
            for part in range(60):
                content = {"part_index": part, "content": bytes(500_000)}
                browser.send(msgspec.msgpack.encode({"type": "FileTransferPart", **where, **content}))
        time.sleep(2)
    return button != _NO_BUTTON


def _upload_button(browser: ClientConnection) -> str:
    """Return the name of the button for uploads, or one that nobody has where it does not come: the desk is taken."""
    with contextlib.suppress(TimeoutError):
        while True:
            for message in messages(browser.recv(timeout=5)):
                if message["type"] == "GuiUploadButtonMessage":
                    return message["uuid"]
    return _NO_BUTTON


def _stranger(server: Target, rng: random.Random) -> socket.socket | None:
    try:
        stranger = socket.create_connection(("127.0.0.1", server.port), timeout=1)
        stranger.sendall(rng.choice(UNFINISHED))
        stranger.setblocking(False)
        return stranger
    except OSError:
        return None


def _drips(stranger: socket.socket) -> bool:
    """Send one more byte; tell whether the connection is still open."""
    try:
        stranger.send(b"x")
        return stranger.recv(1) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


@contextlib.contextmanager
def _peak(server: Target) -> Iterator[list[float]]:
    """Give the largest memory of the server in MB while this stands open."""
    ended, peak = threading.Event(), [0.0]

    def look() -> None:
        while not ended.wait(0.02):
            peak[0] = max(peak[0], server.megabytes())

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        yield peak
    finally:
        ended.set()
        watcher.join()


class _Asker(contextlib.AbstractContextManager[None]):
    """Another client, who asks for the list of runs on a new connection, again and again."""

    def __init__(self, server: Target, outcome: Outcome, name: str) -> None:
        self._server, self._outcome, self._name = server, outcome, name
        self._ended, self._thread = threading.Event(), threading.Thread(target=self._ask)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(60)

    def _ask(self) -> None:
        slowest = 0.0
        while not self._ended.wait(0.5):
            began = time.monotonic()
            try:
                with self._server.client(PATIENCE) as client:
                    client.get("/api/runs").raise_for_status()
            except httpx.HTTPError as error:
                self._outcome.fault(f"another client is not answered: {error!r}")
            slowest = max(slowest, time.monotonic() - began)
            self._outcome.figures[self._name] = round(slowest, 2)
