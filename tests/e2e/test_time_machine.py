"""The timeline and the gallery in a real browser: scrubbed with marks, starred, a picture clicked."""

import time
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Frame, Page, expect
from served import Server, wait_for
from test_studio import pause, press, turn_to, viewer_of

from morph_core.catalogue import make_method, make_task
from morph_core.config import recorded
from morph_core.protocol import FORMAT, Acknowledged, Evaluation, Progress, RunRecord, SetAlpha, StateChanged
from morph_core.run_folder import EventLog, create_run, list_runs, write_episode

pytestmark = pytest.mark.browser

RUN = "20260101-000000-reacher-morph-s0"
CHARTS = """() => Object.values(window.__viserTestpoints?.uplots ?? {}).map(({chart}) => {
    const line = Array.from(chart.data[chart.data.length - 1]);
    return [chart.data[0][line.indexOf(2)], chart.scales.y.min, chart.scales.y.max];
})"""
"""Script that gives each chart's iteration with the upright line, and the limits of its y axis."""


@pytest.fixture
def run(tmp_path: Path) -> str:
    """A finished run of twenty iterations whose first link shrinks, with a command and two episodes."""
    task = make_task("reacher")
    record = RunRecord(
        id=RUN, task="reacher", method="morph", seed=0, iterations=20, config=recorded(make_method("morph", task)),
        format=FORMAT, parameters=list(task.design_space.parameters), versions={"python": "3"}, created=time.time(),
    )  # fmt: skip
    folder = create_run(tmp_path / "runs", record)
    log = EventLog(folder)
    log.append(StateChanged(status="starting", iteration=0))
    for i in range(1, 21):
        phi = [3 - 0.1 * i, 3.0, 3.0, 3.0, 3.0]
        alpha = 1.0 if i <= 6 else 0.25
        log.append(
            Progress(iteration=i, env_steps=i, phi=phi, episode_return=-1.0, success=0.0, policy_std=0.5, alpha=alpha)
        )
        if i == 6:
            log.append(Acknowledged(id=1, iteration=6, accepted=True, command=SetAlpha(0.25)))
        if i % 10 == 0:
            name = write_episode(folder, i, {"qpos": np.zeros((4, 5)), "phi": np.array(phi)})
            log.append(
                Evaluation(
                    iteration=i, env_steps=i, phi=phi, sampled_success=i / 20, sampled_return=0.0,
                    deterministic_success=0.0, deterministic_return=0.0, episode=name,
                )
            )  # fmt: skip
    log.append(StateChanged(status="finished", iteration=20, message="as asked"))
    log.close()
    return RUN


def scrub(frame: Frame, iteration: int) -> None:
    label = frame.locator("label").get_by_text("iteration", exact=True).first
    entry = label.locator("xpath=ancestor::div[contains(@class, 'Flex-root')][1]").locator("input").last
    entry.fill(str(iteration))
    pause(entry)


def test_a_run_is_scrubbed_through_with_its_marks_and_a_picture_turns_to_its_design(
    run: str, server: Server, page: Page
) -> None:
    assert list_runs(server.runs) == [run]  # before the server began: the newest one is on screen
    page.set_viewport_size({"width": 1280, "height": 800})
    page.goto(server.url)
    frame = viewer_of(page)
    marks = frame.get_by_role("img", name="what happened in the run, by iteration")
    marks.wait_for(state="attached")
    told = marks.locator("title")
    wait_for(
        "the command", lambda: "α set to 0.25, in force from iteration 7" in " ".join(told.all_text_contents()), 10
    )
    expect(frame.get_by_text("In force at iteration 20")).to_be_attached()

    scrub(frame, 4)
    expect(frame.get_by_text("In force at iteration 4")).to_be_attached()
    expect(frame.get_by_text("α 1 · projection")).to_be_attached()

    def charts_are_drawn() -> bool:
        charts = frame.evaluate(CHARTS)
        return 4 in [line for line, _, _ in charts] and all((low or 0) < (high or 0) for _, low, high in charts)

    wait_for("the line in the charts, and their limits", charts_are_drawn, 30)

    press(frame, "next")
    expect(frame.get_by_text("In force at iteration 6")).to_be_attached()
    press(frame, "on")
    expect(frame.get_by_text("design of iteration 10, playing its episode")).to_be_attached()

    press(frame, "Star this design")
    turn_to(frame, "Gallery")
    press(frame, "Draw the gallery")
    picture = frame.get_by_role("img", name="design of iteration 10", exact=True)
    expect(picture).to_be_attached()
    expect(frame.get_by_text("★ 10").first).to_be_attached()
    initial = frame.get_by_role("img", name="design of iteration 0", exact=True)
    initial.dispatch_event("click")  # wherever it stands by now
    expect(frame.get_by_text("initial design, in its start posture")).to_be_attached()
