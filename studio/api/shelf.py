"""/runs and what is behind it: the table of all runs, their marks, pictures and traces, and the trash."""

from importlib.resources import files
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Response
from fastapi.responses import FileResponse

from studio.api.messages import Purged, body_of, gives, gives_file, gives_versioned, reply, takes, versioned
from studio.lines import Row
from studio.runs import Runs
from studio.shelf import trash
from studio.shelf.marks import Marks, MarksChange
from studio.shelf.thumbnails import Thumbnails
from studio.shelf.traces import MOST_RUNS, Overlay, overlay
from studio.shelf.trash import Trashed

_PAGE = Path(str(files("studio") / "page" / "runs.html"))


def shelf_router(runs: Runs, thumbnails: Thumbnails) -> APIRouter:
    """Return the routes of the runs page."""
    router = APIRouter(tags=["shelf"])

    @router.get("/runs", include_in_schema=False)
    def page() -> Response:
        return FileResponse(_PAGE)

    @router.get(
        "/api/table", responses=gives_versioned(list[Row]), summary="All runs with what they have come to, newest first"
    )
    def table(
        run: Annotated[list[str] | None, Query(description="Only this run; repeated for each")] = None,
        if_none_match: Annotated[list[str] | None, Header()] = None,
    ) -> Response:
        return versioned(reply(runs.rows(run)), if_none_match)

    @router.get("/api/traces", responses=gives(Overlay), summary="Evaluations of several runs, and means by method")
    def traces(run: Annotated[list[str], Query(description="A run; repeated for each")]) -> Response:
        names = list(dict.fromkeys(run))
        if len(names) > MOST_RUNS:
            raise ValueError(f"at most {MOST_RUNS} runs are drawn at once, these are {len(names)}")
        return reply(overlay([(name, *runs.evaluations(name)) for name in names]))

    @router.patch(
        "/api/runs/{run_id}/marks",
        openapi_extra=takes(MarksChange),
        responses=gives(Marks),
        summary="Star, name, note, tag or archive a run; what is left out stays as it is",
    )
    def mark(run_id: str, change: Annotated[MarksChange, Depends(body_of(MarksChange))]) -> Response:
        return reply(runs.mark(run_id, change))

    @router.put(
        "/api/runs/{run_id}/designs/{which}/star",
        responses=gives(Marks),
        summary="Star a design of a run: best, latest or an iteration",
    )
    def star(run_id: str, which: str) -> Response:
        return reply(runs.star(run_id, which, True))

    @router.delete(
        "/api/runs/{run_id}/designs/{which}/star", responses=gives(Marks), summary="Take the star of a design away"
    )
    def unstar(run_id: str, which: str) -> Response:
        return reply(runs.star(run_id, which, False))

    @router.get(
        "/api/runs/{run_id}/thumbnail.png",
        response_class=Response,
        responses=gives_file("image/png", "The picture"),
        summary="A small picture of a design: best, latest or an iteration",
    )
    def thumbnail(run_id: str, design: str = "best") -> Response:
        record, phi = runs.design(run_id, design)
        picture = thumbnails.of(record.task, record.task_options, phi)
        return Response(picture, media_type="image/png", headers={"Cache-Control": "private, max-age=3600"})

    @router.delete("/api/runs/{run_id}", responses=gives(Trashed), summary="Move a run into the trash")
    def discard(run_id: str) -> Response:
        return reply(runs.discard(run_id))

    @router.get("/api/trash", responses=gives(list[Trashed]), summary="Deleted runs, the last first")
    def trashed() -> Response:
        return reply(trash.trashed_runs(runs.folder))

    @router.post("/api/trash/{run_id}/restore", responses=gives(Row), summary="Bring a deleted run back")
    def restore(run_id: str) -> Response:
        runs.restore(run_id)
        return reply(runs.row(run_id))

    @router.delete("/api/trash", responses=gives(Purged), summary="Remove all deleted runs for good")
    def empty() -> Response:
        return reply(Purged(trash.empty(runs.folder)))

    return router
