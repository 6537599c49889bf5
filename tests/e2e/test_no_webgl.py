"""Without WebGL the page says so at once, and runs are listed, started, watched, steered and exported all the same."""

import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import FLAGS, PATIENCE, chromium
from playwright.sync_api import Page, expect, sync_playwright
from served import Server, beat_of, events_of, fits, wait_for

from morph_core.protocol import Acknowledged, Lock, Progress, SetAlpha, SetBound, Stop
from morph_core.run_folder import list_runs

pytestmark = pytest.mark.browser


@pytest.fixture
def flat_page() -> Iterator[Page]:
    """A page of a browser without 3-D."""
    with sync_playwright() as playwright:
        flags = [flag for flag in FLAGS if "gl" not in flag and "swiftshader" not in flag]
        browser = playwright.chromium.launch(executable_path=chromium(), args=[*flags, "--disable-3d-apis"])
        page = browser.new_page(viewport={"width": 1000, "height": 900}, accept_downloads=True)
        page.set_default_timeout(PATIENCE)
        yield page
        browser.close()


def test_a_run_is_started_steered_and_exported_without_webgl(server: Server, flat_page: Page, tmp_path: Path) -> None:
    page, complaints = flat_page, []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(server.url)
    expect(page.get_by_text("This browser shows no 3-D:")).to_be_visible()
    expect(page.locator("#loading")).to_be_hidden()
    expect(page.locator("#chooser")).to_contain_text("no runs yet")

    page.get_by_label("Iterations", exact=True).fill("60")
    page.get_by_role("button", name="Start", exact=True).click()
    wait_for("a run folder", lambda: list_runs(server.runs), 15)
    run = server.only_run()
    expect(page.get_by_role("heading", name=run.id)).to_be_visible()
    expect(page.locator("#chooser")).to_contain_text(run.id)
    wait_for("the first iteration", lambda: events_of(run, Progress), 60)
    expect(page.locator("#chip")).to_contain_text("running")
    expect(page.locator("#plain-words")).to_contain_text("iteration")

    page.get_by_label("highest link_1").fill("2.5")
    page.get_by_label("Seed").focus()
    shown = page.locator("#plain-words").inner_text()
    expect(page.locator("#plain-words")).not_to_have_text(shown)
    page.get_by_role("button", name="Pause").click()
    wait_for("the pause", lambda: beat_of(run).status == "paused", 30)
    expect(page.locator("#chip")).to_contain_text("paused")
    expect(page.get_by_label("highest link_1")).to_have_value("2.5")
    page.get_by_label("α, the weight of the divergence").fill("0.5")
    page.locator("#plain-alpha").get_by_role("button", name="Set").click()
    page.get_by_label("lowest link_1").fill("")
    page.get_by_role("button", name="Set the bounds of link_1").click()
    page.get_by_label("lowest link_1").fill("0.1")
    page.get_by_role("button", name="Set the bounds of link_1").click()
    page.get_by_label("hold link_2").check()

    def sent() -> list[type]:
        return [type(answer.command) for answer in events_of(run, Acknowledged)]

    wait_for("the trainer's answers", lambda: {SetAlpha, SetBound, Lock} <= set(sent()), 30)
    bound = next(a.command for a in events_of(run, Acknowledged) if isinstance(a.command, SetBound))
    assert (bound.name, bound.lo, bound.hi) == ("link_1", 0.1, 2.5)
    page.get_by_label("lowest link_1").fill("7")
    page.get_by_role("button", name="Set the bounds of link_1").click()
    expect(page.locator("#banner")).to_contain_text("link_1")
    expect(page.get_by_label("lowest link_1")).to_have_value("0.1")
    page.get_by_role("button", name="Dismiss").click()

    page.get_by_role("button", name="Stop").click()
    wait_for("the end", lambda: Stop in sent(), 30)
    expect(page.get_by_role("button", name="Go on")).to_be_visible()
    page.get_by_label("Export").select_option("latest")
    with page.expect_download() as download:
        page.get_by_role("link", name="Download the zip").click()
    download.value.save_as(tmp_path / "design.zip")
    assert "robot.xml" in zipfile.ZipFile(tmp_path / "design.zip").namelist()

    for width in (390, 1280):
        page.set_viewport_size({"width": width, "height": 800})
        fits(page, width)
    page.get_by_role("link", name="Runs", exact=True).click()
    expect(page.locator(".tabulator-row")).to_have_count(1)
    assert complaints == []
