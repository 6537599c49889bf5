"""The comparison in the studio: when a report is written anew, what the routes serve, and what becomes of failures."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from conftest import Served, eventually, serving

from studio.settings import Settings
from studio.study import live
from studio.study.live import LiveReport
from tests.studies import Made, write_study

WRITER = "import pathlib, sys; p = pathlib.Path(sys.argv[1]); p.mkdir(); (p / 'report.html').write_text(sys.argv[2])"


class Writers:
    """Stand-ins for the process that writes reports: each writes a page with its number, or fails."""

    def __init__(self) -> None:
        self.started: list[Path] = []
        self.fail = ""

    def __call__(self, directory: Path, into: Path) -> subprocess.Popen[bytes]:
        self.started.append(into)
        script = f"import sys; sys.exit({self.fail!r})" if self.fail else WRITER
        command = [sys.executable, "-c", script, str(into), f"page {len(self.started)}"]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


@pytest.fixture
def writers() -> Writers:
    return Writers()


@pytest.fixture
def study(tmp_path: Path) -> Path:
    write_study(tmp_path / "study", [Made("direct", "direct")], [0, 1], iterations=4)
    return tmp_path / "study"


@pytest.fixture
def report(study: Path, writers: Writers, monkeypatch: pytest.MonkeyPatch) -> Iterator[LiveReport]:
    monkeypatch.setattr(live, "EVERY", 0.0)
    monkeypatch.setattr(live, "SHARE", float("inf"))
    made = LiveReport(study, writers)
    yield made
    made.close()


def change(study: Path) -> None:
    """Let a run write an event."""
    log = next(study.glob("*/events.jsonl"))
    log.write_bytes(log.read_bytes() + b"{}\n")


def written(report: LiveReport, version: int) -> bool:
    return eventually(lambda: report.state().version == version)


def test_a_report_is_written_once_for_what_has_not_changed(report: LiveReport, writers: Writers) -> None:
    assert report.state().state == "writing"
    assert written(report, 1)
    for _ in range(3):
        state = report.state()
    assert (state.state, state.writing, len(writers.started)) == ("ready", False, 1)
    page = report.file("report.html")
    assert page is not None
    assert page.read_text() == "page 1"


def test_a_run_that_writes_brings_a_newer_report_and_the_older_one_stays_until_then(
    report: LiveReport, study: Path
) -> None:
    report.state()
    assert written(report, 1)
    change(study)
    state = report.state()
    assert (state.state, state.version, state.writing) == ("ready", 1, True)
    assert written(report, 2)
    page = report.file("report.html")
    assert page is not None
    assert page.read_text() == "page 2"


def test_reports_keep_their_distance(
    report: LiveReport, writers: Writers, study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report.state()
    assert written(report, 1)
    monkeypatch.setattr(live, "EVERY", 3600.0)
    change(study)
    report.state()
    assert len(writers.started) == 1
    monkeypatch.setattr(live, "EVERY", 0.0)
    monkeypatch.setattr(live, "SHARE", 1e-6)
    report.state()
    assert len(writers.started) == 1


def test_nobody_looking_means_nobody_writing(report: LiveReport, writers: Writers, study: Path) -> None:
    report.file("report.html")
    change(study)
    assert writers.started == []


def test_a_failure_says_why_and_keeps_the_last_report(report: LiveReport, writers: Writers, study: Path) -> None:
    report.state()
    assert written(report, 1)
    writers.fail = "no memory left"
    change(study)
    report.state()
    assert eventually(lambda: report.state().reason == "no memory left")
    assert report.state().state == "ready"
    assert report.file("report.html")


def test_a_first_failure_is_tried_again_when_a_run_has_changed(
    report: LiveReport, writers: Writers, study: Path
) -> None:
    writers.fail = 'a report needs scipy: pip install "morph-studio[study]"'
    report.state()
    assert eventually(lambda: report.state().state == "failed")
    assert report.state().reason == writers.fail
    assert len(writers.started) == 1
    writers.fail = ""
    change(study)
    report.state()
    assert written(report, 1)
    assert report.state().reason == ""


def test_a_folder_without_a_study_is_no_study(tmp_path: Path, writers: Writers) -> None:
    state = LiveReport(tmp_path, writers).state()
    assert state.state == "no study"
    assert "no study.json" in state.reason
    (tmp_path / "study.json").write_text("{")
    assert "can't be read" in LiveReport(tmp_path, writers).state().reason
    assert writers.started == []


def test_only_files_of_the_report_are_given_out(report: LiveReport) -> None:
    assert report.file("report.html") is None
    report.state()
    assert written(report, 1)
    for name in ("../../etc/passwd", "/etc/passwd", "..", "", "none.csv", "../1/report.html/../../secret"):
        assert report.file(name) is None


def test_closing_removes_what_was_written_and_ends_the_process(study: Path) -> None:
    began: list[subprocess.Popen[bytes]] = []

    def slow(*_: Path) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-c", "import time; time.sleep(20)"]
        began.append(subprocess.Popen(command, stderr=subprocess.PIPE))
        return began[0]

    report = LiveReport(study, slow)
    assert report.state().writing
    home = report._home
    assert home is not None
    assert home.is_dir()
    report.close()
    assert began[0].returncode == -signal.SIGKILL, "it is not waited for"
    assert not home.exists()


# --- over HTTP --------------------------------------------------------------------------------------------------------


def test_the_page_is_served_and_the_empty_folder_explained(served: Served) -> None:
    page = served.client.get("/study")
    assert page.status_code == 200
    assert "page/study.js" in page.text
    assert "script-src 'self'" in page.headers["Content-Security-Policy"]
    state = served.client.get("/api/study").json()
    assert state["state"] == "no study"
    assert served.client.get("/study/report/report.html").status_code == 404
    assert '<a class="link" href="study">' in served.client.get("/").text


def test_the_comparison_needs_the_token(served: Served) -> None:
    for path in ("/study", "/api/study", "/study/report/report.html", "/page/study.js"):
        assert httpx.get(f"http://127.0.0.1:{served.port}{path}").status_code == 401


@pytest.mark.slow
def test_a_study_is_compared_by_a_process_and_served_with_the_style_it_has(settings: Settings) -> None:
    write_study(settings.runs, [Made("direct", "direct"), Made("no_hw_opt", "no_hw_opt", top=0)], [0], iterations=4)
    before = set(settings.runs.rglob("*"))
    with serving(settings) as served:
        assert eventually(lambda: served.client.get("/api/study").json()["state"] == "ready", 120)
        page = served.client.get("/study/report/report.html")
        assert "2 methods on reacher" in page.text
        policy = page.headers["Content-Security-Policy"]
        (own,) = [part for part in policy.split("; ") if part.startswith("style-src")]
        assert own in page.text  # the header allows the style sheet that the page has
        assert "script-src" not in policy
        assert served.client.get("/study/report/runs.csv").text.count("\n") == 3
        assert (
            served.client.get("/study/report/figures/learning-reacher.svg").headers["content-type"] == "image/svg+xml"
        )
        assert served.client.get("/study/report/%2e%2e/%2e%2e/etc/passwd").status_code == 404
    index = settings.runs / ".index.json"  # of all runs of the folder, and not a part of any
    assert set(settings.runs.rglob("*")) - {index} == before  # nobody's study is written to


def test_the_server_loads_none_of_what_reports_are_made_with() -> None:
    script = (
        "import json, sys, studio.app, studio.cli.study; "
        "print(json.dumps([m for m in ('jinja2', 'matplotlib', 'pandas', 'pyarrow', 'scipy') if m in sys.modules]))"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout) == []
