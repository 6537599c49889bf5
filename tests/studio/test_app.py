"""The server holds its port and its word: one link, a clean end, and no part that takes another with it."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from conftest import ROOT, TOKEN, Served, eventually, make_run, stand_in

from morph_core.run_folder import RunFolder, process_alive
from studio.runs import WATCHED
from studio.settings import Settings

SERVE = """
import sys
from pathlib import Path
from studio.app import serve
from studio.runs import WATCHED
from studio.settings import Settings
serve(Settings(port=int(sys.argv[1]), runs=Path(sys.argv[2]), state=Path(sys.argv[3]), open_browser=False))
"""


@contextmanager
def process(tmp_path: Path, port: int = 0, token: str = "") -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run a server of its own; yield it and the link that it prints."""
    environment = {**os.environ, "MORPH_TOKEN": token, "MORPH_HOSTS": ""}
    server = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", SERVE, str(port), str(tmp_path / "runs"), str(tmp_path / "state")],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT, env=environment,
    )  # fmt: skip
    try:
        assert server.stdout is not None
        yield server, server.stdout.readline().strip().partition(": ")[2]
    finally:
        if server.poll() is None:
            server.kill()
        server.wait(10)


def test_the_printed_link_lets_one_browser_in_and_is_followed_by_the_next(tmp_path: Path) -> None:
    with process(tmp_path) as (server, link):
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=\S{30,}", link)
        with httpx.Client(follow_redirects=True) as browser, httpx.Client(follow_redirects=True) as other:
            page = browser.get(link)
            assert (page.status_code, page.url.query) == (200, b"")
            assert "MORPH Studio" in page.text
            assert browser.get(link).status_code == 200  # it knows this browser
            assert other.get(link).status_code == 401
            assert server.stdout is not None
            following = server.stdout.readline().strip().partition(": ")[2]
            assert other.get(following).status_code == 200


@pytest.mark.slow
def test_a_page_stays_open_over_a_restart_of_the_server(tmp_path: Path) -> None:
    with httpx.Client() as browser:
        with process(tmp_path) as (_, link):
            browser.get(link)
            port = httpx.URL(link).port
            boot = browser.get(f"http://127.0.0.1:{port}/healthz").json()["boot"]
        # The cookie's name goes by the settings' port, 0 here, so that another port will do.
        with process(tmp_path) as (_, link):
            port = httpx.URL(link).port
            assert browser.get(f"http://127.0.0.1:{port}/api/runs").status_code == 200
            assert browser.get(f"http://127.0.0.1:{port}/healthz").json()["boot"] != boot


def test_a_busy_port_is_an_error_and_never_the_next_port(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        ended = subprocess.run(
            [sys.executable, "-c", SERVE, str(port), str(tmp_path / "runs"), str(tmp_path)],
            capture_output=True, text=True, cwd=ROOT, timeout=100, check=False,
        )  # fmt: skip
    assert ended.returncode == 1
    assert ended.stderr.strip() == f"can't listen on 127.0.0.1:{port}: Address already in use"


def test_a_server_whose_viser_is_not_guarded_does_not_come_up(tmp_path: Path) -> None:
    unguarded = "import websockets.asyncio.server as w, viser\n" + (
        "real, init = w.serve, viser.ViserServer.__init__\n"
        "def __init__(self, *a, **k):\n    w.serve = real\n    init(self, *a, **k)\n"
        "viser.ViserServer.__init__ = __init__\n"
    )
    ended = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", unguarded + SERVE, "0", str(tmp_path / "runs"), str(tmp_path)],
        capture_output=True, text=True, cwd=ROOT, timeout=30, check=False,
    )  # fmt: skip
    assert ended.returncode != 0
    assert "did not take the guard" in ended.stderr
    assert "token=" not in ended.stdout


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_server_in_time_and_leaves_trainers_running(tmp_path: Path, how: signal.Signals) -> None:
    folder = make_run(tmp_path / "runs", "run")
    trainer = stand_in(folder)
    try:
        with process(tmp_path, token=TOKEN) as (server, link):
            base, headers = link.partition("?")[0], {"Authorization": f"Bearer {TOKEN}"}
            with httpx.stream("GET", f"{base}api/runs/run/events", headers=headers):  # a page that stays open
                begin = time.monotonic()
                server.send_signal(how)
                server.wait(15)
                assert time.monotonic() - begin < 8
        assert trainer.poll() is None
        beat = RunFolder(folder.path).heartbeat()
        assert beat is not None
        assert process_alive(beat.pid, beat.process_started)
    finally:
        trainer.kill()
        trainer.wait()


def test_a_viewer_that_breaks_takes_nothing_with_it(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    served.viewer.broken = True
    assert eventually(lambda: "the viewer is broken" in caplog.text)
    assert served.client.get("/api/runs").status_code == 200
    served.viewer.broken = False
    served.viewer.shown.clear()
    assert eventually(lambda: served.viewer.shown)


def test_the_viewer_is_shown_the_runs_and_what_became_of_them(served: Served) -> None:
    make_run(served.runs.folder, "run", ended="failed")
    assert eventually(lambda: served.viewer.shown and "run" in served.viewer.shown[-1][1])
    names, statuses, current = served.viewer.shown[-1]
    assert names == ["run"]
    assert statuses["run"] == ("failed", "as asked")
    assert current is None


def test_a_run_on_some_screen_is_read_however_old_it_is(served: Served) -> None:
    for i in range(WATCHED + 1):
        make_run(served.runs.folder, f"run-{i:02}")
    newest = {f"run-{i:02}" for i in range(1, WATCHED + 1)}
    assert eventually(lambda: served.viewer.shown and set(served.viewer.shown[-1][0]) == newest)
    served.viewer.selected = frozenset({"run-00"})
    assert eventually(lambda: "run-00" in served.viewer.shown[-1][0])


def test_the_newest_run_is_on_screen_at_the_start(settings: Settings) -> None:
    from conftest import serving

    make_run(settings.runs, "20260101-a")
    make_run(settings.runs, "20260102-b")
    with serving(settings) as served:
        assert eventually(lambda: served.viewer.shown and served.viewer.shown[-1][2] == "20260102-b")


def test_the_shell_page_loads_only_its_own_files(served: Served) -> None:
    page = served.client.get("/").text
    files = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(files) >= 5
    for file in files:
        assert not file.startswith("/"), "a proxy may serve it under a prefix"
        assert served.client.get(f"/{file}").status_code == 200, file
    for name in ("studio.js", "plain.js", "theme.js", "studio.css"):
        assert "http" not in served.client.get(f"/page/{name}").text
    for name in ("studio.js", "plain.js"):
        assert "innerHTML" not in served.client.get(f"/page/{name}").text


def test_a_browser_that_asks_for_a_page_that_is_not_there_is_shown_the_way(served: Served) -> None:
    asked = served.client.get("/nowhere/at/all", headers={"accept": "text/html,*/*"})
    assert (asked.status_code, "There is no such page" in asked.text) == (404, True)
    for address in re.findall(r'href="([^"]+)"', asked.text):
        assert served.client.get(address).status_code == 200, address
    assert served.client.get("/nowhere").json() == {"detail": "Not Found"}


def test_the_procfile_serves_with_a_token_from_the_environment() -> None:
    line = (ROOT / "Procfile").read_text()
    assert line == "web: morph-studio serve --host 0.0.0.0 --no-browser\n"
