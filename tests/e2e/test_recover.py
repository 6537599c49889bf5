"""A page comes back by itself, to where it was, from whatever keeps it from its server, and says meanwhile what is."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from playwright.sync_api import Page, expect
from served import Server, wait_for
from test_desk_in_a_browser import NEW, OLD, choose, open_page, shows
from test_studio import viewer_of

pytestmark = pytest.mark.browser


@contextlib.contextmanager
def asleep() -> Iterator[None]:
    """Let the browser sleep, as on a shut laptop: none of its processes runs."""
    browser = [process for process in psutil.Process().children(recursive=True) if "chrom" in process.name()]
    assert browser
    for process in browser:
        process.suspend()
    try:
        yield
    finally:
        for process in browser:
            process.resume()


def go_to_iteration_9(page: Page, run: str) -> None:
    choose(page, run)
    expect(viewer_of(page).get_by_text("design of iteration 10").first).to_be_attached()
    page.keyboard.press("ArrowLeft")
    shows(page, run, 9)


def comes_back(page: Page, run: str) -> None:
    """Wait until the page says nothing any more, and its viewer shows iteration 9 and obeys."""
    expect(page.locator("#banner")).to_be_hidden()
    expect(page.locator("#loading")).to_be_hidden()
    expect(viewer_of(page).get_by_text("design of iteration 9").first).to_be_attached()
    shows(page, run, 9)
    page.keyboard.press("ArrowLeft")
    shows(page, run, 8)


@pytest.mark.usefixtures("runs")
def test_a_page_comes_back_to_its_place_when_the_server_does(server: Server, page: Page) -> None:
    open_page(page, server.url)
    go_to_iteration_9(page, OLD)
    server.kill()
    expect(page.locator("#banner")).to_contain_text("The server does not answer; trying again.")
    server.start()
    comes_back(page, OLD)


@pytest.mark.usefixtures("runs")
def test_a_page_that_has_slept_comes_back_though_its_connection_is_gone(server: Server, page: Page) -> None:
    open_page(page, server.url)
    go_to_iteration_9(page, NEW)
    viewer = "document.getElementById('viewer').contentWindow"
    page.evaluate(f"{viewer}.sleeping = true")
    with asleep():
        server.kill()
        server.start()
    wait_for(
        "a viewer in place of the one that has lost its server", lambda: not page.evaluate(f"{viewer}.sleeping"), 30
    )
    comes_back(page, NEW)


@pytest.mark.usefixtures("runs")
def test_a_lost_network_is_said_and_found_again(server: Server, page: Page) -> None:
    open_page(page, server.url)
    go_to_iteration_9(page, NEW)
    page.context.set_offline(True)
    banner = page.locator("#banner")
    expect(banner).to_contain_text("This device is offline; trying again.")
    expect(banner).to_contain_text("Runs go on without this page, and it comes back to where it was.")
    page.context.set_offline(False)
    comes_back(page, NEW)


def test_a_run_deleted_elsewhere_is_said_and_comes_back(server: Server, runs: Path, page: Page, tmp_path: Path) -> None:
    open_page(page, server.url)
    go_to_iteration_9(page, NEW)
    shutil.move(runs / NEW, tmp_path / "elsewhere")
    banner = page.locator("#banner")
    expect(banner).to_contain_text(f"{NEW} is no longer in the folder of runs")
    expect(viewer_of(page).get_by_text("deleted or moved").first).to_be_attached()
    shutil.move(tmp_path / "elsewhere", runs / NEW)
    comes_back(page, NEW)


def test_a_viewer_that_takes_long_stays_behind_its_curtain_and_the_page_says_so(server: Server, page: Page) -> None:
    page.route("**/viewer/**", lambda _: None)  # asked for and never answered
    page.goto(server.url, wait_until="domcontentloaded")
    expect(page.locator("#loading").get_by_text("Opening the 3-D viewer takes longer than usual")).to_be_visible()
    page.unroute_all(behavior="ignoreErrors")
