"""/api/news: what has changed in the list of runs and on one browser's screen, as soon as it has."""

import time
import zlib
from typing import Annotated

import anyio
import anyio.to_thread
import msgspec
from fastapi import APIRouter, Query, Request, Response

from studio.api.desks import Desks
from studio.api.messages import Bulletin, gives, reply
from studio.credentials import KEY
from studio.news import News

MAX_WAIT = 20.0
"""Longest time in seconds for which a request for news is held; proxies cut those that are held for a minute."""
_INTERVAL = 1.0
_MARK = r"^[0-9a-f]{16}\.[0-9]{1,15}\.[0-9]{1,10}$"


def news_router(news: News, boot: str, stopping: anyio.Event) -> APIRouter:
    """Return the route of the news; `app.state.desks` are the browsers, `boot` tells this start from others."""
    router = APIRouter(tags=["runs"])

    def look(desks: Desks, desk: str | None, after: str | None, fresh: bool) -> Bulletin:
        """Return what is new after a mark: the start of the server, the version of the list, and what the desk
        showed."""
        known_boot, version, known_view = (after or "..").split(".")
        change = news.since(int(version) if known_boot == boot else 0, fresh)
        seen = desks.seen(desk) if desk else None
        view = str(zlib.crc32(msgspec.json.encode(seen)))
        is_new = known_boot != boot or bool(change.lines) or change.ids is not None or view != known_view
        return Bulletin(boot, f"{boot}.{change.version}.{view}", is_new, change.lines, change.ids, seen)

    @router.get(
        "/api/news",
        responses=gives(Bulletin),
        summary="What has changed in the list of runs; with `wait`, as soon as something has",
    )
    async def bulletin(
        request: Request,
        after: Annotated[
            str | None, Query(pattern=_MARK, description="`mark` of the last answer; without it, everything is told")
        ] = None,
        wait: Annotated[float, Query(ge=0, le=MAX_WAIT, description="Seconds to wait for something new")] = 0.0,
        desk: Annotated[
            str | None, Query(pattern=f"^{KEY.pattern}$", description="Key of a browser whose view is told too")
        ] = None,
    ) -> Response:
        until = time.monotonic() + wait
        while True:
            told = await anyio.to_thread.run_sync(look, request.app.state.desks, desk, after, wait == 0)
            if told.is_new or stopping.is_set() or time.monotonic() >= until:
                return reply(told)
            with anyio.move_on_after(_INTERVAL):
                await stopping.wait()

    return router
