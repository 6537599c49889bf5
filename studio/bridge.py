"""Viser on the studio's own port: a guarded viser on loopback, its client's page, and the websocket between them."""

import asyncio
import contextlib
import dataclasses
import gzip
import hmac
import io
import logging
import secrets
from collections.abc import Callable
from importlib.resources import files
from typing import Annotated, Any, get_type_hints

import msgspec
import viser
import websockets.asyncio.client
import websockets.asyncio.server
from fastapi import APIRouter, Request, Response
from starlette.websockets import WebSocket, WebSocketDisconnect
from viser import _messages as viser_messages
from websockets.asyncio.server import Server, ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.http11 import Request as UpgradeRequest
from websockets.http11 import Response as UpgradeResponse
from websockets.typing import Subprotocol

from morph_core.config import LARGEST
from studio.credentials import KEY
from studio.elements import LONGEST_TEXT, element_of, is_there, settled
from studio.retries import SCRIPT as RETRIES
from studio.seldom import Seldom
from studio.uploads import Uploads

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
UPLOADS_LOOKED_AT = 10.0
"""Seconds between two looks for uploads that take too long."""
MAX_PARTS = 64
"""Largest number of parts of an uploaded file, of half a megabyte each; an exported design has a few."""


Word = Annotated[str, msgspec.Meta(max_length=500)]


class UploadStart(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="type", tag="FileTransferStartUpload"
):
    """Message by which a browser announces a file for an upload button."""

    source_component_uuid: Word
    transfer_uuid: Word
    filename: Word
    mime_type: Word
    part_count: Annotated[int, msgspec.Meta(ge=1, le=MAX_PARTS)]
    size_bytes: Annotated[int, msgspec.Meta(ge=1, le=MAX_PARTS << 19)]


class UploadPart(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="type", tag="FileTransferPart"):
    """Message that carries one part of an announced file."""

    source_component_uuid: Word
    transfer_uuid: Word
    part_index: Annotated[int, msgspec.Meta(ge=0, lt=MAX_PARTS)]
    content: bytes


Real = Annotated[float, msgspec.Meta(ge=-LARGEST, le=LARGEST)]
Point = tuple[Real, Real, Real]


class Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="type", tag="ViewerCameraMessage"):
    """Message by which a browser tells where its user looks from."""

    wxyz: tuple[Real, Real, Real, Real]
    position: Point
    look_at: Point
    up_direction: Point
    image_height: Real
    image_width: Real
    fov: Real
    near: Real
    far: Real


def _as_declared(kind: str) -> type[msgspec.Struct]:
    """Return what a message of a kind consists of: the fields that viser declares, each of its type, and no others.

    viser itself looks at neither, and keeps what it hands on to other browsers.
    """
    declared = getattr(viser_messages, kind)
    types, fields = get_type_hints(declared), list[Any]()
    for field in dataclasses.fields(declared):
        if field.init:
            default = [] if field.default is dataclasses.MISSING else [field.default]
            fields.append((field.name, types[field.name], *default))
    return msgspec.defstruct(kind, fields, tag_field="type", tag=kind, forbid_unknown_fields=True)


UPLOADS = {"FileTransferStartUpload": UploadStart, "FileTransferPart": UploadPart}
"""Messages of a file that is uploaded, which are counted as well."""
_SHAPES = {kind: _as_declared(kind) for kind in ALLOWED} | {"ViewerCameraMessage": Camera} | UPLOADS

_STYLE = (
    b"<style>.u-legend .u-value,.u-legend th::after{visibility:hidden}"
    b".u-wrap:hover~.u-legend .u-value,.u-wrap:hover~.u-legend th::after{visibility:visible}</style>" + RETRIES
)
"""Style that lets a chart's legend show values only while the pointer is in the chart: elsewhere it has none. With it
goes the script that keeps a connection."""

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
        self.uploads = Uploads(self._forget)
        self.dropped = Seldom(_log)
        """Warning about messages that were not passed on."""

    def passed_on(self, message: bytes, browser: object) -> bytes | None:
        """Return what viser gets of a message of a browser; None where it gets nothing.

        A number just outside the range of its element, as rounding leaves it, is the end of that range.
        """
        content = admit(message)
        if content is None:
            return None
        if not is_there(self.server, content.get("uuid"), content.get("source_component_uuid")):
            return None
        match content["type"]:
            case "GuiUpdateMessage":
                return self._settled(message, content)
            case "FileTransferStartUpload":
                size, parts = content["size_bytes"], content["part_count"]
                return message if self.uploads.begin(content["transfer_uuid"], browser, size, parts) else None
            case "FileTransferPart":
                size = len(content["content"])
                return message if self.uploads.take(content["transfer_uuid"], browser, size) else None
        return message

    def _settled(self, message: bytes, content: dict[str, Any]) -> bytes | None:
        element = element_of(self.server, content.get("uuid"))
        if element is None or "value" not in content["updates"]:
            return None
        given = content["updates"]["value"]
        try:
            value = settled(element, given)
        except ValueError:
            return None
        return message if value == given else msgspec.msgpack.encode(content | {"updates": {"value": value}})

    def _forget(self, transfer: str) -> None:
        """Take what has come of an upload out of viser, which keeps it until the last part."""
        for gui in (self.server.gui, *(client.gui for client in self.server.get_clients().values())):
            gui._current_file_upload_states.pop(transfer, None)

    def stop(self) -> None:
        """Close the port and all connections."""
        with _silence():
            self.server.stop()


def _silence() -> contextlib.AbstractContextManager[object]:
    """Keep viser from printing the address of its inner port, which answers nobody, beside the studio's link."""
    return contextlib.redirect_stdout(io.StringIO())


def admit(message: bytes) -> dict[str, Any] | None:
    """Return the content of a browser's message that may reach viser, which checks neither kinds nor fields nor
    numbers; None for any other."""
    try:
        content = msgspec.msgpack.decode(message)
        shape = _SHAPES.get(content["type"])
        if shape is None or not _can_be_held(content):
            return None
        msgspec.convert(content, shape)
    except (msgspec.MsgspecError, RecursionError, TypeError, KeyError, ValueError):  # Unicode's is a ValueError
        return None
    if content["type"] == "GuiUpdateMessage":  # viser sets any attribute of that name
        return content if set(content["updates"]) <= {"value"} else None
    return content


def _can_be_held(value: object) -> bool:
    """Tell whether every number and word in it is one that viser can hand on to any browser."""
    if isinstance(value, int | float):
        return abs(value) <= LARGEST
    if isinstance(value, str):
        return len(value) <= LONGEST_TEXT
    if isinstance(value, dict):
        return all(_can_be_held(key) and _can_be_held(item) for key, item in value.items())
    if isinstance(value, list):
        return all(_can_be_held(item) for item in value)
    return True


async def relay(browser: WebSocket, guarded: GuardedViser, address: str) -> None:
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
            passed = None
            if content is not None and len(content) <= MAX_MESSAGE:
                passed = guarded.passed_on(content, browser)
            if passed is None:
                guarded.dropped.warn("dropped a message that a browser may not send to the viewer")
            else:
                await upstream.send(passed)

    async def give_up() -> None:
        while True:
            await asyncio.sleep(UPLOADS_LOOKED_AT)
            guarded.uploads.give_up_late()

    async with upstream:
        await browser.accept(subprotocol=upstream.subprotocol)
        tasks = {asyncio.create_task(work()) for work in (down, up, give_up)}
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            for ended in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(ended, Exception) and not isinstance(ended, ConnectionClosed | WebSocketDisconnect):
                    _log.warning("the viewer's connection ended: %r", ended)
            guarded.uploads.leave(browser)
    with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # closed by the browser already
        await browser.close(upstream.close_code or 1000, upstream.close_reason or "")


def client_csp(host: str) -> str:
    """Return the content security policy of the client's page; it stops script injected through `?websocket=`."""
    return (
        "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; "
        "img-src data: blob:; font-src data:; worker-src blob:; "
        f"connect-src ws://{host} wss://{host} blob: data:; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
    )


def client_page(style: bytes = b"") -> Callable[[Request], Response]:
    """Return a function that answers a request with viser's client, with more style rules if wanted."""
    head = _STYLE + (b"<style>" + style + b"</style>" if style else b"") + b"</head>"
    page = files(viser).joinpath("client/build/index.html").read_bytes().replace(b"</head>", head, 1)
    packed = gzip.compress(page, 6)

    def answer(request: Request) -> Response:
        zipped = "gzip" in request.headers.get("accept-encoding", "")
        headers = {"Content-Security-Policy": client_csp(request.headers["host"]), "Vary": "Accept-Encoding"}
        if zipped:
            headers["Content-Encoding"] = "gzip"
        return Response(packed if zipped else page, media_type="text/html", headers=headers)

    return answer


def viewer_router() -> APIRouter:
    """Return the page at /viewer/ and the websocket at /viewer, and both for a browser that brings the key of its desk.

    `app.state.viser` is the guarded server.
    """
    router = APIRouter(include_in_schema=False)
    page = client_page()

    @router.get("/viewer/")
    @router.get("/viewer/{key}/")
    def client(request: Request) -> Response:
        return page(request)

    @router.websocket("/viewer")
    @router.websocket("/viewer/{key}")
    async def bridge(browser: WebSocket, key: str = "") -> None:
        guarded: GuardedViser = browser.app.state.viser
        await relay(browser, guarded, f"{guarded.address}?{key}" if KEY.fullmatch(key) else guarded.address)

    return router
