"""The first visit: a recorded evolution plays at once, and presenter's mode trains live by one key."""

import pytest
from playwright.sync_api import Page, expect
from served import Server, events_of, wait_for
from test_studio import robot_of, viewer_of

from morph_core.protocol import StateChanged
from morph_core.run_folder import list_runs

pytestmark = pytest.mark.browser


def test_a_first_visit_sees_a_robot_evolve_and_a_key_trains_one(server: Server, page: Page) -> None:
    page.goto(server.url)
    frame = viewer_of(page)
    expect(page.locator("#loading")).to_be_hidden()
    label = page.locator("#caption-label")
    expect(label).to_contain_text("recorded: 211 iterations, 3 minutes of training, shown in 20 s")
    body = wait_for("the robot", lambda: robot_of(frame), 10)
    wait_for("its evolution", lambda: robot_of(frame) != body, 10)
    expect(page.locator("#caption-title")).to_be_hidden()
    assert page.request.get(f"http://127.0.0.1:{server.port}/api/runs").json() == []

    page.keyboard.press("f")
    expect(page.locator("header")).to_be_hidden()
    expect(page.locator("#caption-title")).to_be_visible()
    expect(page.locator("#caption-iteration")).to_contain_text("of 211")
    expect(frame.get_by_role("tab", name="Timeline", exact=True)).to_be_hidden()
    expect(label).to_contain_text("recorded: ")
    page.keyboard.press("Enter")
    wait_for("a run", lambda: list_runs(server.runs), 20)
    run = server.only_run()
    wait_for("its trainer", lambda: events_of(run, StateChanged), 30)
    expect(label).to_contain_text(f"{run.id}: ")
    expect(label).not_to_contain_text("recorded")
    page.keyboard.press("Escape")
    expect(page.locator("header")).to_be_visible()
    expect(label).to_be_hidden()
