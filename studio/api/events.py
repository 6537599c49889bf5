"""GET /api/runs/{id}/events: the event log as server-sent events, from any `seq` on and then live."""

import time
from collections.abc import AsyncIterator
from typing import Annotated

import anyio
import anyio.to_thread
import msgspec
from fastapi import APIRouter, Header, Query
from fastapi.responses import StreamingResponse

from morph_core.protocol import AnyEvent, encode
from morph_core.run_folder import RunFolderError
from studio.api.messages import gives_file
from studio.runs import Runs

_INTERVAL = 0.2
_KEEP_ALIVE = 15.0
_MAX_SEQ = 2**53


def as_sent(event: AnyEvent) -> bytes:
    """Return one event in the format of server-sent events."""
    kind = msgspec.to_builtins(event)["kind"]
    return b"id: %d\nevent: %s\ndata: %s\n\n" % (event.seq, kind.encode(), encode(event))


async def stream(runs: Runs, run_id: str, after: int, follow: bool, stopping: anyio.Event) -> AsyncIterator[bytes]:
    """Yield the events beyond `after`, then new ones until the client leaves or the server stops."""
    sent, quiet_since = 0, time.monotonic()
    yield b"retry: 1000\n\n"
    while True:
        try:
            history = await anyio.to_thread.run_sync(runs.get, run_id)
        except RunFolderError as error:  # it was removed: a browser that returns is told so by a 404
            yield b"event: gone\ndata: %s\n\n" % msgspec.json.encode({"detail": str(error)})
            return
        new = [as_sent(event) for event in history.events[sent:] if event.seq > after]
        sent = len(history.events)
        if new:
            yield b"".join(new)
            quiet_since = time.monotonic()
        elif time.monotonic() - quiet_since > _KEEP_ALIVE:  # proxies cut silent connections
            yield b": still here\n\n"
            quiet_since = time.monotonic()
        if not follow:
            return
        with anyio.move_on_after(_INTERVAL):
            await stopping.wait()
            return


def events_router(runs: Runs, stopping: anyio.Event) -> APIRouter:
    """Return the route of the event log."""
    router = APIRouter(prefix="/api/runs/{run_id}", tags=["events"])

    @router.get(
        "/events",
        response_class=StreamingResponse,
        responses=gives_file("text/event-stream", "One event of the run per message; id is its seq"),
        summary="The event log, live",
    )
    async def events(
        run_id: str,
        after: Annotated[int, Query(ge=0, le=_MAX_SEQ, description="Leave out events up to this seq")] = 0,
        follow: Annotated[bool, Query(description="Stay for new events")] = True,
        last_event_id: Annotated[str | None, Header(description="As `after`, sent by a browser that returns")] = None,
    ) -> StreamingResponse:
        await anyio.to_thread.run_sync(runs.get, run_id)  # an unknown run is a 404, not an empty stream
        if last_event_id and last_event_id.isdecimal():
            after = max(after, min(int(last_event_id[:16]), _MAX_SEQ))
        return StreamingResponse(stream(runs, run_id, after, follow, stopping), media_type="text/event-stream")

    return router
