"""A browser has a view of its own, is worked by keys, and shows a newcomer round."""

import json
import re

import pytest
from playwright.sync_api import Page, expect
from served import Server
from test_studio import viewer_of

from studio.viewer import wording

pytestmark = pytest.mark.browser

SHARES = [0.0, 0.005, 0.015, 0.125, 0.375, 0.5, 0.994, 0.995, 1.0]
TIMES = [0.2, 1.0, 59.6, 89.4, 90.0, 150.0, 5399.0, 5400.0, 7169.0, 7190.0, 90_000.0, 3e5]
OLD, NEW = "reacher-direct-s0", "reacher-direct-s1"


def open_page(page: Page, address: str) -> None:
    page.goto(address)
    expect(page.locator("#loading")).to_be_hidden()


def choose(page: Page, run: str) -> None:
    """Choose a run in the bar, and wait until it is shown."""
    page.locator("#chooser").select_option(run)
    shows(page, run)
    obeys(page)


def obeys(page: Page) -> None:
    """Wait until the viewer knows its keys: they come before what it says of a run."""
    expect(viewer_of(page).get_by_text("In force at iteration").first).to_be_attached()


def shows(page: Page, run: str, iteration: int | None = None) -> None:
    """Wait until a page's address names the run and iteration that its viewer shows."""
    end = "" if iteration is None else f"&iteration={iteration}"
    page.wait_for_url(re.compile(rf"/\?run={run}{end}$"))


@pytest.mark.usefixtures("runs")
def test_one_person_does_not_see_what_another_one_chooses(server: Server, page: Page, other: Page) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.post_data or "") if request.method == "PUT" else None)
    open_page(page, server.url)
    choose(page, NEW)
    assert json.loads(asked[-1])["ticks"] == {}, "the viewer knows best what was ticked a moment ago"
    other.context.add_cookies(page.context.cookies())  # pyright: ignore[reportArgumentType]
    open_page(other, f"http://127.0.0.1:{server.port}/")
    choose(other, NEW)
    choose(page, OLD)
    page.keyboard.press("ArrowLeft")
    shows(page, OLD, 9)
    expect(viewer_of(page).get_by_text("design of iteration 9").first).to_be_attached()
    shows(other, NEW)
    expect(other.locator("#chooser")).to_have_value(NEW)
    page.reload()
    shows(page, OLD, 9)
    expect(page.locator("#chooser")).to_have_value(OLD)


@pytest.mark.usefixtures("runs")
def test_keys_scrub_follow_help_and_begin(server: Server, page: Page) -> None:
    open_page(page, server.url)
    choose(page, NEW)
    assert page.evaluate("(all) => all.map(percent)", SHARES) == list(map(wording.percent, SHARES))
    assert page.evaluate("(all) => all.map(duration)", TIMES) == list(map(wording.duration, TIMES))
    for iteration in (9, 8):
        page.keyboard.press("ArrowLeft")
        shows(page, NEW, iteration)
    page.keyboard.press("ArrowRight")
    shows(page, NEW, 9)
    page.keyboard.press("l")
    shows(page, NEW)
    page.keyboard.press("?")
    expect(page.get_by_role("dialog", name="Keys")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog", name="Keys")).to_be_hidden()
    page.keyboard.press("n")
    expect(viewer_of(page).get_by_role("button", name="Start", exact=True)).to_be_visible()


@pytest.mark.usefixtures("runs")
def test_the_tour_is_dismissed_for_good(server: Server, other: Page, page: Page) -> None:
    page.goto(server.url)
    other.context.add_cookies(page.context.cookies())  # pyright: ignore[reportArgumentType]
    open_page(other, f"http://127.0.0.1:{server.port}/")
    tour = other.get_by_role("dialog", name="Start a run")
    expect(tour).to_be_visible()
    other.get_by_role("button", name="Next").click()
    expect(other.get_by_role("dialog", name="Watch it learn")).to_be_visible()
    other.get_by_role("button", name="Dismiss").click()
    expect(other.locator("#tour")).to_be_hidden()
    other.reload()
    expect(other.locator("#loading")).to_be_hidden()
    expect(other.locator("#tour")).to_be_hidden()
