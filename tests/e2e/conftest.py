"""A real server and a real Chromium for the tests of this folder."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect, sync_playwright
from served import Server

from tests.studies import Made, write_study

PATIENCE = 60_000
"""Milliseconds that anything may take: this machine may do much else, and Playwright's 5 s for a claim are too few."""
expect.set_options(timeout=PATIENCE)
LONGEST = 600
"""Seconds that a whole test may take: ten times as long as where nothing else is at work."""

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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.parent == Path(__file__).parent:
            item.add_marker(pytest.mark.timeout(LONGEST))


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
        page.context.set_default_timeout(PATIENCE)
        page.add_init_script("if (location.protocol === 'http:') localStorage.setItem('morph-tour', 'seen')")
        yield page
        browser.close()


@pytest.fixture
def other(page: Page) -> Iterator[Page]:
    """A page of another person's browser."""
    browser = page.context.browser
    assert browser is not None
    context = browser.new_context(viewport={"width": 1000, "height": 700})
    context.set_default_timeout(PATIENCE)
    yield context.new_page()
    context.close()


@pytest.fixture
def opened(page: Page) -> Iterator[Callable[[Path], None]]:
    """Open a page from disk without a network; whatever it asks for or complains of fails the test."""
    asked, complaints = [], []
    page.context.set_offline(True)
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)

    def open_page(path: Path) -> None:
        page.goto(path.as_uri(), wait_until="domcontentloaded")
        page.evaluate("show.ready.then(() => true)")

    yield open_page
    assert [url.split("?")[0][:8] for url in asked if not url.startswith("data:")] == ["file:///"]
    assert complaints == []
