"""axe finds nothing serious on our pages, and in the viewer nothing but what is viser's own and listed."""

import re
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Frame, Page, expect
from served import Server, wait_for

from tests.studies import Made, write_study

pytestmark = pytest.mark.browser

GRAVE = ("serious", "critical")
AT_REST = """async () => {
    const ends = (one) => one.playState === "running" && one.effect?.getComputedTiming().endTime < Infinity;
    await Promise.all(document.getAnimations().filter(ends).map((one) => one.finished.catch(() => null)));
}"""
"""Script that waits until nothing fades in any more: half a colour is too pale for axe."""
LISTED = Path(__file__).resolve().parents[2] / "docs" / "accessibility.md"


def grave(where: Page | Frame) -> dict[str, list[str]]:
    """Return what axe finds serious or critical, each rule with what it found it in."""
    where.evaluate(AT_REST)
    found = Axe().run(where).response["violations"]
    return {one["id"]: [node["html"][:200] for node in one["nodes"]] for one in found if one["impact"] in GRAVE}


@pytest.fixture
def filled(server: Server) -> Server:
    write_study(server.runs, [Made("direct", "direct"), Made("fixed", "no_hw_opt")], [0, 1], iterations=10)
    return server


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_our_pages_have_nothing_that_is_serious(filled: Server, page: Page, scheme: str) -> None:
    page.emulate_media(color_scheme=scheme)  # pyright: ignore[reportArgumentType]
    base = f"http://127.0.0.1:{filled.port}"
    page.goto(base)
    expect(page.get_by_role("button", name="Enter")).to_be_visible()
    assert grave(page) == {}, "the login page"

    page.goto(filled.url)
    page.frame_locator("#viewer").get_by_role("tab", name="Traces", exact=True).wait_for()
    expect(page.locator("#loading")).to_be_hidden()
    assert grave(page) == {}, "the shell"
    page.keyboard.press("?")
    expect(page.get_by_role("dialog", name="Keys")).to_be_visible()
    assert grave(page) == {}, "the keys"
    page.get_by_role("button", name="Show the tour").click()
    expect(page.locator("#tour")).to_be_visible()
    assert grave(page) == {}, "the tour"

    assert_audience_has_nothing(page, base, scheme)

    page.goto(f"{base}/docs")
    assert grave(page) == {}, "the API page"

    page.goto(f"{base}/study")
    expect(page.locator("#writing, #report").filter(visible=True)).to_be_visible()
    assert grave(page) == {}, "the study"

    page.goto(f"{base}/runs")
    expect(page.locator(".tabulator-row")).to_have_count(4)
    assert grave(page) == {}, "the runs"
    page.get_by_role("checkbox", name="Select all runs that fit the filters").check()
    page.get_by_role("button", name="Compare").click()
    expect(page.locator("#compared")).to_have_text("4 runs compared")
    assert grave(page) == {}, "a comparison"
    for button in ("Trash", "Keys"):
        page.get_by_role("button", name=button, exact=True).click()
        expect(page.get_by_role("dialog", name=button)).to_be_visible()
        assert grave(page) == {}, button
        page.keyboard.press("Escape")


def assert_audience_has_nothing(presenter: Page, base: str, scheme: str) -> None:
    browser = presenter.context.browser
    assert browser is not None
    presenter.locator("#chooser").select_option("reacher-direct-s1")
    link = presenter.request.post(f"{base}/api/audience", headers={"Origin": base}, data={}).json()["link"]
    page = browser.new_page(color_scheme=scheme)  # pyright: ignore[reportArgumentType]
    page.goto(f"{base}/{link}")
    expect(page.locator("#curves")).to_be_visible()
    expect(page.locator("#curtain")).to_be_hidden()
    assert grave(page) == {}, "the audience"
    page.get_by_role("button", name="Look around alone").click()
    expect(page.locator("#opening")).to_be_hidden()
    assert grave(page) == {}, "a spectator alone"
    page.context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_narrow_and_empty_pages_have_nothing_that_is_serious(server: Server, page: Page, scheme: str) -> None:
    page.emulate_media(color_scheme=scheme, reduced_motion="reduce")  # pyright: ignore[reportArgumentType]
    page.set_viewport_size({"width": 390, "height": 844})
    page.goto(server.url)
    base = f"http://127.0.0.1:{server.port}"
    for path, heading in (
        ("runs", "No runs in this folder yet"),
        ("study", "No study in this folder of runs"),
        ("nothing", "There is no such page"),
    ):
        page.goto(f"{base}/{path}")
        expect(page.get_by_role("heading", name=heading)).to_be_visible()
        assert grave(page) == {}, heading

    write_study(server.runs, [Made("direct", "direct"), Made("fixed", "no_hw_opt")], [0], iterations=10)
    (server.runs / "reacher-fixed-s0" / "run.json").write_text("{")
    page.goto(f"{base}/runs")
    rows = page.locator(".tabulator-row")
    expect(rows).to_have_count(2)
    expect(rows.filter(has_text="unreadable: ")).to_have_count(1)
    rows.filter(has_text="reacher-direct-s0").get_by_role("checkbox").check()
    page.get_by_role("button", name="Compare").click()
    expect(page.locator("#comparison .bar")).to_be_in_viewport()
    assert grave(page) == {}, "a comparison"
    page.get_by_role("button", name="Delete").click()
    assert grave(page) == {}, "the question before a run is deleted"
    page.keyboard.press("Escape")
    page.get_by_role("searchbox", name="Search").fill("nothing")
    expect(rows).to_have_count(0)
    assert grave(page) == {}, "no run fits"
    page.get_by_role("button", name="Clear the filters").click()
    expect(rows).to_have_count(2)
    expect(page.get_by_role("searchbox", name="Search")).to_be_focused()


def test_what_the_viewer_lacks_is_visers_own_and_listed(filled: Server, page: Page) -> None:
    page.goto(filled.url)
    page.frame_locator("#viewer").get_by_role("tab", name="Traces", exact=True).wait_for()
    expect(page.locator("#loading")).to_be_hidden()
    listed = re.findall(r"^\| `([a-z-]+)`", LISTED.read_text(), re.MULTILINE)
    assert listed

    def unlisted() -> dict[str, list[str]]:
        return {rule: where for rule, where in grave(page.frames[-1]).items() if rule not in listed}

    wait_for(f"a page without {unlisted()}", lambda: not unlisted(), 15)
