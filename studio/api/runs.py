"""/api/runs: list, start, steer and resume runs."""

from typing import Annotated

import msgspec
from fastapi import APIRouter, Depends, Header, Query, Request, Response

from morph_core.protocol import AnyCommand
from morph_core.run_folder import RunFolderError
from studio.api.messages import (
    Accepted,
    ResumeRun,
    RunState,
    body_of,
    gives,
    gives_versioned,
    reply,
    sender_of,
    takes,
    versioned,
)
from studio.branches import children_of
from studio.limits import LAST_ITERATION
from studio.lines import Summary
from studio.log import LogEntry, log_of
from studio.moments import Moment, moment_of
from studio.new_run import StartRun
from studio.runs import Runs

_ANSWERS_SHOWN = 20


def state_of(runs: Runs, run_id: str) -> RunState:
    """Return one run in full; raise RunFolderError only if there is no such run."""
    line = {**msgspec.structs.asdict(runs.summary(run_id)), "current": runs.shown == run_id}
    try:
        history = runs.get(run_id)
    except RunFolderError:
        return RunState(**line)
    record = history.record
    return RunState(
        **line,
        task_options=record.task_options,
        config=record.config,
        parameters=list(history.design_space.parameters),
        phi=history.phi.tolist(),
        versions=record.versions,
        git_revision=record.git_revision,
        git_dirty=record.git_dirty,
        begins_at=record.begins_at,
        children=tuple(children_of(run_id, runs.parents())),
        best=history.best,
        last_seq=history.events[-1].seq if history.events else 0,
        acknowledged=tuple(history.acknowledged[-_ANSWERS_SHOWN:]),
    )


def runs_router(runs: Runs) -> APIRouter:
    """Return the routes that list and steer runs."""
    router = APIRouter(prefix="/api/runs", tags=["runs"])

    @router.get("", responses=gives_versioned(list[Summary]), summary="All runs, newest first")
    def summaries(if_none_match: Annotated[list[str] | None, Header()] = None) -> Response:
        return versioned(reply(runs.summaries()), if_none_match)

    @router.post(
        "",
        status_code=201,
        openapi_extra=takes(StartRun),
        responses=gives(RunState, 201),
        summary="Start a run, or branch one from another",
    )
    def start(wish: Annotated[StartRun, Depends(body_of(StartRun))]) -> Response:
        return reply(state_of(runs, runs.start(wish)), 201)

    @router.get("/{run_id}", responses=gives(RunState), summary="One run in full")
    def state(run_id: str) -> Response:
        return reply(state_of(runs, run_id))

    @router.post(
        "/{run_id}/commands",
        status_code=202,
        openapi_extra=takes(AnyCommand),
        responses=gives(Accepted, 202),
        summary="Send a command to a running run; the trainer acknowledges it as an event",
    )
    def send(run_id: str, request: Request, command: Annotated[AnyCommand, Depends(body_of(AnyCommand))]) -> Response:
        return reply(Accepted(runs.send(run_id, command, sender_of(request))), 202)

    @router.get("/{run_id}/log", responses=gives(list[LogEntry]), summary="What was done to a run, oldest first")
    def log(run_id: str) -> Response:
        return reply(log_of(runs.get(run_id)))

    @router.get(
        "/{run_id}/moments/{which}",
        responses=gives(Moment),
        summary="A run at best, latest or an iteration: its design, and what was in force",
    )
    def moment(run_id: str, which: str) -> Response:
        return reply(moment_of(runs.get(run_id), which))

    @router.post(
        "/{run_id}/resume",
        status_code=202,
        openapi_extra=takes(ResumeRun, required=False),
        responses=gives(RunState, 202),
        summary="Start a trainer that goes on from the newest checkpoint",
    )
    def resume(run_id: str, wish: Annotated[ResumeRun, Depends(body_of(ResumeRun))]) -> Response:
        runs.resume(run_id, wish.further, wish.from_start)
        return reply(state_of(runs, run_id), 202)

    @router.post("/{run_id}/show", responses=gives(RunState), summary="Let every open browser show this run")
    def show(
        run_id: str,
        iteration: Annotated[
            int | None, Query(ge=0, le=LAST_ITERATION, description="Iteration whose design is shown; 0: initial")
        ] = None,
    ) -> Response:
        runs.show(run_id, iteration)
        return reply(state_of(runs, run_id))

    return router
