"""Steering by the panels: the buttons of a run, alpha and projection, bounds and locks, and their answers."""

import math
import platform
import time
from pathlib import Path

import msgspec
import psutil
import pytest
from conftest import NAME, Page, append, make_run, progress

from morph_core.history import History
from morph_core.protocol import (
    Acknowledged,
    DesignSpaceChanged,
    Heartbeat,
    Lock,
    Pause,
    Progress,
    Resume,
    SetAlpha,
    SetBound,
    SetProjection,
    StateChanged,
    Status,
    StepIteration,
    Stop,
    Unlock,
)
from morph_core.run_folder import EventLog, HeartbeatFile, RunFolder
from studio.new_run import StartRun, prepare_run
from studio.viewer.pending import Pending


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_run(tmp_path / "runs", NAME, ended="finished")


def test_buttons_follow_the_status(page: Page, folder: RunFolder) -> None:
    run = page.viewer.run
    for status, pause, resume, more in (
        ("running", True, False, True),
        ("paused", False, True, True),
        ("pausing", True, True, True),
        ("finished", False, False, False),
        ("failed", False, True, False),
        ("lost", False, True, False),
        ("stopped", False, True, False),
        ("queued", False, False, True),  # Stop takes it out of the queue
    ):
        page.show(folder, status)  # pyright: ignore[reportArgumentType]
        assert (run.pause.visible, run.resume.visible, run.more.visible) == (pause, resume, more), status


@pytest.mark.parametrize("status", ["failed", "lost", "stopped", "finished"])
def test_a_run_that_can_not_go_on_takes_other_edits_and_says_when_they_hold(
    page: Page, folder: RunFolder, status: Status
) -> None:
    page.show(folder, status)
    steer, design = page.viewer.steer, page.viewer.design
    takes = status in ("failed", "lost")
    assert steer.form.visible == takes
    assert [button.visible for button in design._buttons] == [takes, takes]
    for note in (steer.note, design.note):
        assert ("obeyed when the run is resumed" in note.content) == takes
        assert ("branch from it" in note.content) != takes
    steer.alpha.value = 2.0
    page.viewer.wishes.send(steer.commands, None)
    page.show(folder, status)
    assert ("waits: obeyed once the run is resumed" in page.viewer.run.log.content) == takes


def test_another_kind_of_processor_is_said_on_the_panel(page: Page, folder: RunFolder) -> None:
    log = EventLog(folder)
    for model in ("EPYC", "<Xeon>"):
        assert "begun on" not in page.viewer.run.state.content
        log.append(StateChanged(status="starting", iteration=3, processor=model, instruction_set="AVX2"))
        page.show(folder, "running")
    assert "begun on EPYC, AVX2, went on from iteration 3 on &lt;Xeon&gt;, AVX2" in page.viewer.run.state.content


def test_a_run_with_a_budget_shows_how_much_of_it_is_spent(page: Page, tmp_path: Path) -> None:
    folder = prepare_run(tmp_path, StartRun(task="reacher", iterations=9000, env_steps=800_000))
    page.show(folder, "queued")
    assert "iteration <b>0</b></div>" in page.viewer.run.state.content, "nobody knows yet of how many"
    me = psutil.Process()
    HeartbeatFile(folder).write(
        Heartbeat(platform.node(), me.pid, me.create_time(), time.time(), "running", "learning", 3, 12)
    )
    log = EventLog(folder)
    log.append(StateChanged(status="running", iteration=0))
    log.append(
        Progress(
            iteration=3, env_steps=200_000, phi=[1.0] * 5, episode_return=0, success=0, policy_std=1,
            relabelled_steps=1024, search_steps=2048,
        )
    )  # fmt: skip
    page.show(folder, "running")
    assert "iteration <b>3</b> of about 12" in page.viewer.run.state.content
    assert page.viewer.run.bar.value == 25.0
    for shown in ("200.0 k of 800.0 k", "steps for relabelling", "1.0 k", "steps for the search", "2.0 k"):
        assert shown in page.viewer.run.numbers.content
    page.show(folder, "finished")
    assert "about" not in page.viewer.run.state.content


def test_resume_orders_a_waiting_trainer_and_restarts_a_gone_one(page: Page, folder: RunFolder) -> None:
    page.show(folder, "paused")
    page.viewer.run.go_on(None)
    assert page.commands == [(NAME, Resume())]
    for status in ("stopped", "failed", "lost"):
        page.show(folder, status)  # pyright: ignore[reportArgumentType]
        page.viewer.run.go_on(None)
    assert page.resumed == [NAME] * 3
    assert len(page.commands) == 1


def test_step_stop_and_hotkeys_send_their_commands(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    page.viewer.run.ask("Step", None)
    page.viewer.run.ask("Stop", None)
    page.viewer.run.ask("<no such button>", None)
    page.viewer.run.toggle(None)
    assert [command for _, command in page.commands] == [StepIteration(), Stop(), Pause()]
    hotkeys = {command.hotkey for command in page.server.gui._command_handle_from_uuid.values()}
    assert {"P", "K", "L", "space"} <= hotkeys


def test_steering_sends_only_what_was_changed(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    steer = page.viewer.steer
    steer.form.submit()
    assert page.commands == []
    steer.alpha.value = 2.0
    steer.form.submit()
    steer.alpha.value = 1.0
    steer.projection.value = "one_sided"
    steer.form.submit()
    assert [c for _, c in page.commands] == [SetAlpha(2.0), SetProjection("one_sided")]


@pytest.mark.parametrize(
    ("name", "value"), [("alpha", math.nan), ("alpha", math.inf), ("alpha", -0.1), ("projection", "sideways")]
)
def test_bad_steering_values_send_nothing(page: Page, folder: RunFolder, name: str, value: object) -> None:
    page.show(folder, "running")
    getattr(page.viewer.steer, name)._impl.value = value
    page.viewer.steer.form.submit()
    assert page.commands == []
    assert name in page.viewer.notice.content


def test_alpha_that_was_accepted_is_in_force_before_the_next_iteration(page: Page, folder: RunFolder) -> None:
    page.show(folder, "paused")
    append(folder, Acknowledged(id=1, iteration=3, accepted=True, command=SetAlpha(4.0)))
    page.show(folder, "paused")
    assert page.viewer.steer.alpha.value == 4.0


def test_what_somebody_types_into_the_steering_form_stays_until_that_value_changes(
    page: Page, folder: RunFolder
) -> None:
    page.show(folder, "paused")
    page.viewer.steer.alpha.value = 7.0
    page.show(folder, "paused")
    assert page.viewer.steer.alpha.value == 7.0
    append(folder, Acknowledged(id=1, iteration=3, accepted=True, command=SetProjection("one_sided")))
    page.show(folder, "paused")
    assert (page.viewer.steer.alpha.value, page.viewer.steer.projection.value) == (7.0, "one_sided")
    append(folder, Acknowledged(id=2, iteration=3, accepted=True, command=SetAlpha(2.0)))
    page.show(folder, "paused")
    assert page.viewer.steer.alpha.value == 2.0


def test_the_design_form_sends_bounds_and_locks_together(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    rows = page.viewer.design.rows
    rows["link_2"].bounds.value = (0.5, 3.0)
    rows["link_3"].locked.value = True
    rows["link_3"].value.value = 1.5
    _submit_design(page)
    assert [c for _, c in page.commands] == [SetBound("link_2", 0.5, 3.0), Lock("link_3", 1.5)]


def test_a_lock_is_shown_and_undone(page: Page, folder: RunFolder) -> None:
    history = page.show(folder, "running")
    space = history.design_space.with_lock("link_3", 1.5)
    append(folder, DesignSpaceChanged(iteration=3, parameters=list(space.parameters)))
    page.show(folder, "running")
    row = page.viewer.design.rows["link_3"]
    assert row.locked.value
    assert row.value.value == 1.5
    assert "locked" in str(page.viewer.design.groups[2].folder.label)
    row.locked.value = False
    _submit_design(page)
    assert page.commands == [(NAME, Unlock("link_3"))]


@pytest.mark.parametrize(
    ("bounds", "lock", "sentence"),
    [
        ((3.0, 2.0), None, "lower bound of link_1 must be below the upper one"),
        ((math.nan, 2.0), None, "bounds of link_1 must be finite"),
        ((0.5, math.inf), None, "bounds of link_1 must be finite"),
        ((0.0, 9.0), None, "must lie inside [0.05, 5] m"),
        (None, 9.0, "link_1 must lie inside"),
        (None, math.nan, "link_1 must be finite"),
    ],
)
def test_bad_design_values_send_nothing_not_even_the_good_ones(
    page: Page, folder: RunFolder, bounds: tuple[float, float] | None, lock: float | None, sentence: str
) -> None:
    page.show(folder, "running")
    rows = page.viewer.design.rows
    rows["link_2"].bounds.value = (0.5, 3.0)
    if bounds is not None:
        rows["link_1"].bounds._impl.value = bounds
    if lock is not None:
        rows["link_1"].locked.value = True
        rows["link_1"].value._impl.value = lock
    _submit_design(page)
    assert page.commands == []
    assert sentence in page.viewer.notice.content


def test_what_somebody_edits_survives_the_next_update(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    page.viewer.design.rows["link_2"].bounds.value = (0.5, 3.0)
    append(folder, progress(4))
    page.show(folder, "running")
    assert page.viewer.design.rows["link_2"].bounds.value == (0.5, 3.0)
    assert str(page.viewer.design.groups[1].folder.label).startswith("link_2: 2.000 m")


def test_a_refused_command_is_told_and_changes_nothing(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    page.refusal = "the inbox is full"
    page.viewer.run.toggle(None)
    assert "the inbox is full" in page.viewer.notice.content
    assert "asked" not in page.viewer.run.log.content


def test_each_command_is_acknowledged_with_its_iteration(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    page.viewer.design.rows["link_2"].bounds.value = (0.5, 3.0)
    _submit_design(page)
    assert "bound of link_2 set to [0.5, 3] m: asked" in page.viewer.run.log.content
    append(
        folder,
        Acknowledged(id=1, iteration=42, accepted=True, command=SetBound("link_2", 0.5, 3.0)),
        Acknowledged(id=2, iteration=42, accepted=False, command=Lock("link_9"), message="unknown <b>link_9"),
    )
    page.show(folder, "running")
    log = page.viewer.run.log.content
    assert "bound of link_2 set to [0.5, 3] m, in force from iteration 43" in log
    assert "refused: unknown &lt;b&gt;link_9" in log
    assert "asked" not in log


def test_each_answer_is_that_to_one_command_before_it(folder: RunFolder) -> None:
    answers = [Acknowledged(id=i, iteration=3, accepted=True, command=Pause()) for i in (1, 2)]
    pending = Pending()
    for answered in (1, 1, 2):  # another browser's was answered before, and the last one is asked later
        pending.add(folder.id, Pause(), answered)
    append(folder, *answers)
    pending.settle({folder.id: History(folder)})
    assert pending.of(folder.id) == [Pause(), Pause()]
    append(folder, msgspec.structs.replace(answers[0], id=3))
    pending.settle({folder.id: History(folder)})
    assert pending.of(folder.id) == [Pause()]


def _submit_design(page: Page) -> None:
    form = page.viewer.design._form
    assert form is not None
    form.submit()
