"""A number that nobody can be sent, typed into a field: the browsers that come next are served all the same."""

import pytest
from playwright.sync_api import Frame, Page
from served import Server
from test_studio import open_studio, pause, viewer_of

from tests.studies import Made, write_study

pytestmark = pytest.mark.browser
WILD = ("99999999999999999999", "1e308")


def type_into(frame: Frame, label: str, words: str) -> None:
    """Type into the input beside a label as a person does."""
    row = frame.get_by_text(label, exact=True).first.locator("xpath=ancestor::div[contains(@class, 'Flex-root')][1]")
    field = row.locator("input").first
    field.fill(words)
    field.press("Tab")
    pause(field)


def test_the_next_browser_is_served(server: Server, page: Page, other: Page) -> None:
    write_study(server.runs, [Made("direct", "direct")], [0], iterations=10)
    frame = open_studio(page, server)
    for label in ("iterations", "seed"):
        for wild in WILD:
            type_into(frame, label, wild)
    other.context.add_cookies(page.context.cookies())  # pyright: ignore[reportArgumentType]
    other.goto(f"http://127.0.0.1:{server.port}/")
    viewer_of(other).get_by_role("button", name="Start", exact=True).wait_for()
    assert "OverflowError" not in "".join(server._lines)
