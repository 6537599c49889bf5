"""/audience: the page of spectators, and all that they may ask for. Nothing that comes in reaches viser or a run."""

import asyncio
import contextlib
import html
import logging
from collections.abc import AsyncIterator
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import anyio
import viser
from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi import Path as InPath
from fastapi.responses import FileResponse, HTMLResponse, StreamingResponse
from starlette.websockets import WebSocket, WebSocketDisconnect

from morph_core.run_folder import RunFolderError
from studio.api.messages import Follow, body_of, gives, gives_file, reply, takes
from studio.audience import ENDED, FULL, Audience, said
from studio.bridge import admit, client_page
from studio.credentials import KEY
from studio.evolutions import Evolutions
from studio.invitation import AUDIENCE
from studio.security import Access, style_digest
from studio.seldom import Seldom

ALLOWED = frozenset({"ViewerCameraMessage"})
"""Kinds of messages that a spectator's browser may send: of its camera's, the shape of the picture is taken in."""
MAX_MESSAGE = 4096
"""Largest such message, in bytes; the client's own have 300."""
_BREATH = 1 / 30
"""Seconds between two messages that are taken from one spectator: more of them wait where they are."""
_SLOWEST = 20.0
"""Seconds for one frame after which a spectator who does not take it is given up."""
_ONLY_SCENE = b"#root [class*=dock],#root .mantine-Paper-root,.mantine-Affix-root{display:none!important}"
_ALONE = "sandbox allow-scripts; frame-ancestors 'self'"
"""Policy of a page that a spectator looks at alone, beside its own, which lets nothing in: it is of no origin, so that
it can't even send the spectator's cookie."""
_SENTENCES: dict[int | str, dict[str, object]] = {
    404: {"description": "No such run, in words for the spectator", "content": {"text/html": {}}}
}
"""What takes the place of a page that there is not, in the description of the interface."""
_SENTENCE_STYLE = (
    ":root{color-scheme:light dark}body{font:16px/1.5 system-ui,sans-serif;max-width:34rem;margin:18vh auto;"
    "padding:0 1.5rem}"
)

_log = logging.getLogger(__name__)
Key = Annotated[str, InPath(pattern=f"^{KEY.pattern}$", description="Key that the page has drawn at random")]


def spectators_router(audience: Audience, access: Access, evolutions: Evolutions) -> APIRouter:
    """Return the routes of spectators; each is named in `studio.invitation` too, or no spectator gets there."""
    router = APIRouter(prefix=AUDIENCE, tags=["audience"])
    page, client = Path(str(files("studio") / "page" / "audience.html")), client_page(_ONLY_SCENE)
    dropped = Seldom(_log)

    @router.get("", include_in_schema=False)
    def shell() -> Response:
        return FileResponse(page)

    @router.get("/viewer/{key}/", include_in_schema=False)
    def scene(key: Key, request: Request) -> Response:
        del key  # the client finds its websocket by it
        return client(request)

    @router.get(
        "/events",
        response_class=StreamingResponse,
        responses=gives_file("text/event-stream", "stage, curves; ended or full is the last one"),
        summary="What the presenter shows, in words and curves; takes a seat for as long as it is read",
    )
    async def events(
        request: Request,
        seat: Annotated[str, Query(pattern=f"^{KEY.pattern}$", description="Key that the page has drawn at random")],
    ) -> StreamingResponse:
        async def stream() -> AsyncIterator[bytes]:
            taken = audience.take_seat(seat) if audience.state.open and access.may_watch(request.headers) else None
            if taken is None:
                yield said("full", FULL) if audience.state.open else said("ended", ENDED)
                return
            try:
                async for piece in audience.words(taken):
                    yield piece
            finally:
                audience.leave(taken)

        return StreamingResponse(stream(), media_type="text/event-stream")

    @router.put(
        "/seats/{key}",
        openapi_extra=takes(Follow),
        responses=gives(Follow),
        summary="Let a spectator's camera be the presenter's, or its own",
    )
    async def follow(key: Key, wish: Annotated[Follow, Depends(body_of(Follow))]) -> Response:
        seat = audience.seat(key)
        if seat is None:
            raise RunFolderError("there is no such seat: it is taken by /audience/events")
        audience.follow(seat, wish.follows)
        return reply(wish)

    @router.get(
        "/runs/{run_id}/evolution.html",
        response_class=Response,
        responses=gives_file("text/html", "One page that asks for nothing: bodies, traces and episodes") | _SENTENCES,
        summary="The whole evolution of a run that the presenter has shown, for a spectator to look at alone",
    )
    async def evolution(run_id: str) -> Response:
        if run_id not in audience.offered:
            return _sentence("The presenter has not shown this run. Choose another one above.", 404)
        try:
            content = await evolutions.page(run_id)
        except (ValueError, OSError) as error:
            return _sentence(f"This run can't be looked at now: {error}.", 404)
        headers = {"Content-Security-Policy": _ALONE, "Content-Encoding": "identity"}  # what it carries is compressed
        return Response(content, media_type="text/html; charset=utf-8", headers=headers)

    @router.websocket("/viewer/{key}")
    async def watch(browser: WebSocket, key: str) -> None:
        seat, version = audience.seat(key), f"viser-v{viser.__version__}"
        if seat is None or version not in browser.scope["subprotocols"] or not access.may_watch(browser.headers):
            await browser.close(4403)
            return
        await browser.accept(subprotocol=version)

        async def down() -> None:
            async for frame in audience.scenes(seat, browser):
                with anyio.fail_after(_SLOWEST):
                    await browser.send_bytes(frame)

        async def up() -> None:
            while True:
                message = await browser.receive()
                if message["type"] == "websocket.disconnect":
                    return
                aspect = aspect_of(message.get("bytes"))
                if aspect is None:
                    dropped.warn("dropped a message that a spectator may not send")
                else:
                    audience.hear(seat, aspect)
                await asyncio.sleep(_BREATH)

        tasks = {asyncio.create_task(work()) for work in (down, up)}
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # closed by the browser already
            await browser.close(4403 if seat.ended else 1000, seat.ended)

    return router


def _sentence(words: str, status: int) -> Response:
    """Return a page that says a sentence in the place of another one."""
    policy = f"default-src 'none'; style-src '{style_digest(_SENTENCE_STYLE)}'; {_ALONE}"
    content = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>MORPH Studio</title>'
        f"<style>{_SENTENCE_STYLE}</style><p>{html.escape(words)}</p></html>"
    )
    return HTMLResponse(content, status, {"Content-Security-Policy": policy})


def aspect_of(message: bytes | None) -> float | None:
    """Return width / height of the picture of a camera message; None of whatever else a spectator sends."""
    content = admit(message) if message is not None and len(message) <= MAX_MESSAGE else None
    if content is None or content["type"] not in ALLOWED:
        return None
    width, height = float(content["image_width"]), float(content["image_height"])
    return min(max(width / height, 0.1), 10.0) if width > 0 and height > 0 else None
