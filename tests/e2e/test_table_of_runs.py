"""The runs page in a real browser: runs are found, noted, compared, opened, archived, deleted and brought back."""

import re
from pathlib import Path

import pytest
from playwright.sync_api import ConsoleMessage, Locator, Page, expect
from served import Server, fits, wait_for

from morph_core.run_folder import list_runs
from studio.shelf.marks import Marks, read_marks
from studio.viewer import wording
from tests.studies import Made, write_study

pytestmark = pytest.mark.browser

EVIL = "<img src=x onerror=\"document.title='taken'\">"


@pytest.fixture
def runs(server: Server) -> Path:
    """Fill the folder of the server with runs of two methods, three seeds each."""
    write_study(server.runs, [Made("direct", "direct"), Made("fixed", "no_hw_opt", top=0.1)], [0, 1, 2], iterations=10)
    return server.runs


def rows_of(page: Page) -> Locator:
    return page.locator(".tabulator-row")


def row_of(page: Page, run: str) -> Locator:
    return rows_of(page).filter(has_text=run)


def open_runs(page: Page, server: Server) -> list[str]:
    """Open the runs page by its link; return the list to which the browser's complaints are added."""
    complaints: list[str] = []
    page.set_viewport_size({"width": 1280, "height": 800})
    page.goto(server.url)
    page.get_by_role("link", name="Runs").click()
    page.wait_for_url("**/runs")

    def hear(message: ConsoleMessage) -> None:
        if message.type == "error" and "/runs" in page.url and "status of 422" not in message.text:
            complaints.append(message.text)

    page.on("console", hear)
    page.on("pageerror", lambda error: complaints.append(str(error)))  # the viewer's own are behind us
    return complaints


def test_runs_are_found_noted_archived_deleted_and_brought_back(server: Server, runs: Path, page: Page) -> None:
    complaints = open_runs(page, server)
    expect(rows_of(page)).to_have_count(6)
    for kind, numbers in (("duration", (45, 5399, 7190, 3e5)), ("percent", (0.125, 0.375, 1.0))):
        said = page.evaluate(f"(all) => all.map({kind})", numbers)
        assert said == list(map(getattr(wording, kind), numbers)), "as the viewer's panels have it"
    expect(page.locator("#count")).to_have_text("6 runs")
    first = row_of(page, "reacher-direct-s0")
    expect(first).to_contain_text("finished")
    picture = first.get_by_role("img", name="Open reacher-direct-s0 in the 3-D viewer")
    wait_for("a thumbnail", lambda: picture.evaluate("image => image.complete && image.naturalWidth === 192"), 20)

    # Found: by words, by a filter, in the order of a column.
    page.get_by_role("searchbox", name="Search").fill("no_hw s1")
    expect(rows_of(page)).to_have_count(1)
    page.get_by_role("searchbox", name="Search").fill("")
    page.get_by_label("Method").select_option("direct")
    expect(rows_of(page)).to_have_count(3)
    expect(page.locator("#count")).to_have_text("3 of 6 runs")
    page.get_by_label("Method").select_option("")
    page.get_by_role("columnheader", name="success").click()
    expect(rows_of(page).first).to_contain_text("reacher-direct")
    page.get_by_role("columnheader", name="success").press("Enter")
    expect(rows_of(page).first).to_contain_text("reacher-fixed")

    # Selected with the keys alone: the bar that comes draws the rows anew, and the focus stays where it was.
    top = rows_of(page).first
    top.focus()
    page.keyboard.press(" ")
    expect(page.locator("#chosen")).to_have_text("1 selected")
    expect(top).to_be_focused()
    for key in ("ArrowDown", " ", "ArrowDown", " ", " ", "ArrowUp"):  # faster than rows are drawn
        page.keyboard.press(key)
    expect(page.locator("#chosen")).to_have_text("2 selected")
    page.keyboard.press("Escape")
    expect(page.locator("#actions")).to_be_hidden()
    expect(rows_of(page).nth(1)).to_be_focused()

    # Noted, with the keys alone; what was typed is text wherever it is shown.
    first.focus()
    page.keyboard.press("s")
    expect(first.get_by_role("button", name="Star reacher-direct-s0")).to_have_attribute("aria-pressed", "true")
    first.focus()
    page.keyboard.press("e")
    dialog = page.get_by_role("dialog", name="reacher-direct-s0")
    dialog.get_by_label("Name").fill(EVIL)
    dialog.get_by_label("Tags").fill("to print, " + "x" * 40)
    dialog.get_by_label("Note").fill("look\nagain")
    dialog.get_by_label("Name").press("Enter")
    expect(dialog.get_by_role("alert")).to_contain_text("a tag has at most 32 characters")
    dialog.get_by_label("Tags").fill("to print")
    dialog.get_by_role("button", name="Save").click()
    expect(dialog).to_be_hidden()
    expect(first).to_contain_text(EVIL)
    assert read_marks(runs / "reacher-direct-s0") == Marks(
        starred=True, name=EVIL, note="look\nagain", tags=("to print",)
    )
    page.get_by_label("Tag", exact=True).select_option("to print")
    expect(rows_of(page)).to_have_count(1)
    page.get_by_label("Tag", exact=True).select_option("")

    # Archived, and back.
    row_of(page, "reacher-direct-s1").focus()
    page.keyboard.press("a")
    expect(rows_of(page)).to_have_count(5)
    page.get_by_label("Archived").select_option("only")
    expect(rows_of(page)).to_have_count(1)
    page.get_by_label("Archived").select_option("hide")
    page.keyboard.press("Escape")
    page.locator("#toast").get_by_role("button", name="Undo").click()
    expect(rows_of(page)).to_have_count(6)
    assert not read_marks(runs / "reacher-direct-s1").archived

    # Deleted after a question; back by undo, and from the trash.
    for name in ("reacher-direct-s1", "reacher-direct-s2"):
        row_of(page, name).get_by_role("checkbox").check()
    page.get_by_role("toolbar").get_by_role("button", name="Delete").click()
    asked = page.get_by_role("dialog", name="Delete 2 runs?")
    expect(asked).to_contain_text("reacher-direct-s2")
    asked.get_by_role("button", name="Keep").click()
    assert len(list_runs(runs)) == 6
    page.get_by_role("toolbar").get_by_role("button", name="Delete").click()
    asked.get_by_role("button", name="Delete").click()
    expect(rows_of(page)).to_have_count(4)
    assert len(list_runs(runs)) == 4
    page.locator("#toast").get_by_role("button", name="Undo").click()
    expect(rows_of(page)).to_have_count(6)
    row_of(page, "reacher-fixed-s0").focus()
    page.keyboard.press("Delete")
    page.get_by_role("dialog", name="Delete 1 run?").get_by_role("button", name="Delete").press("Enter")
    expect(rows_of(page)).to_have_count(5)
    page.get_by_role("button", name="Trash", exact=True).click()
    page.get_by_role("button", name="Restore reacher-fixed-s0").click()
    expect(page.get_by_text("The trash is empty.")).to_be_visible()
    page.get_by_role("dialog", name="Trash").get_by_role("button", name="Close").click()
    expect(rows_of(page)).to_have_count(6)

    for width in (390, 1920):
        page.set_viewport_size({"width": width, "height": 800})
        fits(page, width)
    assert (complaints, page.title()) == ([], "Runs · MORPH Studio")
    server.kill()
    expect(page.get_by_text("The server does not answer")).to_be_visible()


@pytest.mark.usefixtures("runs")
def test_runs_are_compared_and_a_design_is_opened_in_3d(server: Server, page: Page) -> None:
    complaints = open_runs(page, server)
    for run in ("reacher-direct-s0", "reacher-direct-s1"):
        row_of(page, run).get_by_role("checkbox").check()
    evolution = page.get_by_role("button", name="Evolution")
    with page.expect_download() as download:
        evolution.click()
    assert download.value.suggested_filename.endswith("-evolution.html")
    html = download.value.path().read_text()
    assert "reacher-direct-s0" in html
    assert "reacher-direct-s1" in html
    page.get_by_role("checkbox", name="Select all runs that fit the filters").check()
    expect(page.locator("#chosen")).to_have_text("6 selected")
    expect(evolution).to_be_disabled()
    rows_of(page).first.focus()
    page.keyboard.press("c")
    expect(page.locator("#compared")).to_have_text("6 runs compared")
    expect(page.get_by_text("thick: mean of a method's runs; shaded: its 95 % interval")).to_be_visible()
    expect(page.locator("#brushed")).to_contain_text("18 designs")
    page.locator("#designs").select_option("best")
    expect(page.locator("#brushed")).to_contain_text("6 designs")
    page.locator("#designs").select_option("all")
    expect(page.locator("#brushed")).to_contain_text("18 designs")
    traces, parallel = page.locator("#traces canvas"), page.locator("#parallel canvas")
    drawn = "canvas => new Set(canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data).size"
    wait_for("the traces", lambda: traces.evaluate(drawn) > 50, 10)
    before = traces.evaluate("canvas => canvas.toDataURL()")
    page.locator("#measure").select_option("episode_return")
    wait_for("other traces", lambda: traces.evaluate("canvas => canvas.toDataURL()") != before, 10)

    # The upper half of the axis of success, brushed, leaves the designs of one method.
    box = parallel.bounding_box()
    assert box is not None
    axis = 30 + 5 / 6 * (box["width"] - 30 - 104)
    page.mouse.move(box["x"] + axis, box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + axis, box["y"] + box["height"] / 2, steps=5)
    page.mouse.up()
    expect(page.locator("#brushed")).to_have_text(re.compile(r"^\d of 18 designs"))

    # A line under the pointer is named; a click opens it.
    def names_a_line() -> bool:
        for share in range(20, 80):
            page.mouse.move(box["x"] + axis - 30, box["y"] + box["height"] * share / 100)
            page.evaluate("new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(go)))")
            if page.locator("#design").is_visible():
                return True
        return False

    wait_for("a line under the pointer", names_a_line, 30)
    told = re.search(r"(\S+)\niteration (\d+)", page.locator("#caption").inner_text())
    assert told is not None
    assert complaints == []
    page.mouse.down()
    page.mouse.up()
    page.wait_for_url(re.compile(rf"/\?run={told[1]}&iteration={told[2]}$"))
    frame = page.frame_locator("#viewer")
    expect(frame.get_by_text(f"design of iteration {told[2]}, in its start posture")).to_be_attached()

    # The way back leads to the same comparison.
    page.go_back()
    expect(page.locator("#compared")).to_have_text("6 runs compared")
    expect(page.locator("#chosen")).to_have_text("6 selected")
