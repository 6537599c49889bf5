"""Impatient people: a double click has one effect, and what was meant for one run never reaches another."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from conftest import NAME, Page, append, eventually, make_hand_run, make_run

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.protocol import (
    Acknowledged,
    DesignSpaceChanged,
    Lock,
    Pause,
    Resume,
    SetAlpha,
    SetBound,
    SetProjection,
    Status,
    StepIteration,
)
from morph_core.run_folder import RunFolder
from studio.export.bundle import Bundle
from studio.export.verify import Check
from studio.viewer import once as once_module
from studio.viewer.once import once


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_run(tmp_path / "runs", NAME, ended="finished")


def click(button: object, times: int = 2) -> None:
    """Press a button several times at once, each time in a thread of its own as viser does."""
    with ThreadPoolExecutor(times) as crowd:
        for heard in button._impl.update_cb:  # pyright: ignore[reportAttributeAccessIssue]
            for _ in range(times):
                crowd.submit(heard, Press())


class Press:
    client = None
    client_id = None


def test_a_press_is_done_once_however_long_it_takes_and_again_later(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(once_module.time, "monotonic", lambda: now[0])
    done: list[str] = []
    at_work, go_on = threading.Event(), threading.Event()

    def act(word: str) -> None:
        done.append(word)
        at_work.set()
        go_on.wait(10)

    press = once(act)
    first = threading.Thread(target=press, args=("first",))
    first.start()
    at_work.wait(10)
    now[0] += 60
    press("while it is being done")
    assert first.is_alive(), "nobody waits for it"
    go_on.set()
    first.join(10)
    press("right after that")
    now[0] += once_module.AGAIN
    press("later")
    assert done == ["first", "later"]


def test_a_press_that_was_refused_can_be_repeated_at_once() -> None:
    def refuse(_: object) -> None:
        raise ZeroDivisionError

    press = once(refuse)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            press(None)


@pytest.mark.parametrize("way", ["start", "live", "branch", "export", "resume"])
def test_a_double_click_begins_one_run_one_branch_one_export(page: Page, folder: RunFolder, way: str) -> None:
    viewer = page.viewer
    if way == "resume":
        page.show(folder, "stopped")
        click(viewer.run.resume)
        assert page.resumed == [NAME]
        return
    if way in ("branch", "export"):
        page.show(folder)
        viewer.what_if.start()
        if way == "branch":
            click(viewer.what_if.branch)
            assert len(page.branched) == 1
            click(viewer.what_if.branch)
            assert len(page.branched) == 1, "the panel is shut by then"
        else:
            click(viewer.export.check)
            assert eventually(lambda: viewer.export.download.visible)
            assert len(page.exported) == 1
        return
    viewer.show({}, {}, None)
    if way == "start":
        click(viewer.start.start)
    else:
        with ThreadPoolExecutor(2) as crowd:
            for _ in range(2):
                crowd.submit(viewer.beginning.begin_live, None)
    assert len(page.started) == 1


def test_a_double_click_sends_a_command_once_but_every_step_counts(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    run = page.viewer.run
    for word in ("Stop", "Stop", "Step", "Step", "Checkpoint", "Stop"):
        run.ask(word, None)
    assert [type(command).__name__ for _, command in page.commands] == [
        "Stop", "StepIteration", "StepIteration", "Checkpoint", "Stop"
    ]  # fmt: skip
    page.commands.clear()
    for command in (Pause(), Resume(), Pause()):  # wanted each, however quickly
        page.viewer.wishes.send(lambda command=command: [command], None)
    assert [command for _, command in page.commands] == [Pause(), Resume(), Pause()]
    page.viewer.wishes._last = page.viewer.wishes._last[0], time.monotonic() - 1
    page.viewer.wishes.send(lambda: [Pause()], None)
    assert len(page.commands) == 4, "later it is no double click"
    for _ in range(2):
        page.viewer.wishes.send(lambda: [StepIteration()], None)
    assert len(page.commands) == 6


def test_what_others_change_leaves_what_somebody_types_beside_it(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    steer, design = page.viewer.steer, page.viewer.design
    steer.alpha.value = 2.5
    design.rows["link_1"].bounds.value = (0.5, 4.0)
    design.rows["link_2"].locked.value, design.rows["link_2"].value.value = True, 1.5
    space = make_task("reacher").design_space.with_lock("link_1", 2.0).with_bound("link_2", 1.0, 4.0)
    append(
        folder,
        Acknowledged(id=1, iteration=3, accepted=True, command=SetProjection("one_sided")),
        DesignSpaceChanged(iteration=3, parameters=list(space.parameters)),
    )
    page.show(folder, "running")
    assert (steer.projection.value, steer.commands()) == ("one_sided", [SetAlpha(2.5)])
    assert (design.rows["link_1"].locked.value, design.rows["link_2"].bounds.value) == (True, (1.0, 4.0))
    assert design.commands() == [SetBound("link_1", 0.5, 4.0), Lock("link_2", 1.5)]


def test_what_was_typed_for_one_run_is_not_applied_to_another(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    steer, design = page.viewer.steer, page.viewer.design
    steer.alpha.value, steer.projection.value = 2.5, "as_printed"
    design.rows["link_1"].bounds.value, design.rows["link_2"].locked.value = (0.5, 4.0), True
    page.show(make_run(folder.path.parent, f"{NAME}-2", ended=None), "running")
    assert (steer.commands(), design.commands()) == ([], [])


@pytest.mark.parametrize("meanwhile", ["run", "design"])
def test_a_bundle_of_what_was_chosen_before_is_not_offered(
    page: Page, folder: RunFolder, monkeypatch: pytest.MonkeyPatch, meanwhile: str
) -> None:
    other = make_run(folder.path.parent, f"{NAME}-2", ended="finished")
    page.show(folder)
    panel = page.viewer.export
    turn: dict[str, Callable[[], object]] = {
        "run": lambda: page.show(other),
        "design": lambda: setattr(panel.design, "value", "latest"),
    }

    def build(*_: object) -> Bundle:
        assert "building" in panel.notice.content
        turn[meanwhile]()
        return Bundle("design.zip", {}, [Check("masses", 0.0, 0.0)], b"zip")

    monkeypatch.setattr(panel, "_on_export", build)
    panel.submit()
    assert (panel._bundle, panel.download.visible, panel.result.visible, panel.notice.visible) == (None, *[False] * 3)
    assert not panel.check.disabled


def test_the_timeline_names_the_body_that_is_seen(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    page.viewer.what_if.start()
    page.viewer.refresh()
    assert "the recorded body, with the policy of iteration 3" in page.viewer.timeline.what.content
    page.viewer.what_if._rows[0].slider.value = 1.0
    page.viewer.what_if._drag(0, None)
    page.viewer.refresh()
    assert "a body changed by hand, with the policy of iteration 3" in page.viewer.timeline.what.content
    page.viewer.what_if.close()
    page.viewer.refresh()
    assert "design of iteration 3" in page.viewer.timeline.what.content


def test_switching_among_runs_leaves_nothing_behind(page: Page, folder: RunFolder) -> None:
    """Of two tasks, with the what-if panel opened: the server holds as many inputs as after the first rounds."""
    runs = [folder, make_hand_run(folder.path.parent, "pen_press")]
    histories = {run.id: History(run) for run in runs}
    statuses: dict[str, tuple[Status, str]] = {name: (one.status, "") for name, one in histories.items()}
    viewer, gui = page.viewer, page.server.gui
    viewer.show(histories, statuses)
    held = []
    for _ in range(3):
        for run in runs:
            viewer.open(run.id, 1)
            viewer.what_if.start()
            viewer.open(None)
            viewer.start.task.value = histories[run.id].record.task
        held.append((len(gui._gui_input_handle_from_uuid), len(gui._container_handle_from_uuid)))
    assert held[-1] == held[1]
