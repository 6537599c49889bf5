"""A spectator in a browser of its own sees the presenter scrub, and nothing that it forges changes anything."""

import re
from typing import Any

import msgspec
import pytest
from playwright.sync_api import Frame, Page, expect
from served import Server, wait_for
from test_desk_in_a_browser import NEW, choose, open_page, shows
from test_studio import nodes_of

from studio.bridge import ALLOWED

pytestmark = pytest.mark.browser
ASK = """async ([method, path, content]) => (await fetch(path, {
    method, headers: {"Content-Type": "application/json"}, body: content && JSON.stringify(content) })).status"""
FORGE = """([path, messages]) => new Promise((done) => {
    const socket = new WebSocket(new URL(path, location.href.replace("http", "ws")), ["viser-v1.1.1"]);
    socket.onclose = (event) => done(event.code);
    socket.onopen = async () => {
        for (const message of messages) socket.send(new Uint8Array(message));
        setTimeout(() => done("open"), 1000);
    };
})"""


@pytest.fixture
def spectator(other: Page) -> Page:
    other.set_viewport_size({"width": 500, "height": 700})
    return other


def scene_of(spectator: Page) -> Frame:
    frame = spectator.frame(url=re.compile("/audience/viewer/"))
    assert frame is not None
    return frame


def forged(kind: str) -> list[int]:
    message: dict[str, Any] = {"type": kind, "uuid": "u", "updates": {"value": 1}, "name": "/robot/box", "value": True}
    return list(msgspec.msgpack.encode(message))


@pytest.mark.usefixtures("runs")
def test_a_spectator_sees_what_the_presenter_does_and_can_do_nothing(
    server: Server, page: Page, spectator: Page
) -> None:
    open_page(page, server.url)
    choose(page, NEW)
    page.locator("#invite").click()
    page.get_by_role("button", name="Make the link").click()
    expect(page.locator("#audience-address")).to_have_value(re.compile(r"/audience\?link=."))
    spectator.goto(page.locator("#audience-address").input_value())
    expect(spectator.locator("#iteration")).to_have_text("10")
    expect(page.locator("#audience-words")).to_contain_text("1 person is watching")
    page.keyboard.press("Escape")

    page.keyboard.press("ArrowLeft")
    shows(page, NEW, 9)
    expect(spectator.locator("#iteration")).to_have_text("9")
    wait_for("the robot", lambda: any(n.startswith("/robot/") for n in nodes_of(scene_of(spectator))), 30)

    path = spectator.locator("#scene").get_attribute("src")
    assert path is not None
    kinds = [forged(kind) for kind in sorted(ALLOWED - {"ViewerCameraMessage"})]
    assert spectator.evaluate(FORGE, [path.partition("?")[0].rstrip("/"), kinds]) == "open"
    assert spectator.evaluate(FORGE, ["viewer", kinds]) == 1006, "the presenter's own socket"
    for method, address in (("GET", "api/runs"), ("POST", f"api/runs/{NEW}/commands"), ("DELETE", "api/audience")):
        assert spectator.evaluate(ASK, [method, address, None if method == "GET" else {}]) == 403, address
    shows(page, NEW, 9)

    spectator.get_by_role("button", name="Look around alone").click()
    alone = spectator.frame_locator("#evolution")
    expect(alone.locator("#runs")).to_contain_text(NEW)
    spectator.get_by_role("button", name="Back to the presenter").click()
    expect(spectator.locator("#iteration")).to_be_visible()

    page.locator("#invite").click()
    page.get_by_role("button", name="End the link").click()
    expect(spectator.locator("#sentence")).to_contain_text("has ended this link")
    spectator.reload()
    expect(spectator.locator("body")).to_contain_text("does not let anybody in")
