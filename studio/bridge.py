"""Viser on the studio's own port: a guarded viser on loopback, its client's page, and the websocket between them."""

import asyncio
import contextlib
import gzip
import hmac
import io
import logging
import math
import secrets
from importlib.resources import files
from typing import Annotated

import msgspec
import viser
import websockets.asyncio.client
import websockets.asyncio.server
from fastapi import APIRouter, Request, Response
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.server import Server, ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.http11 import Request as UpgradeRequest
from websockets.http11 import Response as UpgradeResponse
from websockets.typing import Subprotocol

from studio.desks import KEY

MAX_MESSAGE = 1 << 20
"""Largest message that a browser may send, in bytes; the client's own are below 1 kB, but for parts of files."""
ALLOWED = frozenset(
    {
        "ViewerCameraMessage", "GuiUpdateMessage", "GuiButtonHoldMessage", "GuiFormDirtyMessage",
        "GuiFormSubmitMessage", "CommandTriggerMessage", "SceneNodeClickMessage", "SceneNodeDragMessage",
        "ScenePointerMessage", "TransformControlsUpdateMessage", "TransformControlsDragStartMessage",
        "TransformControlsDragEndMessage", "FileTransferPartAck",
    }
)  # fmt: skip
"""Kinds of messages that a browser may send to viser. Left out on purpose: share tunnels to another company's server,
and whatever kind viser gets newly."""
MAX_PARTS = 64
"""Largest number of parts of an uploaded file, of half a megabyte each; an exported design has a few."""


class UploadStart(msgspec.Struct, frozen=True, tag_field="type", tag="FileTransferStartUpload"):
    """Message by which a browser announces a file for an upload button."""

    source_component_uuid: str
    transfer_uuid: str
    filename: str
    mime_type: str
    part_count: Annotated[int, msgspec.Meta(ge=1, le=MAX_PARTS)]
    size_bytes: Annotated[int, msgspec.Meta(ge=1, le=MAX_PARTS * MAX_MESSAGE)]


class UploadPart(msgspec.Struct, frozen=True, tag_field="type", tag="FileTransferPart"):
    """Message that carries one part of an announced file."""

    source_component_uuid: str
    transfer_uuid: str
    part_index: Annotated[int, msgspec.Meta(ge=0, lt=MAX_PARTS)]
    content: bytes


UPLOADS = frozenset({"FileTransferStartUpload", "FileTransferPart"})
"""Kinds of messages that are admitted where all their fields are as they should be."""

_STYLE = (
    b"<style>.u-legend .u-value,.u-legend th::after{visibility:hidden}"
    b".u-wrap:hover~.u-legend .u-value,.u-wrap:hover~.u-legend th::after{visibility:visible}</style>"
)
"""Style that lets a chart's legend show values only while the pointer is in the chart: elsewhere it has none."""

_log = logging.getLogger(__name__)


class GuardedViser:
    """A viser server that answers on loopback only, and only to those who know its secret path."""

    def __init__(self) -> None:
        """Start viser behind the guard. Raise RuntimeError, with nothing left running, if viser did not take it."""
        secret, guarded = f"/{secrets.token_urlsafe(24)}".encode(), []
        serve = websockets.asyncio.server.serve

        def guarded_serve(handler: object, host: str, port: int, **options: object) -> Server:
            def gate(_: ServerConnection, request: UpgradeRequest) -> UpgradeResponse | None:
                path = request.path.partition("?")[0].encode("utf-8", "replace")
                if hmac.compare_digest(path, secret) and request.headers.get("Upgrade", "").lower() == "websocket":
                    return None
                return UpgradeResponse(403, "Forbidden", Headers({"Content-Length": "0"}), b"")

            guarded.append(host)
            options |= {"process_request": gate, "max_size": MAX_MESSAGE}
            return serve(handler, host, port, **options)  # pyright: ignore

        # viser offers no hook for this; the version is pinned and tests/studio/test_bridge.py holds it to it.
        websockets.asyncio.server.serve = guarded_serve  # pyright: ignore
        try:
            with _silence():
                self.server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        finally:
            websockets.asyncio.server.serve = serve  # pyright: ignore
        if guarded != ["127.0.0.1"]:
            self.stop()
            raise RuntimeError(f"viser {viser.__version__} did not take the guard: refusing to open it")
        self.port = self.server.get_port()
        self.address = f"ws://127.0.0.1:{self.port}{secret.decode()}"

    def stop(self) -> None:
        """Close the port and all connections."""
        with _silence():
            self.server.stop()


def _silence() -> contextlib.AbstractContextManager[object]:
    """Keep viser from printing the address of its inner port, which answers nobody, beside the studio's link."""
    return contextlib.redirect_stdout(io.StringIO())


def admit(message: bytes) -> bool:
    """Tell whether a browser's message may reach viser, which itself checks neither kinds nor fields nor numbers."""
    try:
        content = msgspec.msgpack.decode(message)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError):
        return False
    if not isinstance(content, dict) or content.get("type") not in ALLOWED | UPLOADS or not _is_finite(content):
        return False
    if content["type"] in UPLOADS:
        try:
            msgspec.convert(content, UploadStart | UploadPart)
        except msgspec.ValidationError:
            return False
    if content["type"] == "GuiUpdateMessage":  # viser sets any attribute of that name
        updates = content.get("updates")
        return isinstance(updates, dict) and set(updates) <= {"value"}
    return True


def _is_finite(value: object) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, dict):
        return all(_is_finite(item) for item in value.values())
    if isinstance(value, list):
        return all(_is_finite(item) for item in value)
    return True


async def relay(browser: WebSocket, address: str) -> None:
    """Copy messages between a browser and viser at `address`, both ways, until either side leaves."""
    versions = [Subprotocol(name) for name in browser.scope["subprotocols"] if name.startswith("viser-v")]
    try:
        upstream = await websockets.asyncio.client.connect(
            address, subprotocols=versions or None, compression=None, max_size=None, ping_interval=None, proxy=None
        )
    except (OSError, InvalidHandshake, TimeoutError):
        await browser.close(1013)
        return

    async def down() -> None:
        async for message in upstream:
            await browser.send_bytes(message if isinstance(message, bytes) else message.encode())

    async def up() -> None:
        while True:
            message = await browser.receive()
            if message["type"] == "websocket.disconnect":
                return
            content = message.get("bytes")
            if content is not None and len(content) <= MAX_MESSAGE and admit(content):
                await upstream.send(content)
            else:
                _log.warning("dropped a message that a browser may not send to the viewer")

    async with upstream:
        await browser.accept(subprotocol=upstream.subprotocol)
        tasks = {asyncio.create_task(down()), asyncio.create_task(up())}
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            for ended in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(ended, Exception) and not isinstance(ended, ConnectionClosed | WebSocketDisconnect):
                    _log.warning("the viewer's connection ended: %r", ended)
    with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # closed by the browser already
        await browser.close(upstream.close_code or 1000, upstream.close_reason or "")


def client_csp(host: str) -> str:
    """Return the content security policy of the client's page; it stops script injected through `?websocket=`."""
    return (
        "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; "
        "img-src data: blob:; font-src data:; worker-src blob:; "
        f"connect-src ws://{host} wss://{host} blob: data:; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
    )


def viewer_router() -> APIRouter:
    """Return the page at /viewer/ and the websocket at /viewer, and both for a browser that brings the key of its desk.

    `app.state.viser` is the guarded server.
    """
    router = APIRouter(include_in_schema=False)
    page = files(viser).joinpath("client/build/index.html").read_bytes().replace(b"</head>", _STYLE + b"</head>", 1)
    packed = gzip.compress(page, 6)

    @router.get("/viewer/")
    @router.get("/viewer/{key}/")
    def client(request: Request) -> Response:
        zipped = "gzip" in request.headers.get("accept-encoding", "")
        headers = {"Content-Security-Policy": client_csp(request.headers["host"]), "Vary": "Accept-Encoding"}
        if zipped:
            headers["Content-Encoding"] = "gzip"
        return Response(packed if zipped else page, media_type="text/html", headers=headers)

    @router.websocket("/viewer")
    @router.websocket("/viewer/{key}")
    async def bridge(browser: WebSocket, key: str = "") -> None:
        address = browser.app.state.viser.address
        await relay(browser, f"{address}?{key}" if KEY.fullmatch(key) else address)

    return router
