"""/study: the page that compares the runs of a study, and the report that it shows."""

from importlib.resources import files
from pathlib import Path

from fastapi import APIRouter, Response
from fastapi.responses import FileResponse

from morph_core.run_folder import RunFolderError
from studio.api.messages import gives, gives_file, reply
from studio.security import style_digest
from studio.study.live import LiveReport, ReportState

_PAGE = Path(str(files("studio") / "page" / "study.html"))


def study_router(report: LiveReport) -> APIRouter:
    """Return the routes of the comparison."""
    router = APIRouter(tags=["study"])
    style = (files("studio.study.report") / "shipped" / "report.css").read_text(encoding="utf-8").strip()
    policy = f"default-src 'none'; style-src '{style_digest(style)}'; frame-ancestors 'self'; base-uri 'none'"

    @router.get("/study", include_in_schema=False)
    def page() -> Response:
        return FileResponse(_PAGE)

    @router.get("/api/study", responses=gives(ReportState), summary="How old the report of the study is")
    def state() -> Response:
        return reply(report.state())

    @router.get(
        "/study/report/{name:path}",
        responses=gives_file("text/html", "report.html, a table or a figure"),
        summary="A file of the report; /api/study says whether there is one",
    )
    def file(name: str) -> Response:
        path = report.file(name)
        if path is None:
            raise RunFolderError(f'the report has no file "{name[:80]}"; its page is /study/report/report.html')
        return FileResponse(path, headers={"Content-Security-Policy": policy})

    return router
