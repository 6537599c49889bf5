"""The web application: one FastAPI around the runs, the viewer and the shell page; and the server that runs it."""

import contextlib
import errno
import functools
import html
import logging
import secrets
import socket
import sys
import tempfile
import threading
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol

import anyio
import msgspec
import uvicorn
import viser
from fastapi import FastAPI, Request, Response
from fastapi.exception_handlers import http_exception_handler
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp

from morph_core.history import History
from morph_core.inside import NotPlainError
from morph_core.protocol import Status
from morph_core.run_folder import RunFolderError
from studio.album import Album
from studio.api.audience import audience_router
from studio.api.compare import compare_router
from studio.api.designs import Export, designs_router, imports_router
from studio.api.desks import desks_router
from studio.api.docs import docs_router
from studio.api.events import events_router
from studio.api.films import films_router
from studio.api.messages import MAX_BODY, Health, gives, reply
from studio.api.news import news_router
from studio.api.recorded import recorded_router
from studio.api.runs import runs_router
from studio.api.shelf import shelf_router
from studio.api.study import study_router
from studio.api.tasks import tasks_router
from studio.api.what_if import NOBODY_THERE, what_if_router
from studio.audience import Audience
from studio.branches import tree_of
from studio.bridge import MAX_MESSAGE, GuardedViser, viewer_router
from studio.browser import open_in_browser
from studio.desks import Desks, Presenting
from studio.evaluator import Evaluator, EvaluatorError
from studio.evolutions import Evolutions
from studio.export.bundle import Bundle, build_bundle
from studio.filming import Films
from studio.memory import map_large_blocks
from studio.negotiation import Negotiated, allowed_methods
from studio.new_run import Branch, StartRun
from studio.news import News
from studio.patience import PatientProtocol
from studio.prefix import Prefixed
from studio.runs import Runs
from studio.security import Access, Guard
from studio.seldom import SaidOnce, Seldom
from studio.settings import Settings
from studio.shelf import trash
from studio.shelf.thumbnails import Thumbnails
from studio.spectators import spectators_router
from studio.study.live import LiveReport
from studio.study.slurm import Slurm
from studio.trainers import Reserve
from studio.turns import BusyError, Turns
from studio.viewer.viewer import Viewer
from studio.what_if import WhatIfs

SHOW_INTERVAL = 0.2
"""Seconds between two looks at the runs for the viewer."""
_UNSAID = "ASGI callable returned without completing handshake."
"""What uvicorn says of each websocket that was refused; the guard says it itself, once a minute."""
QUEUE_INTERVAL = 1.0
"""Seconds between two looks at the queue of runs that wait for a trainer."""
NARROW_PAGE = 900
"""Width in pixels below which a page begins with one column of panels: the scene keeps more than a third of it."""
_log = logging.getLogger(__name__)


class Shows(Protocol):
    """What the application needs of whoever shows the runs to browsers."""

    @property
    def selected(self) -> frozenset[str]:
        """Return the names of the runs on screen."""
        ...

    def show(
        self, histories: Mapping[str, History], statuses: Mapping[str, tuple[Status, str]], current: str | None
    ) -> None:
        """Show the runs as they are now; a browser that comes without a choice opens the run `current`."""
        ...

    def turn_to(self, run_id: str, iteration: int | None) -> None:
        """Let every browser show this run, and the design of an iteration."""
        ...

    def presenting(self, key: str | None) -> Presenting | None:
        """Return the browser of this key, by default the one that has been there longest; None where there is none."""
        ...

    def stop(self) -> None:
        """End what was started to show runs."""
        ...


class _GuardedApp(FastAPI):
    """An application whose guard stands before everything else, so that error pages pass it too.

    Before the guard it is found out under which path a proxy serves it; what passes the guard is compressed.
    """

    def build_middleware_stack(self) -> ASGIApp:
        """Return FastAPI's own stack inside the guard."""
        compressed = Negotiated(GZipMiddleware(super().build_middleware_stack(), compresslevel=6))
        settings: Settings = self.state.settings
        return Prefixed(Guard(compressed, self.state.access), settings.root_path, settings.proxies)


def make_desks(
    server: viser.ViserServer, runs: Runs, what_ifs: WhatIfs, album: Album, films: Films, export: Export = build_bundle
) -> Desks:
    """Return the viewers of all browsers, with what their users ask for passed on to the runs."""

    def on_branch(run_id: str, iteration: int, phi: list[float]) -> str:
        return runs.start(_branch(runs.get(run_id), iteration, phi))

    def on_export(
        run_id: str,
        which: str,
        formats: Sequence[str] | None,
        phi: list[float] | None,
        servo: str | None,
        printer: str | None,
    ) -> Bundle:
        return export(runs.get(run_id), which, formats, phi, servo, printer)

    def make(client: viser.ClientHandle) -> Viewer:
        width = client.camera.image_width  # of the whole page: the panels that are made now take their share of it
        viewer = Viewer(
            client,
            on_command=runs.send,
            on_start=runs.start,
            on_resume=runs.resume,
            on_branch=on_branch,
            on_export=on_export,
            answers=what_ifs,
            family=lambda run_id: tree_of(run_id, runs.parents()),
            album=album,
            others=runs,
            films=films,
            recordings=runs.recordings,
        )
        if 0 < width < NARROW_PAGE:
            viewer.playback.panel.minimize()  # with the column in which it stands
        return viewer

    return Desks(server, make)


def _branch(history: History, iteration: int, phi: Sequence[float]) -> StartRun:
    """Return the wish for a branch of a run that goes on with phi (d,), under the bounds and locks of an iteration;
    they give way where phi lies beyond them."""
    parameters = [
        msgspec.structs.replace(
            p, lo=min(p.lo, value), hi=max(p.hi, value), initial=value, locked_at=None if p.locked_at is None else value
        )
        for p, value in zip(history.at(iteration).space.parameters, phi, strict=True)
    ]
    return StartRun(branch=Branch(history.folder.id, iteration), parameters=parameters)


def create_app(
    settings: Settings,
    *,
    runs: Runs | None = None,
    launcher: Slurm | None = None,
    desks: Callable[[viser.ViserServer, Runs, WhatIfs, Album, Films], Shows] | None = None,
) -> FastAPI:
    """Return the application. New runs are started by `launcher`, by default as processes of this machine.

    `app.state` holds `settings`, `access`, `audience`, `stopping`, `runs`, `evaluator` and, while it runs, `viser` and
    `desks`.
    """
    reserve, report, evaluator = Reserve(), LiveReport(settings.runs), Evaluator()
    what_ifs = WhatIfs(evaluator)
    watched = runs or Runs(settings.runs, reserve.spawn, launcher, settings.trainers)
    thumbnails = Thumbnails()
    album, films = Album(watched, thumbnails), Films(lambda run_id: watched.get(run_id).folder.path)
    stopping, boot = anyio.Event(), secrets.token_hex(8)
    access = Access(settings)
    turns = Turns()
    export = _in_turn(turns)
    make = desks or functools.partial(make_desks, export=export)
    audience = Audience(access.invitation)

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        trash.purge(settings.runs)
        watched.show_newest()
        with contextlib.ExitStack() as ends:
            ends.callback(report.close)
            ends.callback(evaluator.close)
            ends.callback(films.close)
            if runs is None:
                ends.callback(reserve.close)
                if launcher is None:
                    reserve.load()
            app.state.viser = GuardedViser()
            ends.callback(app.state.viser.stop)
            app.state.desks, done = make(app.state.viser.server, watched, what_ifs, album, films), threading.Event()
            ends.callback(app.state.desks.stop)
            painter = threading.Thread(
                target=keep_showing, args=(app.state.desks, watched, done), name="desks", daemon=True
            )
            painter.start()
            threading.Thread(target=watched.rows, name="first listing", daemon=True).start()
            threading.Thread(target=keep_starting, args=(watched, done), name="queue", daemon=True).start()
            ends.callback(painter.join, 2.0)
            ends.callback(done.set)
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(audience.run, app.state.desks, stopping)
                yield
                stopping.set()

    app = _GuardedApp(
        title="MORPH Studio",
        description="Start, watch, steer and export runs that co-optimise a robot's body and its controller.",
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
        max_body_size=MAX_BODY,
        telemetry={"tracing": False, "metrics": False, "logs": False},  # would carry the link's token elsewhere
    )
    app.state.settings, app.state.access, app.state.stopping = settings, access, stopping
    app.state.audience = audience
    app.state.runs, app.state.evaluator = watched, evaluator
    for router in (
        tasks_router(),
        runs_router(watched),
        recorded_router(watched.recordings),
        designs_router(watched, export, turns),
        imports_router(watched),
        compare_router(watched),
        events_router(watched, stopping),
        what_if_router(watched, what_ifs),
        study_router(report),
        shelf_router(watched, thumbnails),
        news_router(News(watched), boot, stopping),
        desks_router(),
        audience_router(audience),
        films_router(films),
        spectators_router(audience, access, Evolutions(watched.get)),
        viewer_router(),
        docs_router(),
    ):
        app.include_router(router)
    _add_pages(app, boot)
    _add_refusals(app)
    return app


def _in_turn(turns: Turns) -> Export:
    """Return `build_bundle` as all browsers and the interface share it: each export waits for its turn."""

    def export(*asked: Any) -> Bundle:
        with turns.turn():
            return build_bundle(*asked)

    return export


def keep_showing(desks: Shows, runs: Runs, done: threading.Event) -> None:
    """Hand the runs to the browsers until `done` is set; what goes wrong is logged."""
    trouble = Seldom(_log)
    while not done.wait(SHOW_INTERVAL):
        with _logged(trouble, "showing the runs failed"):
            histories = runs.watched(desks.selected)
            desks.show(histories, runs.statuses(histories, desks.selected), runs.shown)
            if (asked := runs.take_request()) is not None:
                desks.turn_to(*asked)


def keep_starting(runs: Runs, done: threading.Event) -> None:
    """Start the runs that wait for a trainer, as soon as there is room, until `done` is set."""
    trouble = Seldom(_log)
    while not done.wait(QUEUE_INTERVAL):
        with _logged(trouble, "starting what waits failed"):
            runs.tend()


@contextlib.contextmanager
def _logged(trouble: Seldom, sentence: str) -> Iterator[None]:
    """Write what goes wrong into the log, once a minute: it may go wrong again at once."""
    try:
        yield
    except Exception:
        trouble.warn(sentence, traceback=True)


def _add_pages(app: FastAPI, boot: str) -> None:
    pages = Path(str(files("studio") / "page"))

    @app.get("/", include_in_schema=False)
    def shell() -> Response:
        return FileResponse(pages / "index.html")

    @app.get("/healthz", responses=gives(Health), tags=["health"], summary="Whether the server is up; needs no token")
    async def healthz() -> Response:
        return reply(Health("ok", boot))

    app.mount("/page", StaticFiles(directory=pages))


def _add_refusals(app: FastAPI) -> None:
    """Answer what is asked wrongly with a sentence, and what the disk refuses without a traceback."""

    def refuse(status: int, headers: Mapping[str, str] | None = None) -> Callable[[Request, Exception], Response]:
        return lambda _, error: JSONResponse({"detail": str(error)}, status, headers)

    def refuse_by_disk(_: Request, error: Exception) -> Response:
        why = str(error) if isinstance(error, NotPlainError) else getattr(error, "strerror", None) or str(error)
        full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
        room = f": make room where the runs are, or in {tempfile.gettempdir()}" if full else ""
        return JSONResponse({"detail": f"the disk refuses: {why}{room}"}, 503)

    def refuse_parameters(_: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        reasons = [f"{'.'.join(str(part) for part in e['loc'])}: {e['msg']}" for e in error.errors()]
        return JSONResponse({"detail": "; ".join(reasons)}, 422)

    page = (files("studio") / "page" / "missing.html").read_text()

    async def refuse_path(request: Request, error: Exception) -> Response:
        """Answer a browser that asks for a page that there is not by a page, and everybody else as FastAPI does."""
        assert isinstance(error, HTTPException)
        if error.status_code == 405:  # FastAPI names the methods of one route alone
            error.headers = {"Allow": allowed_methods(request.app.routes, request.scope)}
        if error.status_code != 404 or "text/html" not in request.headers.get("accept", ""):
            return await http_exception_handler(request, error)
        return HTMLResponse(page.replace("{root}", html.escape(request.scope.get("root_path", ""))), 404)

    app.add_exception_handler(HTTPException, refuse_path)
    app.add_exception_handler(RunFolderError, refuse(404))
    app.add_exception_handler(ValueError, refuse(422))
    app.add_exception_handler(RequestValidationError, refuse_parameters)
    app.add_exception_handler(OSError, refuse_by_disk)
    app.add_exception_handler(BusyError, refuse(503, {"Retry-After": "60"}))
    app.add_exception_handler(EvaluatorError, refuse(503))
    app.add_exception_handler(ClientDisconnect, lambda *_: Response(status_code=NOBODY_THERE))


class _Server(uvicorn.Server):
    """A server that calls `on_started` once it is up, and `on_stop` before it waits for the last answers."""

    def __init__(self, config: uvicorn.Config, on_started: Callable[[], None], on_stop: Callable[[], None]) -> None:
        super().__init__(config)
        self.on_started = on_started
        self.on_stop = on_stop

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, and call `on_started` if that worked."""
        await super().startup(sockets)
        if self.started:
            self.on_started()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Call `on_stop`, and stop."""
        self.on_stop()
        await super().shutdown(sockets)


def serve(settings: Settings, launcher: Slurm | None = None) -> None:
    """Serve until SIGINT or SIGTERM; runs go on. Raise SystemExit if the port is taken or the start fails."""
    try:
        listener = _listen(settings.host, settings.port)
    except OSError as error:
        print(f"can't listen on {settings.host}:{settings.port}: {error.strerror or error}", file=sys.stderr)  # noqa: T201
        raise SystemExit(1) from None
    map_large_blocks()
    app = create_app(settings, launcher=launcher)
    access: Access = app.state.access
    audience: Audience = app.state.audience
    name = f"[{settings.host}]" if ":" in settings.host else settings.host
    address = f"http://{name}:{listener.getsockname()[1]}{settings.root_path}/"
    mode = "&present=1" if settings.present else ""

    def announce() -> None:
        link = f"{address}?token={access.ticket}{mode}"
        # A given token stays out of a platform's and a proxy's logs; its owner knows it.
        shown = link if settings.token is None else f"{address}?token=...{mode}"
        print(f"MORPH Studio: {shown}", flush=True)  # noqa: T201
        if settings.audience:
            print(f"for an audience, who can only look: {address}{audience.open().link}", flush=True)  # noqa: T201
        if settings.open_browser:
            threading.Thread(target=open_in_browser, args=(link,), daemon=True).start()

    access.on_ticket_used = lambda: print(  # noqa: T201
        f"link used; for another browser: {address}?token={access.ticket}{mode}", flush=True
    )
    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        workers=1,
        http=PatientProtocol,
        ws_per_message_deflate=False,
        ws_max_size=MAX_MESSAGE,
        timeout_graceful_shutdown=2,
        proxy_headers=False,  # the application's own: it needs the proxy's address too
    )
    logging.getLogger("uvicorn.error").addFilter(SaidOnce(_UNSAID))
    with contextlib.suppress(KeyboardInterrupt):
        _Server(config, announce, app.state.stopping.set).run(sockets=[listener])


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens on the port. Raise OSError if it is taken; no other port is tried."""
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(128)
    except OSError:
        listener.close()
        raise
    return listener
