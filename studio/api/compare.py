"""GET /api/compare: two designs of any runs of one task."""

from typing import Annotated

from fastapi import APIRouter, Query, Response

from studio.api.messages import gives, reply
from studio.compare import Compared, compare, split_place
from studio.runs import Runs

Place = Annotated[str, Query(description="RUN@DESIGN: best, latest or an iteration; RUN alone means the best design")]


def compare_router(runs: Runs) -> APIRouter:
    """Return the route that compares two designs."""
    router = APIRouter(prefix="/api", tags=["designs"])

    @router.get(
        "/compare",
        responses=gives(Compared),
        summary="Two designs of one task side by side: success, return, reward terms, phi, masses, and differences",
    )
    def compared(a: Place, b: Place) -> Response:
        (first, which), (second, other) = split_place(a), split_place(b)
        return reply(compare(runs.get(first), which, runs.get(second), other))

    return router
