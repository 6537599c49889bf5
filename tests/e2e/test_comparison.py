"""The comparison of a study in a real browser: empty, being written, read, renewed; light, dark and on a phone."""

import re
import shutil

import pytest
from playwright.sync_api import Page, expect
from served import Server, fits, wait_for

from morph_core.protocol import StateChanged
from morph_core.run_folder import EventLog, RunFolder
from tests.studies import Made, write_study

pytestmark = pytest.mark.browser


def test_a_person_compares_the_methods_of_a_study_while_it_runs(server: Server, page: Page) -> None:
    refused: list[str] = []
    page.on("console", lambda message: refused.append(message.text) if message.type == "error" else None)
    page.goto(server.url)
    page.get_by_role("link", name="Study").click()
    expect(page.get_by_role("heading", name="No study in this folder of runs")).to_be_visible()
    expect(page.locator("#why-empty")).to_contain_text("there is no study.json in it")

    shutil.rmtree(server.runs, ignore_errors=True)
    made = [Made("direct", "direct"), Made("<b>odd</b>", "no_hw_opt", top=0.0)]
    study = write_study(server.runs, made, [0, 1, 2], iterations=10, status={("direct", 2): "running"})
    expect(page.get_by_text("the first report takes about half a minute")).to_be_visible()
    report = page.frame_locator("#report")
    expect(report.get_by_role("heading", name="Study: 2 methods on reacher")).to_be_visible(timeout=200_000)
    expect(report.get_by_text("This study is not complete")).to_be_visible()
    expect(report.get_by_role("rowheader", name="<b>odd</b>").first).to_be_visible()
    expect(report.get_by_role("img", name="reacher: success and return over environment steps")).to_be_visible()
    expect(page.get_by_role("status")).to_have_text(re.compile(r"runs as they were \d+ (s|min) ago"))

    # The style sheet is allowed, and it follows the theme of the studio.
    heading = report.get_by_role("heading", name="Summary")
    colour = heading.evaluate("element => getComputedStyle(element).color")
    page.get_by_role("button", name="Switch between light and dark").click()
    expect(heading).not_to_have_css("color", colour)
    for width in (1920, 390):
        page.set_viewport_size({"width": width, "height": 800})
        fits(page, width)
        wait_for(
            "a report that fits",
            lambda width=width: heading.evaluate("e => e.ownerDocument.documentElement.scrollWidth") <= width, 10,
        )  # fmt: skip

    # What a run writes is shown, where the reader is.
    report.get_by_text("What the columns mean").click()
    heading.evaluate("element => element.ownerDocument.defaultView.scrollTo(0, 400)")
    planned = next(one for one in study.runs if (one.variant, one.seed) == ("direct", 2))
    log = EventLog(RunFolder(server.runs / planned.run))
    log.append(StateChanged(status="failed", iteration=5, message="struck by lightning"))
    log.close()
    expect(report.get_by_text("struck by lightning").first).to_be_attached(timeout=200_000)
    wait_for("the place", lambda: heading.evaluate("e => e.ownerDocument.defaultView.scrollY") == 400, 10)
    expect(report.get_by_text("The variant's label in the plan.")).to_be_visible()
    assert refused == []

    server.kill()
    expect(page.get_by_text("The server does not answer")).to_be_visible()
