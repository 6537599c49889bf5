"""GET /api/recorded: the recorded runs that come with the studio."""

from fastapi import APIRouter, Response

from studio.api.messages import RecordedRun, gives, reply
from studio.recordings import Recordings


def recorded_router(recordings: Recordings) -> APIRouter:
    """Return the route that lists the recorded runs; each is read like any other run, under /api/runs."""
    router = APIRouter(prefix="/api", tags=["runs"])

    def told(run_id: str) -> RecordedRun:
        try:
            recording = recordings.get(run_id)
        except ValueError as error:
            return RecordedRun(run=run_id, problem=str(error))
        record = recording.history.record
        return RecordedRun(
            run=run_id, task=record.task, method=record.method, seed=record.seed, label=recording.label,
            origin=recording.origin,
        )  # fmt: skip

    @router.get("/recorded", responses=gives(list[RecordedRun]), summary="Recorded runs, one of each task")
    def recorded() -> Response:
        return reply([told(run_id) for run_id in recordings.names()])

    return router
