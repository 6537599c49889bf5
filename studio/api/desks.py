"""/api/desks/{key}: what one browser shows, read and set by the page round its viewer."""

from typing import Annotated, Protocol

from fastapi import APIRouter, Depends, Request, Response
from fastapi import Path as InPath

from studio.api.messages import body_of, gives, reply, takes
from studio.credentials import KEY
from studio.viewer.view import Seen, View


class Desks(Protocol):
    """What the routes need of those who show runs to browsers."""

    def seen(self, key: str) -> Seen:
        """Return what the browser of this key shows, or showed last."""
        ...

    def put(self, key: str, view: View) -> None:
        """Let the browser of this key show something, now or as soon as it comes."""
        ...


Key = Annotated[str, InPath(pattern=f"^{KEY.pattern}$", description="Key that the page has drawn at random")]


def desks_router() -> APIRouter:
    """Return the routes of browsers' views; `app.state.desks` are the browsers."""
    router = APIRouter(prefix="/api/desks", tags=["desks"])

    @router.get("/{key}", responses=gives(Seen), summary="What one browser shows: run, iteration, and what is ticked")
    def seen(key: Key, request: Request) -> Response:
        return reply(_desks(request).seen(key))

    @router.put(
        "/{key}",
        openapi_extra=takes(View),
        responses=gives(View),
        summary="Let one browser show something; what is not among the ticks stays as it is",
    )
    def put(key: Key, wish: Annotated[View, Depends(body_of(View))], request: Request) -> Response:
        _desks(request).put(key, wish)
        return reply(wish)

    return router


def _desks(request: Request) -> Desks:
    return request.app.state.desks
