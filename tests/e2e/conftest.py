"""A real server and a real Chromium for the tests of this folder."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, sync_playwright
from served import Server

from tests.studies import Made, write_study

# Headless WebGL without a GPU; the rest keeps Chromium from talking to anyone but the server under test.
FLAGS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--no-first-run",
]


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    server = Server(tmp_path / "runs")
    try:
        server.start()
        yield server
    finally:
        server.stop()


def chromium() -> str:
    """Return the path of the browser."""
    path = shutil.which("chromium")
    assert path, "these tests need Debian's chromium: apt-get install chromium"
    return path


@pytest.fixture
def runs(server: Server) -> Path:
    """Fill the folder of the server with two runs of ten iterations."""
    write_study(server.runs, [Made("direct", "direct")], [0, 1], iterations=10)
    return server.runs


@pytest.fixture
def page() -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=FLAGS)
        page = browser.new_page(viewport={"width": 1000, "height": 700})
        page.set_default_timeout(30_000)
        page.add_init_script("if (location.protocol === 'http:') localStorage.setItem('morph-tour', 'seen')")
        yield page
        browser.close()
