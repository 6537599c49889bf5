"""The studio behind a proxy that serves it under a path prefix and cuts it off, in a real browser."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Page, expect
from proxies import Proxy
from served import Server, wait_for
from test_studio import nodes_of

from tests.studies import Made, write_study

pytestmark = pytest.mark.browser
PREFIX = "/user/me/proxy/8000"


@pytest.fixture(params=[True, False], ids=["told", "untold"])
def address(server: Server, request: pytest.FixtureRequest) -> Iterator[str]:
    with Proxy(server.port, PREFIX, says_so=request.param).running() as proxy:
        yield f"http://127.0.0.1:{proxy.port}{PREFIX}"


def test_every_page_and_the_viewer_work_under_the_prefix(server: Server, page: Page, address: str) -> None:
    write_study(server.runs, [Made("direct", "direct")], [0], iterations=10)
    missing: list[str] = []
    page.on("response", lambda answer: missing.append(answer.url) if answer.status >= 400 else None)
    page.goto(f"{address}/?{server.url.partition('?')[2]}")
    assert page.url.startswith(f"{address}/")
    frame = page.frame_locator("#viewer")
    frame.get_by_role("tab", name="Traces", exact=True).wait_for()
    wait_for("the robot", lambda: any(name.startswith("/robot/") for name in nodes_of(page.frames[-1])), 30)
    expect(page.locator("#chooser")).to_contain_text("reacher-direct-s0")
    for name, awaited in (("Runs", ".tabulator-row"), ("Study", "#writing, #report")):
        page.get_by_role("link", name=name, exact=True).click()
        page.wait_for_url(f"{address}/{name.lower()}")
        expect(page.locator(awaited).filter(visible=True).first).to_be_visible()
    page.goto(f"{address}/docs")
    page.get_by_role("link", name="studio").click()
    page.wait_for_url(f"{address}/*")
    assert missing == []
