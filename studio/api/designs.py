"""What a run has produced: traces, designs, recorded episodes and exports."""

import contextlib
import io
from collections.abc import Callable, Sequence
from typing import Annotated

import anyio.to_thread
import numpy as np
from fastapi import APIRouter, Depends, Query, Request, Response

from morph_core.catalogue import make_task
from morph_core.forces import contact_forces
from morph_core.history import History
from morph_core.protocol import InjectDesign, Which
from morph_core.run_folder import ITERATION, RunFolderError, episode_bytes, read_episode
from morph_core.tasks.servos import SERVOS
from studio.api.messages import (
    Accepted,
    Checked,
    Comparison,
    Design,
    Designs,
    ExportedFile,
    Metrics,
    RunState,
    gives,
    gives_file,
    reply,
    sender_of,
)
from studio.api.runs import state_of
from studio.export.bundle import Bundle
from studio.export.design_file import phi_for, read_design, starting_from
from studio.export.printers import CHOICES, DEFAULT
from studio.new_run import StartRun
from studio.runs import Runs
from studio.show.evolution import build_evolution
from studio.turns import Turns

Formats = Annotated[
    list[str] | None, Query(description="mjcf, urdf, stl, 3mf, glb, step, ros, ros2_control; repeated or with commas")
]
Printer = Annotated[
    str | None,
    Query(description=f"A printer that must be able to print every part: {CHOICES}; without it {DEFAULT}"),
]
OtherPhi = Annotated[list[float] | None, Query(description="All values of another design in its place; repeated")]
Servo = Annotated[
    str | None,
    Query(description=f"Servo with which what the policy needs in 256 episodes is compared: {', '.join(SERVOS)}"),
]
WhichEpisode = Annotated[
    Which | None,
    Query(description="median, best, worst or failed, by return; without it the file as recorded, with all of them"),
]
WithForces = Annotated[
    bool,
    Query(description="Add contact_points (T + 1, C, 3) m and contact_forces (T + 1, C, 3) N, worked out by MuJoCo"),
]
Beside = Annotated[list[str] | None, Query(description="Another run of the same task, side by side; repeated")]
_FILE = {"schema": {"type": "string", "format": "binary"}}
_DESIGN_BODY = {
    "requestBody": {
        "required": True,
        "content": {"application/json": {"schema": {"type": "object"}}, "application/zip": _FILE},
    }
}
Export = Callable[[History, str, Sequence[str] | None, list[float] | None, str | None, str | None], Bundle]
"""Function that builds an export of a run: export(history, which design, formats or None for all, another phi, a servo
or None, a printer or None)."""


def designs_of(history: History) -> Designs:
    """Return the evolution of phi in a run."""
    parameters = history.record.parameters
    path = [
        Design(history.begins_at, history.initial_phi.tolist()),
        *(Design(p.iteration, p.phi) for p in history.progress),
    ]
    best, latest = history.design("best")[0], history.design("latest")[0]
    return Designs([p.name for p in parameters], [p.unit for p in parameters], best, latest, path)


def episode_of(history: History, iteration: str, which: Which | None = None, *, forces: bool = False) -> bytes:
    """Return one recorded episode of an iteration as an npz file; where `which` is None, the file as it was written.

    With `forces` it also has the contact forces. Raise RunFolderError with the choices if there is no such episode.
    """
    folder = history.folder
    recorded = folder.episode_iterations()
    if not ITERATION.fullmatch(iteration) or int(iteration) not in recorded:
        choices = ", ".join(map(str, recorded)) or "none yet"
        raise RunFolderError(f"{folder.id} has no episode of iteration {iteration[:40]}; choose from: {choices}")
    if which is None and not forces:
        return episode_bytes(folder, int(iteration))
    arrays = read_episode(folder, int(iteration), which)
    if forces:
        task = make_task(history.record.task, history.record.task_options)
        found = contact_forces(task, arrays["phi"], arrays)
        arrays |= {"contact_points": found.points, "contact_forces": found.forces}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def designs_router(runs: Runs, export: Export, turns: Turns) -> APIRouter:
    """Return the routes about what a run has produced; what takes seconds waits for its turn."""
    router = APIRouter(prefix="/api/runs/{run_id}", tags=["designs"])

    def exported(
        run_id: str,
        which: str,
        formats: Formats = None,
        phi: OtherPhi = None,
        servo: Servo = None,
        printer: Printer = None,
    ) -> Bundle:
        history = runs.get(run_id)
        history.design(which)  # an unknown one is a 404, not a failed export
        names = [name for part in formats for name in part.split(",")] if formats else None
        return export(history, which, names, phi, servo, printer)

    @router.get("/metrics", responses=gives(Metrics), summary="Traces: one entry per iteration and per evaluation")
    def metrics(run_id: str) -> Response:
        history = runs.get(run_id)
        return reply(Metrics(list(history.progress), list(history.evaluations)))

    @router.get("/designs", responses=gives(Designs), summary="The evolution of phi")
    def designs(run_id: str) -> Response:
        return reply(designs_of(runs.get(run_id)))

    @router.get(
        "/rollouts/{iteration}",
        response_class=Response,
        include_in_schema=False,  # what format 1 called an episode
    )
    @router.get(
        "/episodes/{iteration}",
        response_class=Response,
        responses=gives_file("application/octet-stream", "A numpy npz file"),
        summary="A recorded episode of an evaluation on Hw-Phy, with its contact forces on request",
    )
    def episode(run_id: str, iteration: str, which: WhichEpisode = None, forces: WithForces = False) -> Response:
        history = runs.get(run_id)
        with turns.turn() if forces else contextlib.nullcontext():
            content = episode_of(history, iteration, which, forces=forces)
        name = f"{run_id}-{int(iteration):06d}{f'-{which}' if which else ''}.npz"
        return _download(name, content, "application/octet-stream")

    @router.get(
        "/evolution.html",
        response_class=Response,
        responses=gives_file("text/html", "One page that loads nothing: bodies, traces and episodes of all iterations"),
        summary="Download the whole evolution, beside that of up to three other runs of the task",
    )
    def evolution(run_id: str, beside: Beside = None) -> Response:
        histories = [runs.get(name) for name in (run_id, *(beside or ()))]
        with turns.turn():
            page = build_evolution(histories)
        return _download(f"{run_id}-evolution.html", page.content, "text/html; charset=utf-8")

    @router.get(
        "/designs/{which}/export",
        response_class=Response,
        responses=gives_file("application/zip", "One design for simulators, printers and people"),
        summary="Download a design: best, latest or an iteration",
    )
    def export_design(bundle: Annotated[Bundle, Depends(exported)]) -> Response:
        return _download(bundle.name, bundle.content, "application/zip")

    @router.get(
        "/designs/{which}/export/checks",
        responses=gives(Checked),
        summary="What an export would hold, and what was compared; it is refused if anything disagrees",
    )
    def check_design(bundle: Annotated[Bundle, Depends(exported)]) -> Response:
        files = [ExportedFile(path, len(content)) for path, content in sorted(bundle.files.items())]
        checks = [Comparison(c.name, c.passed, c.worst, c.allowed, c.detail) for c in bundle.checks]
        return reply(Checked(bundle.name, len(bundle.content), files, checks))

    @router.post(
        "/designs",
        status_code=202,
        openapi_extra=_DESIGN_BODY,
        responses=gives(Accepted, 202),
        summary="Hand a design.json, or the one in a bundle, to a running run, which goes on from it",
    )
    async def inject(run_id: str, request: Request) -> Response:
        content = await request.body()

        def send() -> int:
            history = runs.get(run_id)
            phi = phi_for(read_design(content), history.record.task, history.design_space)
            return runs.send(run_id, InjectDesign(phi.tolist()), sender_of(request))

        return reply(Accepted(await anyio.to_thread.run_sync(send)), 202)

    return router


def imports_router(runs: Runs) -> APIRouter:
    """Return the route that starts a run from a design."""
    router = APIRouter(prefix="/api/designs", tags=["designs"])

    @router.post(
        "",
        status_code=201,
        openapi_extra=_DESIGN_BODY,
        responses=gives(RunState, 201),
        summary="Start a run from a design.json, or from the one in a bundle",
    )
    async def start(request: Request, method: str = "morph", seed: int = 0, iterations: int = 100) -> Response:
        content = await request.body()

        def begin() -> RunState:
            wish = StartRun(method=method, seed=seed, iterations=iterations)
            return state_of(runs, runs.start(starting_from(read_design(content), wish)))

        return reply(await anyio.to_thread.run_sync(begin), 201)

    return router


def _download(name: str, content: bytes, media_type: str) -> Response:
    return Response(content, media_type=media_type, headers={"Content-Disposition": f'attachment; filename="{name}"'})
