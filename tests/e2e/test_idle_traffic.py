"""What an open page costs while nothing happens, counted in a proxy, and what it says when a run is gone."""

import shutil
import time

import pytest
from playwright.sync_api import Page, expect
from proxies import Proxy
from served import Server, wait_for

from studio.recordings import Recordings
from tests.studies import Made, write_study

pytestmark = pytest.mark.browser


def fill(server: Server, count: int) -> list[str]:
    """Give the server's folder so many runs that have ended; return their names, the newest first."""
    write_study(server.runs, [Made("direct", "direct")], [0], iterations=10)
    (made,) = [path.parent for path in server.runs.glob("*/run.json")]
    for number in range(1, count):
        shutil.copytree(made, made.with_name(f"{made.name}-{number:03d}"))
    return sorted((path.parent.name for path in server.runs.glob("*/run.json")), reverse=True)


def rate(proxy: Proxy, page: Page, seconds: float) -> float:
    """Return the bytes a second that go through the proxy, both ways."""
    before, began = proxy.counted, time.monotonic()
    page.wait_for_timeout(1000 * seconds)
    return (proxy.counted - before) / (time.monotonic() - began)


@pytest.mark.parametrize("path", ["runs", ""])
def test_an_idle_page_with_600_ended_runs_costs_less_than_a_kilobyte_a_second(
    server: Server, page: Page, path: str
) -> None:
    names = fill(server, 600)
    with Proxy(server.port).running() as proxy:
        address = f"http://127.0.0.1:{proxy.port}/"
        page.goto(f"{address}?{server.url.partition('?')[2]}")
        if path:
            page.goto(address + path)
            expect(page.locator("#count")).to_have_text("600 runs")
        else:
            page.goto(f"{address}?run={names[0]}")
            frame = page.frame_locator("#viewer")
            frame.get_by_role("tab", name="Timeline", exact=True).wait_for()
            expect(page.locator("#chooser option")).to_have_count(600 + len(Recordings().names()))
            page.keyboard.press(" ")  # pauses the episode, where one is played
        wait_for("the end of loading", lambda: rate(proxy, page, 3) < 1024, 30)
        assert rate(proxy, page, 12) < 1024

        # What happens is seen all the same.
        shutil.rmtree(server.runs / names[0])
        if path:
            expect(page.locator("#count")).to_have_text("599 runs")
        else:
            expect(page.locator("#words")).to_contain_text(f"{names[0]} is no longer in the folder")
            expect(page.locator("#chooser option")).to_have_count(
                600 + len(Recordings().names())
            )  # with the one that is gone
