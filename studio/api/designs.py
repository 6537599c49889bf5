"""What a run has produced: traces, designs, recorded episodes and exports."""

from collections.abc import Callable
from typing import Annotated

from fastapi import APIRouter, Query, Response

from morph_core.history import History
from morph_core.run_folder import RunFolderError
from studio.api.messages import Design, Designs, Metrics, gives, gives_file, reply
from studio.runs import Runs

MAX_ROLLOUT = 256 << 20
Export = Callable[[History, str, list[str] | None], tuple[str, bytes]]
"""(run, which design, formats or None for all) -> (file name, zip)."""


def designs_of(history: History) -> Designs:
    """Return the evolution of phi."""
    parameters = history.record.parameters
    path = [Design(0, history.initial_phi.tolist()), *(Design(p.iteration, p.phi) for p in history.progress)]
    best, latest = history.design("best")[0], history.design("latest")[0]
    return Designs([p.name for p in parameters], [p.unit for p in parameters], best, latest, path)


def rollout_of(history: History, iteration: str) -> bytes:
    """Return the npz file of one recorded episode; raise RunFolderError that lists what is there."""
    folder = history.folder
    recorded = {int(p.stem): p for p in folder.rollouts.glob("[0-9]*.npz") if p.stem.isdecimal()}
    path = recorded.get(int(iteration)) if iteration.isdecimal() and len(iteration) <= 12 else None
    if path is None:
        choices = ", ".join(str(i) for i in sorted(recorded)) or "none yet"
        raise RunFolderError(f"{folder.id} has no rollout of iteration {iteration[:40]}; choose from: {choices}")
    # A folder from elsewhere may hold links to other files of this machine.
    if path.is_symlink() or folder.rollouts.is_symlink() or not path.is_file() or path.stat().st_size > MAX_ROLLOUT:
        raise RunFolderError(f"rollout {iteration} of {folder.id} is no plain file of a sensible size")
    return path.read_bytes()


def designs_router(runs: Runs, export: Export) -> APIRouter:
    """Return the routes about what a run has produced."""
    router = APIRouter(prefix="/api/runs/{run_id}", tags=["designs"])

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
        responses=gives_file("application/octet-stream", "A numpy npz file"),
        summary="One recorded episode on Hw-Phy",
    )
    def rollout(run_id: str, iteration: str) -> Response:
        content = rollout_of(runs.get(run_id), iteration)
        return _download(f"{run_id}-{int(iteration):06d}.npz", content, "application/octet-stream")

    @router.get(
        "/designs/{which}/export",
        response_class=Response,
        responses=gives_file("application/zip", "MJCF, URDF and provenance of one design"),
        summary="Download a design: best, latest or an iteration",
    )
    def export_design(
        run_id: str,
        which: str,
        formats: Annotated[list[str] | None, Query(description="mjcf, urdf; repeated or with commas")] = None,
    ) -> Response:
        history = runs.get(run_id)
        history.design(which)  # an unknown one is a 404, not a failed export
        chosen = [name for part in formats for name in part.split(",")] if formats else None
        name, content = export(history, which, chosen)
        return _download(name, content, "application/zip")

    return router


def _download(name: str, content: bytes, media_type: str) -> Response:
    return Response(content, media_type=media_type, headers={"Content-Disposition": f'attachment; filename="{name}"'})
