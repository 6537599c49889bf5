"""/api/films: a film or a still of a run, made in the background; its progress, its end, and the file."""

from typing import Annotated

from fastapi import APIRouter, Depends, Response
from fastapi import Path as InPath
from fastapi.responses import FileResponse

from morph_core.run_folder import RunFolderError
from studio.api.messages import body_of, gives, gives_file, reply, takes
from studio.filming import Films, FilmState, FilmWish

_Number = Annotated[int, InPath(ge=0, le=10**9, description="`number` of the film that is ready")]
_TYPES = {"mp4": "video/mp4", "gif": "image/gif", "svg": "image/svg+xml", "png": "image/png"}


def films_router(films: Films) -> APIRouter:
    """Return the routes of films and stills."""
    router = APIRouter(prefix="/api/films", tags=["films"])

    @router.get("", responses=gives(FilmState), summary="The film that is being made, or was made last")
    def state() -> Response:
        return reply(films.state)

    @router.post(
        "",
        status_code=202,
        openapi_extra=takes(FilmWish),
        responses=gives(FilmState, 202),
        summary="Make a film (mp4, gif) or a still (svg, png) of a run, one at a time, beside all other work",
    )
    def start(wish: Annotated[FilmWish, Depends(body_of(FilmWish))]) -> Response:
        return reply(films.start(wish), 202)

    @router.delete("", responses=gives(FilmState), summary="Give up the film at work, or remove the last one")
    def cancel() -> Response:
        return reply(films.cancel())

    @router.get(
        "/{number}",
        response_class=Response,
        responses=gives_file("video/mp4", "The film; image/gif, image/svg+xml or image/png for other formats"),
        summary="Download the film that is ready",
    )
    def download(number: _Number) -> Response:
        path = films.file(number)
        if path is None:
            raise RunFolderError(f"there is no film {number}: /api/films tells which one is ready")
        return FileResponse(path, media_type=_TYPES[path.suffix[1:]], filename=path.name)

    return router
