"""The what-if panel on a real viser server, with answers that need no policy."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import viser
from conftest import Page, eventually, make_hand_run, make_run

from morph_core.history import History
from morph_core.protocol import DesignSpaceChanged, InjectDesign
from morph_core.run_folder import EventLog, RunFolder
from studio.app import _branch
from studio.cancellation import Cancellation, CancelledError
from studio.new_run import Branch
from studio.viewer.curves import Scale, curves_of, scale_of
from studio.viewer.newest import Newest
from studio.viewer.what_if import SWEEP_EPISODES, WhatIfPanel
from studio.what_if import SweepPoint


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_run(tmp_path / "runs", ended="finished")


@pytest.fixture
def panel(page: Page, folder: RunFolder) -> WhatIfPanel:
    """The panel of a run, with the sliders on screen and the recorded design measured."""
    page.show(folder)
    panel = page.viewer.what_if
    click(panel.begin)
    assert eventually(lambda: panel.found)
    return panel


def click(button: viser.GuiButtonHandle) -> None:
    for callback in button._impl.update_cb:
        callback(SimpleNamespace(client=None, client_id=None, target=button))  # pyright: ignore[reportArgumentType]


def drag(panel: WhatIfPanel, i: int, value: float) -> None:
    """Set a slider as a browser does."""
    slider = panel._rows[i].slider
    slider.value = value
    panel._drag(i, None)


def test_what_people_do_waits_while_another_run_is_shown(page: Page, panel: WhatIfPanel) -> None:
    slider, done = panel._rows[0].slider, threading.Event()

    def press() -> None:
        for button in (panel.reset, panel.sweep, panel.stop_sweep, panel.leave):
            click(button)
        done.set()

    with page.viewer._lock:
        thread = threading.Thread(target=press)
        thread.start()
        assert not done.wait(0.1)
        assert panel.open
    assert done.wait(20)
    thread.join()
    panel._rows = []  # as when a run of another task is opened
    for callback in slider._impl.update_cb:
        callback(SimpleNamespace(client=SimpleNamespace(), target=slider))  # pyright: ignore[reportArgumentType]


def test_the_sliders_begin_at_the_design_of_the_timeline_and_its_policy_is_tried(
    page: Page, panel: WhatIfPanel
) -> None:
    assert [row.slider.value for row in panel._rows] == [2.7] * 5
    assert page.answers.warm == 1
    (wish,) = page.answers.asked
    assert (wish.design, wish.phi, wish.episodes) == ("3", [2.7] * 5, 128)
    assert not page.viewer.timeline.follow.value
    assert "recorded body" in panel.note.content
    assert "54 %" in panel.result.content  # 2.7 of 5 m, says the oracle


def test_a_slider_moves_the_body_and_then_the_policy_plays_on_it(page: Page, panel: WhatIfPanel) -> None:
    drag(panel, 0, 4.0)
    take = page.take(lambda t: t.shot.phi == (4.0, 2.7, 2.7, 2.7, 2.7) and t.shot.played is not None)
    assert take.frames > 1
    assert take.shot.ghost == (2.7,) * 5
    assert take.shot.ghost_name == "recorded"
    assert take.shot.episode is None
    assert eventually(lambda: panel.found and panel.found.phi["link_1"] == 4.0)
    assert "80 %" in panel.result.content
    assert "54 %" in panel.result.content  # of the recorded body, beside it
    assert "changed by hand" in panel.note.content
    page.show(page.viewer.choice.histories[page.viewer.selected or ""].folder)
    assert "changed by hand" in page.viewer.timeline.what.content


def test_the_body_moves_before_the_policy_has_played(page: Page, panel: WhatIfPanel) -> None:
    page.answers.refusal = "no policy, says the oracle"
    drag(panel, 1, 1.0)
    take = page.take(lambda t: t.shot.phi[1] == 1.0)
    assert take.frames == 1
    assert eventually(lambda: "no policy, says the oracle" in panel.result.content)


def test_the_next_drag_cancels_the_question(page: Page, panel: WhatIfPanel) -> None:
    page.answers.patience = 30.0
    drag(panel, 0, 4.0)
    assert eventually(lambda: len(page.answers.asked) == 2)
    page.answers.patience = 0.0
    drag(panel, 0, 1.0)
    assert eventually(lambda: panel.found and panel.found.phi["link_1"] == 1.0)


def test_what_is_far_outside_a_slider_is_refused(page: Page, panel: WhatIfPanel) -> None:
    for value in (9.0, float("nan")):
        drag(panel, 0, value)
        assert "link_1 must lie inside [0.05, 5] m" in page.viewer.notice.content
        assert panel._rows[0].slider.value == 2.7
    assert len(page.answers.asked) == 1


def test_a_slider_that_was_not_moved_keeps_the_exact_value(panel: WhatIfPanel) -> None:
    panel._recorded = panel._phi = np.array([2.71828, 1.0, 1.0, 1.0, 1.0])
    panel._set(panel._recorded)
    assert panel._rows[0].slider.value == 2.72
    drag(panel, 0, 2.72)
    drag(panel, 1, 2.0)
    assert panel.phi.tolist() == [2.71828, 2.0, 1.0, 1.0, 1.0]


def test_reset_and_close_go_back_to_what_was_recorded(page: Page, panel: WhatIfPanel) -> None:
    drag(panel, 0, 4.0)
    click(panel.reset)
    assert panel.phi.tolist() == [2.7] * 5
    assert panel._rows[0].slider.value == 2.7
    drag(panel, 0, 4.0)
    click(panel.leave)
    assert not panel.open
    assert not panel.sliders.visible
    take = page.take(lambda t: t.shot.played is None and t.shot.episode is not None)
    assert take.shot.phi == (2.7,) * 5


def test_another_iteration_brings_its_design_and_its_policy(page: Page, panel: WhatIfPanel, folder: RunFolder) -> None:
    drag(panel, 0, 4.0)
    page.viewer.timeline.iteration.value = 1
    page.show(folder)
    assert panel.phi.tolist() == [2.9] * 5
    assert eventually(lambda: panel.found and panel.found.iteration == 1)
    page.viewer.timeline.follow.value = True
    page.show(folder)
    assert not panel.open


def test_the_buttons_hand_the_design_on(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    panel = page.viewer.what_if
    assert not panel.inject.visible
    click(panel.begin)
    drag(panel, 0, 4.0)
    page.show(folder, "running")
    phi = [4.0, 2.7, 2.7, 2.7, 2.7]
    assert panel.inject.visible
    click(panel.inject)
    assert page.commands == [(folder.id, InjectDesign(phi))]
    page.viewer.wishes.export_changed(3, phi, _Browser())  # pyright: ignore[reportArgumentType]
    assert (page.exported[-1][1], page.changed) == ("3", [phi])
    click(panel.branch)
    assert page.branched == [(folder.id, 3, phi)]
    page.show(folder, "finished")
    assert not panel.inject.visible


class _Browser:
    """A browser that takes files."""

    def send_file_download(self, name: str, content: bytes, save_immediately: bool) -> None:
        assert name.endswith(".zip")


def test_a_sweep_draws_curves_beside_every_slider(panel: WhatIfPanel) -> None:
    click(panel.sweep)
    assert eventually(lambda: panel.sweep.visible and panel.legend.visible)
    assert all(row.curves.visible and "polyline" in row.curves.content for row in panel._rows)
    assert f"{SWEEP_EPISODES} episodes" in panel.legend.content
    drag(panel, 0, 4.0)  # the curve of link 1 still goes through this body, the others do not
    assert eventually(lambda: 'opacity="0.35"' in panel._rows[1].curves.content)
    assert 'opacity="0.35"' not in panel._rows[0].curves.content


def test_a_drag_or_stop_ends_a_sweep(page: Page, panel: WhatIfPanel) -> None:
    for end in (lambda: drag(panel, 0, 4.0), lambda: click(panel.stop_sweep)):
        page.answers.patience = 0.05
        click(panel.sweep)
        assert eventually(lambda: panel.progress.visible and panel.progress.value > 0)
        page.answers.patience = 30.0
        end()
        assert not panel.progress.visible
        assert panel.sweep.visible
        page.answers.patience = 0.0


def test_the_policy_is_tried_as_somebody_chooses_on_both_bodies(page: Page, panel: WhatIfPanel) -> None:
    drag(panel, 0, 4.0)
    click(panel.sweep)
    assert eventually(lambda: panel.sweep.visible and panel.legend.visible)
    panel.policy.value = "deterministic"
    panel._choose_policy(None)
    assert not panel.legend.visible  # it was drawn of the other policy
    assert not any(row.curves.visible for row in panel._rows)
    assert eventually(lambda: [wish.policy for wish in page.answers.asked].count("deterministic") == 2)
    changed, recorded = page.answers.asked[-2:]
    assert (changed.phi, recorded.phi) == ([4.0, 2.7, 2.7, 2.7, 2.7], None)
    assert eventually(lambda: "deterministic policy" in panel.result.content)
    click(panel.sweep)
    assert eventually(lambda: "deterministic policy, 32 episodes" in panel.legend.content)


def test_a_policy_that_is_none_is_refused(page: Page, panel: WhatIfPanel) -> None:
    panel.policy.value = "lucky"
    panel._choose_policy(None)
    assert "choose from: sampled, deterministic" in page.viewer.notice.content
    assert panel.policy.value == "sampled"


def test_a_hand_has_sliders_in_centimetres_and_degrees(page: Page, tmp_path: Path) -> None:
    folder = make_hand_run(tmp_path / "runs", "pen_press")
    history = page.show(folder)
    panel = page.viewer.what_if
    click(panel.begin)
    units = {row.parameter.name: row.unit.name for row in panel._rows}
    assert units["length_1"] == "cm"
    assert units["placement_1"] == "°"
    index = history.design_space.index("length_1")
    drag(panel, index, 12.0)
    assert panel.phi[index] == pytest.approx(0.12)
    for row, p in zip(panel._rows, history.record.parameters, strict=True):
        assert row.slider.min == pytest.approx(p.hard_lo * row.unit.factor, abs=0.05)
        assert row.slider.max == pytest.approx(p.hard_hi * row.unit.factor, abs=0.05)


def test_a_branch_begins_with_the_body_and_its_bounds_and_locks_give_way(folder: RunFolder) -> None:
    history = History(folder)
    space = history.design_space.with_bound("link_1", 2.0, 3.0).with_lock("link_2", 1.0)
    log = EventLog(folder)
    log.append(DesignSpaceChanged(iteration=2, parameters=list(space.parameters)))
    log.close()
    phi = [4.0, 1.5, 2.0, 2.0, 2.0]
    wish = _branch(History(folder), 3, phi)
    assert wish.branch == Branch(folder.id, 3)
    assert wish.parameters
    first, second, third, *_ = wish.parameters
    assert [p.initial for p in wish.parameters] == phi
    assert (first.lo, first.hi) == (2.0, 4.0)
    assert (second.locked_at, third.locked_at) == (1.5, None)


def test_a_press_on_what_is_not_in_sight_changes_nothing(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    panel = page.viewer.what_if
    asked = len(page.answers.asked)
    for button in (panel.reset, panel.leave, panel.sweep, panel.stop_sweep):
        click(button)
    assert not panel.open
    assert len(page.answers.asked) == asked


def test_there_is_nothing_to_change_without_a_run(page: Page) -> None:
    panel = page.viewer.what_if
    assert not panel.begin.visible
    assert "press Start" in panel.note.content


# --- curves ---


def point(page: Page, history: History, value: float, buildable: bool = True) -> SweepPoint:
    measured = page.answers.measured(history, [value] * 5) if buildable else None
    return SweepPoint(number=1, of=9, parameter="link_1", unit="m", value=value, measured=measured)


def test_curves_have_gaps_where_no_design_can_be_put_together(page: Page, folder: RunFolder) -> None:
    history = History(folder)
    points = [point(page, history, v, v != 2.0) for v in (3.0, 1.0, 2.0, 4.0)]
    scale = Scale(-0.8, -0.2)
    assert scale_of(points) == scale
    drawn = curves_of(points, scale, 2.5, (0.0, 5.0), faded=False)
    assert drawn.count("<polyline") == 4  # success and return, left and right of the gap
    assert drawn.count("<g stroke") == 1
    assert drawn.count('stroke-width="6"') == 2  # the lonely point of either curve is a dot
    assert scale_of(points[2:3]) is None
    assert Scale(1.0, 1.0).share(1.0) == 0.5


# --- the newest job ---


def test_a_newer_job_takes_the_place_of_older_ones() -> None:
    newest, done, began = Newest("test"), [], threading.Event()

    def slow(cancellation: Cancellation) -> None:
        began.set()
        assert eventually(lambda: cancellation.is_set)
        done.append("slow was cancelled")
        raise CancelledError

    newest.put(slow)
    assert began.wait(5)
    newest.put(lambda _: done.append("overtaken"))
    newest.put(lambda _: done.append("newest"))
    assert eventually(lambda: done == ["slow was cancelled", "newest"])
    newest.put(lambda _: 1 / 0)  # pyright: ignore[reportArgumentType]
    newest.put(lambda _: done.append("after a failure"))
    assert eventually(lambda: done[-1] == "after a failure")
    newest.stop()


def test_a_job_waits_until_there_is_no_newer_one_for_a_while() -> None:
    newest, done = Newest("test", rest=0.5), []

    def job(number: int) -> Callable[[Cancellation], None]:
        return lambda _: done.append((number, time.monotonic()))

    for number in range(5):
        time.sleep(0.02)
        last = time.monotonic()
        newest.put(job(number))
    assert eventually(lambda: done)
    assert [number for number, _ in done] == [4]
    assert done[0][1] - last > 0.4
    newest.put(job(9))
    newest.cancel()
    time.sleep(0.6)
    assert len(done) == 1
    newest.stop()
