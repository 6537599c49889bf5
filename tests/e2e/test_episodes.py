"""What a person does with the episodes of a run, and with two designs at once, in a browser."""

import contextlib

import numpy as np
import pytest
from playwright.sync_api import Frame, Locator, Page, TimeoutError, expect
from served import Server, wait_for
from test_desk_in_a_browser import shows
from test_studio import nodes_of, pause, turn_to, viewer_of

from morph_core.catalogue import make_task
from morph_core.episodes import outcomes, record_episodes
from morph_core.protocol import Evaluation, StateChanged
from morph_core.rollout import collect
from morph_core.run_folder import EventLog, RunFolder
from morph_core.run_folder import write_episode as write
from studio.viewer.take import FRAMES_PER_SECOND
from tests.studies import Made, write_study

pytestmark = pytest.mark.browser


@pytest.fixture
def runs(server: Server) -> list[RunFolder]:
    """Fill the folder of the server with two runs, whose last iterations have episodes of an untrained policy."""
    write_study(server.runs, [Made("direct", "direct")], [0, 1], iterations=10)
    folders = [RunFolder(server.runs / f"reacher-direct-s{seed}") for seed in (0, 1)]
    for folder in folders:
        evaluate(folder, 10)
    return folders


def evaluate(folder: RunFolder, iteration: int) -> None:
    task, rng = make_task("reacher"), np.random.default_rng(0)
    phi = task.design_space.initial
    hw_phy = task.hw_phy(phi)
    actions = iter(rng.uniform(-1, 1, (task.horizon, 6, task.action_size)).astype(np.float32))
    rollout = collect(task, lambda _: next(actions), hw_phy, task.reset(hw_phy, 6, rng))
    name = write(folder, iteration, record_episodes(task, rollout, phi))
    log = EventLog(folder)
    log.append(
        Evaluation(
            iteration=iteration, env_steps=1000, phi=phi.tolist(), sampled_success=0.5, sampled_return=1.0,
            deterministic_success=0.5, deterministic_return=1.0, episode=name, recorded=outcomes(rollout), episodes=400,
            reward_terms={"distance": 1.0}, return_interval=(0.5, 1.5),
        )
    )  # fmt: skip
    log.append(StateChanged(status="finished", iteration=iteration))
    log.close()


def open_run(page: Page, server: Server, run: RunFolder) -> Frame:
    """Open the studio at a run that has ended."""
    page.set_viewport_size({"width": 1280, "height": 800})
    page.goto(server.url)
    frame = viewer_of(page)
    frame.get_by_role("tab", name="Traces", exact=True).wait_for()
    page.locator("#chooser").select_option(run.id)
    shows(page, run.id)
    return frame


def choose(frame: Frame, label: str, option: str) -> None:
    """Choose from the list beside a label; a list that is redrawn under the pointer is opened once more."""
    row = frame.get_by_text(label, exact=True).first.locator("xpath=ancestor::div[contains(@class, 'Flex-root')][1]")
    shown, entry = row.locator("input").first, frame.get_by_role("option", name=option).first

    def chosen() -> bool:
        if option in shown.input_value():
            return True
        if not entry.is_visible():
            shown.click(force=True)
        with contextlib.suppress(TimeoutError):
            entry.click(force=True, timeout=3000)
        pause(shown)
        return option in shown.input_value()

    wait_for(f"{label}: {option}", chosen, 20)


def type_time(frame: Frame, seconds: float) -> None:
    """Go to a time of the episode that rests; what the player has said just before may come after what is typed."""
    entry = number_beside(frame, "time [s]")

    def there() -> bool:
        entry.fill(f"{seconds:g}")
        entry.press("Enter")
        pause(entry)
        return is_at(frame, seconds)

    wait_for(f"the time {seconds}", there, 10)
    entry.blur()  # keys that are typed into an input are no commands


def number_beside(frame: Frame, label: str) -> Locator:
    """Return the input beside a slider."""
    row = frame.get_by_text(label, exact=True).first.locator("xpath=ancestor::div[contains(@class, 'Flex-root')][1]")
    return row.locator("input:visible").last


def is_at(frame: Frame, seconds: float) -> bool:
    """Tell whether the input beside the slider says so; it may be empty while it is redrawn."""
    return abs(float(number_beside(frame, "time [s]").input_value() or "nan") - seconds) < 0.006


def test_the_best_and_the_worst_episode_are_watched_frame_by_frame(
    server: Server, runs: list[RunFolder], page: Page
) -> None:
    frame = open_run(page, server, runs[0])
    chart = frame.locator('svg[aria-label="terms of the reward over the episode"]')
    chart.wait_for(state="attached")
    median = chart.inner_html()
    choose(frame, "episode", "worst")
    wait_for("the rewards of another episode", lambda: chart.inner_html() != median, 20)

    frame.get_by_role("button", name="Pause playback", exact=True).dispatch_event("click")
    frame.get_by_role("button", name="Play", exact=True).wait_for()
    type_time(frame, 1)
    for key, now in ((".", 61), (".", 62), (",", 61)):
        frame.locator("body").press(key)
        wait_for(f"frame {now}", lambda now=now: is_at(frame, now / FRAMES_PER_SECOND), 10)


def test_two_designs_stand_side_by_side_and_over_each_other(server: Server, runs: list[RunFolder], page: Page) -> None:
    frame = open_run(page, server, runs[0])
    turn_to(frame, "A/B")
    choose(frame, "show B", "side by side")
    wait_for("B", lambda: any(name.startswith("/second_robot/") for name in nodes_of(frame)), 20)
    expect(frame.get_by_text("B, iteration 0: in its start posture").first).to_be_attached()
    choose(frame, "B: run", runs[1].id)
    entry = number_beside(frame, "B: iteration")
    entry.fill("10")
    entry.press("Enter")
    expect(frame.get_by_text("+0 points").first).to_be_attached()
    expect(frame.get_by_text(f"B: {runs[1].id}").first).to_be_attached()
    choose(frame, "show B", "overlaid")
    expect(frame.get_by_text("own colours").first).to_be_attached()
    choose(frame, "show B", "off")
    expect(frame.get_by_text("own colours")).to_have_count(0)
