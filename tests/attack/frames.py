"""Websocket frames that no browser sends: noise, forged kinds, wild values, deep, cut off and far too large ones.

After each batch the server answers, shows itself to a browser that comes new, and has done nothing that it must not:
no file written where it works, no connection to another machine, nothing told to another browser that is not its own.
"""

import contextlib
import math
import random
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import httpx
import msgspec
import psutil
import zstandard
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection

from studio.bridge import ALLOWED, MAX_MESSAGE, UPLOADS
from tests.attack.outcome import Outcome
from tests.attack.target import CAMERA, Target, beside, target
from tests.studio.conftest import make_run

KINDS = tuple(sorted(kind.__name__ for kind in _messages.Message.get_subclasses()))
"""Every kind of message that viser knows, those from the server to a browser too."""
NUMBERS = (
    0, 1, -1, 0.5, 1e20, -1e20, 1e308, 1e39, 2**53, -(2**53), 2**63 - 1, -(2**63), 2**64 - 1, math.nan, math.inf,
    -math.inf, 5e-324,
)  # fmt: skip
WORDS = (
    "",
    "\0",
    "<script>alert(1)</script>",
    "../../etc/passwd",
    "\x1b]0;x\x07",
    "\u202e",
    "A" * 5000,
    "link_1",
    "best",
)
_SLOWEST = 30.0
"""Seconds within which the server answers another client during the attack, on a machine that does other things."""
_BATCH = 5000


def attack_frames(frames: int, seed: int, quiet: bool = False) -> Outcome:
    """Send so many frames to a real server whose trainers sleep, in batches."""
    outcome, rng = Outcome("frames", frames, "frames", seed, quiet=quiet), random.Random(seed)
    with target(asleep=True, MORPH_TRAINERS="2") as server:
        for number in range(3):
            make_run(server.runs, f"20260101-00000{number}-reacher-morph-s{number}")
        began, cut, log = server.megabytes(), 0, server.log.stat().st_size
        with _bystander(server, outcome):
            while outcome.tried < frames:
                cut += _batch(server, rng, min(_BATCH, frames - outcome.tried), outcome)
                if not server.is_up(_SLOWEST):
                    outcome.fault("the server does not answer any more")
                    break
                if not server.serves_a_newcomer():
                    outcome.fault("a browser that comes new is not served")
                    break
                _look_for_escapes(server, outcome)
        outcome.figures |= {
            "connections ended": float(cut),
            "server MB": f"{began:.0f} to {server.megabytes():.0f}",
            "log, bytes a frame": (server.log.stat().st_size - log) / max(1, outcome.tried),
        }
        for error in server.errors():
            outcome.fault(f"a traceback in the server's log: {error}")
    return outcome.end()


def _batch(server: Target, rng: random.Random, frames: int, outcome: Outcome) -> int:
    """Send frames over one connection, or over a new one where it was ended; return how often it was."""
    cut, connection, elements = 0, None, list[str]()
    for _ in range(frames):
        try:
            if connection is None:
                connection, elements = _arrive(server)
                if not elements:
                    outcome.fault("the attacker's browser is shown nothing, so that nothing is attacked")
            connection.send(Forger(rng, elements).frame())
        except (ConnectionClosed, InvalidHandshake, OSError, TimeoutError):
            cut += 1
            connection = None
        outcome.add()
    with contextlib.suppress(ConnectionClosed, OSError):
        if connection is not None:
            connection.close()
    return cut


def _arrive(server: Target) -> tuple[ClientConnection, list[str]]:
    """Return a connection of the attacker, and the names of the elements that it was shown."""
    connection = server.browser()
    connection.send(msgspec.msgpack.encode(CAMERA))
    elements: list[str] = []
    until = time.monotonic() + 3.0
    while time.monotonic() < until:
        try:
            elements += [m["uuid"] for m in messages(connection.recv(timeout=1.0)) if isinstance(m.get("uuid"), str)]
        except TimeoutError:
            break
    threading.Thread(target=_take_in, args=(connection,), daemon=True).start()
    return connection, elements


def _take_in(connection: ClientConnection) -> None:
    with contextlib.suppress(ConnectionClosed, OSError):
        for _ in connection:
            pass


def messages(batch: object) -> list[dict[str, Any]]:
    """Return the messages of a batch of viser's."""
    if not isinstance(batch, bytes):
        return []
    size = struct.unpack("<QQ", batch[:16])[1]
    return msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(batch[16 : 16 + size]))["messages"]


@dataclass
class Forger:
    """Maker of frames against a page with some elements."""

    rng: random.Random
    elements: list[str]

    def frame(self) -> bytes | str:
        """Return a frame of a random sort."""
        (sort,) = self.rng.choices(list(SORTS), weights=list(SORTS.values()))
        return getattr(self, sort)()

    def noise(self) -> bytes:
        """Return random bytes."""
        return self.rng.randbytes(self.rng.randrange(200))

    def text(self) -> str:
        """Return text, which viser never sends."""
        return self._of(WORDS) + "".join(chr(self.rng.randrange(32, 0xD7FF)) for _ in range(self.rng.randrange(50)))

    def shapeless(self) -> bytes:
        """Return what msgpack reads and is no message."""
        return msgspec.msgpack.encode(self._value())

    def forged(self) -> bytes:
        """Return any kind of message of viser with fields of its own names, and wild values."""
        kind = self._of(KINDS)
        fields = list(getattr(getattr(_messages, kind, None), "__annotations__", {})) or ["uuid", "updates"]
        return msgspec.msgpack.encode({"type": kind} | {name: self._value() for name in fields if self._chance(0.9)})

    def nearly_right(self) -> bytes:
        """Return an allowed kind with the fields of a right one, of which some are wild."""
        right: dict[str, Any] = CAMERA | {
            "uuid": self._element(), "name": "/robot", "source_component_uuid": self._element(),
            "transfer_uuid": str(self.rng.randrange(9)), "filename": "d.json", "mime_type": "application/json",
            "part_count": 2, "size_bytes": 1000, "part_index": 0, "content": b"{}", "updates": {"value": self._value()},
        }  # fmt: skip
        wild = {name: self._value() for name in right if self._chance(0.2)}
        return msgspec.msgpack.encode(right | wild | {"type": self._of(sorted(ALLOWED | UPLOADS.keys()))})

    def wild_value(self) -> bytes:
        """Return a value for an element that is there, or one for an attribute of it that nobody may set."""
        name = "value" if self._chance(0.9) else self._of(("update_cb", "min", "max", "__class__", "disabled"))
        return msgspec.msgpack.encode(
            {"type": "GuiUpdateMessage", "uuid": self._element(), "updates": {name: self._value(2)}}
        )

    def deep(self) -> bytes:
        """Return what is nested deeper than any reader follows."""
        return self._of((b"\x91", b"\x81\xa1x")) * self._of((100, 1000, 100_000)) + b"\x01"

    def cut_off(self) -> bytes:
        """Return the beginning of a frame."""
        whole = self.nearly_right()
        return whole[: self.rng.randrange(len(whole))]

    def too_large(self) -> bytes:
        """Return what is as large as any message may be, or larger."""
        return bytes(MAX_MESSAGE + self._of((0, 1, 1000, 4 << 20)))

    def _value(self, depth: int = 3) -> Any:
        """Return anything that msgpack holds."""
        match self.rng.randrange(8 if depth else 5):
            case 0 | 1:
                return self._of(NUMBERS)
            case 2:
                return self._of(WORDS)
            case 3:
                return self._of((None, True, False, b"", b"\0\1\2"))
            case 4:
                return self.rng.uniform(-10, 10)
            case 5 | 6:
                return [self._value(depth - 1) for _ in range(self.rng.randrange(5))]
        return {self._of(("value", "x", "type")): self._value(depth - 1) for _ in range(self.rng.randrange(4))}

    def _element(self) -> str:
        return self._of(self.elements or ["none"])

    def _of(self, choices: Sequence[Any]) -> Any:
        return self.rng.choice(choices)

    def _chance(self, share: float) -> bool:
        return self.rng.random() < share


SORTS = {
    "noise": 25, "text": 10, "shapeless": 15, "forged": 15, "nearly_right": 15, "wild_value": 15, "cut_off": 5,
    "deep": 0.2, "too_large": 0.02,
}  # fmt: skip
"""The sorts of frames, by their method, and how often each comes."""


def _look_for_escapes(server: Target, outcome: Outcome) -> None:
    written = [str(path.relative_to(server.empty)) for path in server.empty.rglob("*")]
    if written:
        outcome.fault(f"written where the server works: {', '.join(written[:5])}")
    beside = {path.name for path in server.empty.parent.iterdir()} - {"runs", "server.log", "empty", "morph-studio"}
    if beside:
        outcome.fault(f"written beside the runs: {', '.join(sorted(beside)[:5])}")
    for process in (server.process, *server.process.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):  # it has just ended
            for link in process.net_connections("inet"):
                if link.raddr and not link.raddr.ip.startswith(("127.", "::1", "::ffff:127.")):
                    outcome.fault(f"a connection to {link.raddr.ip}")


@contextlib.contextmanager
def _bystander(server: Target, outcome: Outcome) -> Iterator[None]:
    """Watch from a browser and by a request every second; note what must not come, and the longest wait."""
    slowest = [0.0]
    try:
        with beside(lambda ended: _watch(server, ended, outcome), lambda ended: _ask(server, ended, slowest, outcome)):
            yield
    finally:
        outcome.figures["longest wait of another client, s"] = round(slowest[0], 2)


def _watch(server: Target, ended: threading.Event, outcome: Outcome) -> None:
    mine: set[str] = set()
    try:
        with server.browser("a-bystander-of-the-attack") as browser:
            browser.send(msgspec.msgpack.encode(CAMERA))
            while not ended.is_set():
                with contextlib.suppress(TimeoutError):
                    for message in messages(browser.recv(timeout=0.5)):
                        if message["type"] in ("RunJavascriptMessage", "ShareUrlUpdated"):
                            outcome.fault(f"another browser was told {message['type']}")
                        mine.add(message["type"])
    except ConnectionClosed as end:
        outcome.fault(f"another browser's connection was ended: {end}")
    outcome.figures["kinds of messages of another browser"] = float(len(mine))
    if not mine:
        outcome.fault("another browser is shown nothing")


def _ask(server: Target, ended: threading.Event, slowest: list[float], outcome: Outcome) -> None:
    while not ended.wait(1.0):
        began = time.monotonic()
        try:
            httpx.get(f"{server.url}/healthz", timeout=_SLOWEST).raise_for_status()
        except httpx.HTTPError as error:
            outcome.fault(f"another client got no answer: {error!r}")
        slowest[0] = max(slowest[0], time.monotonic() - began)
