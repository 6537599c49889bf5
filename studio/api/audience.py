"""/api/audience: the link by which spectators come in, made and revoked, and how many of them watch."""

from typing import Annotated

from fastapi import APIRouter, Depends, Response

from studio.api.messages import Invite, body_of, gives, reply, takes
from studio.audience import Audience, AudienceState


def audience_router(audience: Audience) -> APIRouter:
    """Return the presenter's routes of the audience."""
    router = APIRouter(prefix="/api/audience", tags=["audience"])

    @router.get("", responses=gives(AudienceState), summary="The spectators' link, and how many watch")
    async def state() -> Response:
        return reply(audience.state)

    @router.post(
        "",
        openapi_extra=takes(Invite, required=False),
        responses=gives(AudienceState),
        summary="Let spectators in: the link that there is, or a new one, and which browser they watch",
    )
    async def open_(wish: Annotated[Invite, Depends(body_of(Invite))]) -> Response:
        return reply(audience.open(wish.presenter))

    @router.delete("", responses=gives(AudienceState), summary="Void the link, and send all spectators away at once")
    async def close() -> Response:
        return reply(audience.close())

    return router
