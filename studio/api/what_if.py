"""POST /api/runs/{id}/evaluate and /sensitivity: what if a run's design were another."""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Annotated, TypeVar

import anyio.to_thread
import msgspec
from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import StreamingResponse

from studio.api.messages import Refusal, body_of, gives, gives_file, reply, takes
from studio.cancellation import Cancellation, CancelledError
from studio.evaluator import EvaluatorError
from studio.runs import Runs
from studio.what_if import SweepPoint, WhatIf, WhatIfs, Wish

NOBODY_THERE = 499
"""Status of an answer that nobody reads, as the one who asked has left."""
T = TypeVar("T")


def what_if_router(runs: Runs, what_ifs: WhatIfs) -> APIRouter:
    """Return the routes that evaluate a run's policy on other designs; whoever leaves cancels what was asked."""
    router = APIRouter(prefix="/api/runs/{run_id}", tags=["what if"])

    @router.post(
        "/evaluate",
        openapi_extra=takes(Wish, required=False),
        responses=gives(WhatIf),
        summary="Success, return and reward terms of the policy of an iteration on any design of the task's own box",
    )
    async def evaluate(run_id: str, wish: Annotated[Wish, Depends(body_of(Wish))], request: Request) -> Response:
        cancellation = Cancellation()
        try:
            found = await _while_there(
                request, cancellation, lambda: what_ifs.evaluate(runs.get(run_id), wish, cancellation)
            )
        except CancelledError:
            return Response(status_code=NOBODY_THERE)
        return reply(found)

    @router.post(
        "/sensitivity",
        response_class=StreamingResponse,
        openapi_extra=takes(Wish, required=False),
        responses=gives_file(
            "text/event-stream",
            "An event `point` for each of 9 values of every parameter, then `done`; or `failed` with a reason",
        ),
        summary="Success and return along each design parameter, through the design that is given",
    )
    async def sensitivity(run_id: str, wish: Annotated[Wish, Depends(body_of(Wish))]) -> StreamingResponse:
        cancellation = Cancellation()

        def begin() -> Iterator[SweepPoint]:
            return what_ifs.sweep(runs.get(run_id), wish, cancellation)

        points = await anyio.to_thread.run_sync(begin)  # what is wrong with the wish is a 4xx, not a stream
        return StreamingResponse(_stream(points, cancellation), media_type="text/event-stream")

    return router


async def _while_there(request: Request, cancellation: Cancellation, work: Callable[[], T]) -> T:
    """Return what `work` does in a thread; cancel it once the client has left."""

    async def watch() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass
        cancellation.cancel()

    watching = asyncio.create_task(watch())
    try:
        return await anyio.to_thread.run_sync(work, abandon_on_cancel=True)
    finally:
        cancellation.cancel()
        watching.cancel()


async def _stream(points: Iterator[SweepPoint], cancellation: Cancellation) -> AsyncIterator[bytes]:
    try:
        while point := await anyio.to_thread.run_sync(next, points, None, abandon_on_cancel=True):
            yield _event("point", point)
        yield _event("done", {})
    except (ValueError, EvaluatorError) as error:
        yield _event("failed", Refusal(str(error)))
    finally:
        cancellation.cancel()


def _event(kind: str, content: object) -> bytes:
    return b"event: %s\ndata: %s\n\n" % (kind.encode(), msgspec.json.encode(content))
