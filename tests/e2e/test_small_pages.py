"""On a phone and at 200 % zoom the chooser can be read, and the scene has a third of the width."""

import pytest
from playwright.sync_api import Page, expect
from served import Server, fits, wait_for

from tests.studies import Made, write_study

pytestmark = pytest.mark.browser

SCENE = """() => {
    const shares = [0.1, 0.3, 0.5, 0.7, 0.9].map((y) => {
        const xs = Array.from({ length: 100 }, (_, i) => (i + 0.5) / 100 * innerWidth);
        return xs.filter((x) => document.elementFromPoint(x, y * innerHeight)?.tagName === "CANVAS").length / 100;
    });
    return Math.max(...shares);
}"""
"""Script that returns how much of the width is scene, in the row that shows most of it."""


@pytest.mark.parametrize(("width", "height"), [(390, 844), (640, 360)], ids=["phone", "zoomed"])
def test_the_chooser_can_be_read_and_the_scene_has_a_third(server: Server, page: Page, width: int, height: int) -> None:
    write_study(server.runs, [Made("direct", "direct")], [0], iterations=10)
    page.set_viewport_size({"width": width, "height": height})
    page.goto(server.url)
    page.frame_locator("#viewer").get_by_text("Run and playback").wait_for()
    expect(page.locator("#loading")).to_be_hidden()
    chooser = page.locator("#chooser").bounding_box()
    assert chooser is not None
    assert chooser["width"] > 300
    fits(page, width)
    wait_for("a third of the width", lambda: page.frames[-1].evaluate(SCENE) > 1 / 3, 10)
