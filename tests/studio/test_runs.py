"""Runs are prepared whole or not at all, trainers are never doubled, and a death is told with its reason."""

import math
import os
import platform
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import msgspec
import pytest
from conftest import eventually, in_mood, make_run, stand_in

from morph_core.catalogue import make_method, make_task
from morph_core.config import flattened
from morph_core.protocol import Heartbeat, InjectDesign, Lock, Parameter, Pause, SetAlpha, SetBound, StateChanged, Stop
from morph_core.run_folder import EventLog, HeartbeatFile, RunFolder, RunFolderError
from studio.histories import KEPT
from studio.new_run import StartRun, git_state, prepare_run
from studio.runs import Runs
from studio.trainers import spawn_trainer

REACHER = make_task("reacher")
SPACE = REACHER.design_space


def begun(runs: Runs, **wishes: Any) -> str:
    """Start a stand-in and wait until it runs and its heart beats."""
    run_id = runs.start(StartRun(task="reacher", **wishes))
    assert eventually(lambda: runs.status(runs.get(run_id))[0] == "running"), runs.status(runs.get(run_id))
    assert eventually(lambda: runs.get(run_id).heartbeat is not None)
    return run_id


def trainer_of(runs: Runs, run_id: str) -> int:
    beat = runs.get(run_id).heartbeat
    assert beat is not None
    return beat.pid


# --- preparing --------------------------------------------------------------------------------------------------------


def test_a_prepared_run_records_everything(runs_folder: Path) -> None:
    folder = prepare_run(
        runs_folder,
        StartRun(
            task="reacher", method="direct", seed=7, iterations=5, settings={"step": 2},
            task_options={"tunnel": "paper"},
        ),
    )  # fmt: skip
    record = folder.record()
    assert (record.task, record.method, record.seed, record.iterations) == ("reacher", "direct", 7, 5)
    assert record.config["step"] == 2.0
    assert flattened(record.config)["ppo.gamma"] == make_method("direct", REACHER).ppo.gamma
    assert record.format == 2
    assert record.task_options == {"tunnel": "paper"}
    assert record.parameters == list(SPACE.parameters)
    assert {"python", "numpy", "torch", "mujoco", "cma", "viser"} <= set(record.versions)
    assert (record.git_revision, record.git_dirty) == git_state()


def test_runs_of_the_same_second_get_names_of_their_own(runs_folder: Path) -> None:
    names = [prepare_run(runs_folder, StartRun(task="reacher")).id for _ in range(5)]
    assert len(set(names)) == 5
    assert any(name.endswith("-2") for name in names)


@pytest.mark.parametrize(
    ("wish", "sentence"),
    [
        ({"task": "reach"}, "choose from: .*reacher"),
        ({"method": "magic"}, "choose from: morph, cmaes_rl, direct, no_hw_opt, transform2act, value_gradient"),
        ({"settings": {"alfa": 1}}, "choose from: .*alpha"),
        ({"settings": {"alpha": math.nan}}, "alpha must be finite"),
        ({"settings": {"ppo.gamma": 1.5}}, r"ppo.gamma must lie in \(0, 1\]"),
        ({"settings": {"alpha": 10**400}}, r"alpha must lie in \[0, 1000000\], not more"),
        ({"settings": {"alpha": [1]}}, "alpha must be a number"),
        ({"settings": {"projection": "sideways"}}, "choose from: none, one_sided, as_printed"),
        ({"task_options": {"colour": "red"}}, "choose from: tunnel"),
        ({"task_options": {"tunnel": "straight"}}, "choose from: zigzag, paper"),
        ({"task_options": {"tunnel": ["zigzag"]}}, "choose from: zigzag, paper"),
        ({"seed": -1}, "seed must be a whole number"),
        ({"seed": True}, "seed must be a whole number"),
        ({"iterations": 0}, "iterations must be a whole number"),
        ({"iterations": 10**9}, "iterations must be a whole number"),
    ],
)
def test_a_bad_wish_is_refused_in_words_and_leaves_nothing(
    runs_folder: Path, wish: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        prepare_run(runs_folder, StartRun(**{"task": "reacher", **wish}))
    assert not runs_folder.exists()


def test_bounds_locks_and_initial_values_can_be_chosen_inside_the_hard_box(runs_folder: Path) -> None:
    chosen = msgspec.structs.replace(SPACE.parameters[1], lo=1.0, hi=2.0, initial=1.5, locked_at=1.2)
    record = prepare_run(runs_folder, StartRun(task="reacher", parameters=[chosen])).record()
    assert record.parameters[1] == chosen
    assert record.parameters[0] == SPACE.parameters[0]


@pytest.mark.parametrize(
    "change", [{"name": "link_9"}, {"hi": 6.0}, {"lo": 4.0, "hi": 3.0}, {"initial": 7.0}, {"locked_at": math.inf}]
)
def test_parameters_outside_the_task_are_refused(runs_folder: Path, change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="link_"):
        prepare_run(
            runs_folder,
            StartRun(task="reacher", parameters=[msgspec.structs.replace(SPACE.parameters[0], **change)]),
        )


def test_a_widened_hard_box_does_not_reach_the_record(runs_folder: Path) -> None:
    wider = Parameter("link_1", "m", lo=1.0, hi=2.0, initial=1.5, hard_lo=-100.0, hard_hi=100.0)
    assert prepare_run(runs_folder, StartRun(task="reacher", parameters=[wider])).record().parameters[0].hard_hi == 5.0


# --- trainers ---------------------------------------------------------------------------------------------------------


def test_a_started_run_is_shown_obeys_and_stops(runs_folder: Path) -> None:
    runs = Runs(runs_folder, stand_in)
    run_id = begun(runs)
    assert runs.shown == run_id
    runs.send(run_id, Pause())
    assert eventually(lambda: runs.status(runs.get(run_id))[0] == "paused")
    runs.send(run_id, Stop())
    assert eventually(lambda: runs.status(runs.get(run_id))[0] == "stopped")
    assert eventually(lambda: not runs.get(run_id).pulse.is_alive)


def test_a_run_is_starting_until_its_trainer_speaks(runs_folder: Path) -> None:
    runs = Runs(runs_folder, stand_in)
    run_id = runs.start(StartRun(task="reacher"))
    assert runs.summary(run_id).status == "starting"


def test_a_second_trainer_is_never_started(runs_folder: Path) -> None:
    runs = Runs(runs_folder, stand_in)
    run_id = begun(runs)
    with pytest.raises(ValueError, match="has a trainer already"):
        runs.resume(run_id)
    with pytest.raises(ValueError, match="has a trainer already"):
        Runs(runs_folder, stand_in).resume(run_id)


def test_a_trainer_is_adopted_after_a_restart_of_the_server(runs_folder: Path) -> None:
    run_id = begun(Runs(runs_folder, stand_in))
    after = Runs(runs_folder, stand_in)
    assert after.summary(run_id).status == "running"
    assert after.send(run_id, Pause()) == 1
    assert eventually(lambda: after.status(after.get(run_id))[0] == "paused")


def test_a_stillborn_trainer_is_told_with_the_last_line_of_its_log(runs_folder: Path) -> None:
    runs = Runs(runs_folder, in_mood("stillborn"))
    run_id = runs.start(StartRun(task="reacher"))
    assert eventually(lambda: runs.summary(run_id).status == "failed")
    assert runs.summary(run_id).reason == "ImportError: no module named torch, says the stand-in"


def test_a_trainer_that_dies_at_work_is_told_at_once(runs_folder: Path) -> None:
    runs = Runs(runs_folder, in_mood("dying"))
    run_id = runs.start(StartRun(task="reacher"))
    assert eventually(lambda: runs.summary(run_id).status == "failed")
    assert "loss is NaN" in runs.summary(run_id).reason


def test_a_killed_trainer_is_told_with_its_signal_and_can_be_resumed(runs_folder: Path) -> None:
    runs = Runs(runs_folder, stand_in)
    run_id = begun(runs)
    os.kill(trainer_of(runs, run_id), signal.SIGKILL)
    assert eventually(lambda: runs.summary(run_id).status == "failed", 5)
    assert "SIGKILL" in runs.summary(run_id).reason
    runs.send(run_id, SetAlpha(2.0))  # what it is to hold when it is resumed
    assert [order.command for _, order in RunFolder(runs_folder / run_id).pending() if order] == [SetAlpha(2.0)]
    with pytest.raises(ValueError, match="is failed: resume it"):
        runs.send(run_id, Pause())
    runs.resume(run_id)
    assert runs.summary(run_id).status in ("starting", "running"), "the earlier death is no news of this trainer"
    assert eventually(lambda: runs.summary(run_id).status == "running")


def test_a_lost_run_takes_other_edits_too(runs_folder: Path) -> None:
    folder = make_run(runs_folder, "20260101-a", ended="running")
    HeartbeatFile(folder).write(Heartbeat(platform.node(), 2**22 + 1, 0.0, 0.0, "running", "learning", 3, 100))
    runs = Runs(runs_folder, stand_in)
    assert runs.summary(folder.id).status == "lost"
    runs.send(folder.id, SetAlpha(2.0))
    with pytest.raises(ValueError, match="is lost: resume it"):
        runs.send(folder.id, Pause())
    with pytest.raises(ValueError, match="is lost: no trainer is at work on it"):
        runs.send(folder.id, Stop())
    assert [order.command for _, order in folder.pending() if order] == [SetAlpha(2.0)]


def test_the_death_of_an_adopted_trainer_is_told_too(runs_folder: Path) -> None:
    first = Runs(runs_folder, stand_in)
    run_id = begun(first)
    after = Runs(runs_folder, stand_in)
    assert after.summary(run_id).status == "running"
    os.kill(trainer_of(after, run_id), signal.SIGKILL)
    first.get(run_id)  # reaps it, as init would
    assert eventually(lambda: after.summary(run_id).status == "failed", 5)
    assert "the trainer died" in after.summary(run_id).reason


def test_a_verdict_ends_when_another_trainer_speaks(runs_folder: Path) -> None:
    runs = Runs(runs_folder, stand_in)
    run_id = begun(runs)
    os.kill(trainer_of(runs, run_id), signal.SIGKILL)
    assert eventually(lambda: runs.summary(run_id).status == "failed")
    elsewhere = stand_in(RunFolder(runs_folder / run_id))
    assert eventually(lambda: runs.summary(run_id).status == "running")
    elsewhere.kill()
    elsewhere.wait()


def test_a_trainer_refused_by_the_lock_says_nothing_about_the_run(runs_folder: Path) -> None:
    runs = Runs(runs_folder, stand_in)
    run_id = begun(runs)
    other = Runs(runs_folder, stand_in)
    other._crew.launch(RunFolder(runs_folder / run_id))  # as a second server would, a moment before the first beat
    assert eventually(lambda: run_id not in other._inquest.children or not other.get(run_id))
    assert eventually(lambda: other.summary(run_id).status == "running")
    assert other.summary(run_id).reason == ""


def test_a_finished_run_goes_on_only_by_a_number(runs_folder: Path) -> None:
    make_run(runs_folder, "done", ended="finished")
    runs = Runs(runs_folder, stand_in)
    with pytest.raises(ValueError, match="how many iterations"):
        runs.resume("done")
    with pytest.raises(ValueError, match="further must be"):
        runs.resume("done", 0)
    runs.resume("done", 5)
    assert runs.summary("done").status in ("starting", "running")


def test_the_real_trainer_gets_no_token_and_one_thread(runs_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, object] = {}
    monkeypatch.setenv("MORPH_TOKEN", "hush")
    monkeypatch.setattr(subprocess, "Popen", lambda command, **options: seen.update(options, command=command))
    folder = make_run(runs_folder, "run")
    spawn_trainer(folder, further=3)
    environment, command = seen["env"], seen["command"]
    assert isinstance(environment, dict)
    assert isinstance(command, list)
    assert "MORPH_TOKEN" not in environment
    assert environment["OMP_NUM_THREADS"] == environment["MKL_NUM_THREADS"] == "1"
    assert seen["start_new_session"] is True
    assert command[1:] == ["-P", "-m", "morph_core.train", "--run", str(folder.path.resolve()), "--further", "3"]


# --- reading ----------------------------------------------------------------------------------------------------------


def test_runs_are_listed_newest_first_with_how_they_ended(runs_folder: Path) -> None:
    make_run(runs_folder, "20260101-a", ended="stopped")
    make_run(runs_folder, "20260102-b", ended="failed")
    lines = Runs(runs_folder).summaries()
    assert [line.id for line in lines] == ["20260102-b", "20260101-a"]
    assert [line.status for line in lines] == ["failed", "stopped"]
    assert lines[0].reason == "as asked"
    assert (lines[0].iteration, lines[0].iterations, lines[0].success) == (3, 100, 0.5)


def test_the_short_line_of_an_ended_run_says_what_its_whole_history_says(runs_folder: Path) -> None:
    make_run(runs_folder, "run")
    runs = Runs(runs_folder)
    short = runs.summary("run")
    runs.get("run")
    assert runs.summary("run") == short


def test_an_ended_run_that_goes_on_is_seen(runs_folder: Path) -> None:
    folder = make_run(runs_folder, "run")
    runs = Runs(runs_folder)
    assert runs.summary("run").status == "stopped"
    EventLog(folder).append(StateChanged(status="finished", iteration=9))
    assert runs.summary("run").status == "finished"
    assert runs.summary("run").iteration == 9


def test_hundreds_of_runs_are_listed_quickly_and_not_kept(runs_folder: Path) -> None:
    for i in range(60):
        make_run(runs_folder, f"run-{i:03d}")
    runs = Runs(runs_folder)
    for name in runs.ids():
        runs.get(name)
    assert len(runs._histories) <= KEPT
    runs.summaries()
    begin = time.process_time()
    assert len(runs.summaries()) == 60
    assert time.process_time() - begin < 0.5


@pytest.mark.parametrize(
    "damage", ["no run.json", "no json", "other format", "bad parameter", "folder for a file", "binary"]
)
def test_a_damaged_run_is_listed_as_unreadable_and_breaks_nothing(runs_folder: Path, damage: str) -> None:
    make_run(runs_folder, "good")
    bad = make_run(runs_folder, "odd").path / "run.json"
    text = bad.read_text()
    if damage == "no run.json":
        bad.unlink()
    elif damage == "folder for a file":
        bad.unlink()
        bad.mkdir()
    elif damage == "binary":
        bad.write_bytes(b"\xff\xfe\x00")
    else:
        bad.write_text({
            "no json": text[:40],
            "other format": '{"kind": "somebody else\'s run"}',
            "bad parameter": text.replace('"lo": 0.05', '"lo": 99'),
        }[damage])  # fmt: skip
    runs = Runs(runs_folder)
    for _ in range(2):
        lines = {line.id: line for line in runs.summaries()}
        assert lines["good"].status == "stopped"
        assert lines["odd"].status == "unreadable"
        assert len(lines["odd"].reason) > 20
    with pytest.raises(RunFolderError):
        runs.get("odd")
    assert list(runs.watched()) == ["good"]


def test_a_copied_run_goes_by_the_name_of_its_folder(runs_folder: Path) -> None:
    make_run(runs_folder, "run").path.rename(runs_folder / "my-best-one")
    assert [line.id for line in Runs(runs_folder).summaries()] == ["my-best-one"]
    assert Runs(runs_folder).get("my-best-one").iteration == 3


def test_a_repaired_run_is_readable_again(runs_folder: Path) -> None:
    record = make_run(runs_folder, "run").path / "run.json"
    text = record.read_text()
    record.write_text("torn")
    runs = Runs(runs_folder)
    assert runs.summary("run").status == "unreadable"
    record.write_text(text)
    os.utime(record, (1, 1))
    assert runs.summary("run").status == "stopped"


@pytest.mark.parametrize("name", ["", ".", "..", "../x", "a/b", "a\\b", "/etc", "x" * 200, "con\x00", ".hidden", "‮x"])
def test_no_name_leads_out_of_the_folder(runs_folder: Path, name: str) -> None:
    make_run(runs_folder.parent / "runs-evil", "x")
    make_run(runs_folder, "run")
    with pytest.raises(RunFolderError):
        Runs(runs_folder).get(name)


# --- commands ---------------------------------------------------------------------------------------------------------


def test_a_run_of_a_hand_whose_fingers_stand_in_each_other_is_not_started(runs_folder: Path) -> None:
    hand = make_task("pen_press")
    phi = [math.pi / 2, *[0.0] * 3, *[0.2] * 4]
    moved = [msgspec.structs.replace(p, initial=v) for p, v in zip(hand.design_space.parameters, phi, strict=True)]
    with pytest.raises(ValueError, match="fingers 1 and 2 stand 0 mm apart"):
        Runs(runs_folder, stand_in).start(StartRun(task="pen_press", parameters=moved))
    assert not list(runs_folder.glob("*"))


def test_a_refused_command_never_reaches_the_inbox(runs_folder: Path) -> None:
    runs = Runs(runs_folder, stand_in)
    run_id = begun(runs)
    for command in (SetAlpha(math.nan), SetBound("link_1", 3, 2), Lock("arm"), InjectDesign([9.0] * 5)):
        with pytest.raises(ValueError, match=r"\w"):
            runs.send(run_id, command)
    assert runs.send(run_id, Pause()) == 1


def test_a_run_that_has_ended_takes_no_commands(runs_folder: Path) -> None:
    make_run(runs_folder, "run")
    with pytest.raises(ValueError, match="is stopped: resume it"):
        Runs(runs_folder).send("run", Pause())
