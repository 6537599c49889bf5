"""`morph-studio study`: what it shows, how it ends, and that no kill changes what a study finds."""

import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from conftest import eventually
from msgspec import structs
from rich.console import Console
from test_study_local import make_study, spawner

from morph_core.history import History
from morph_core.protocol import Acknowledged, AnyEvent, Checkpoint, Evaluation, Progress, StateChanged, Status, encode
from morph_core.run_folder import RunFolder, process_alive
from studio.cli import run
from studio.cli.study import _Bars, _counts, _Lines, table_of
from studio.cli.terminal import Screen
from studio.study import launchers
from studio.study.local import Local, read_launch
from studio.study.plan import Study, read_study
from studio.study.report.results import read_results
from studio.study.standing import RunStanding, Standings, Work, by_variant, seconds_left, share_done, work_of

ROOT = Path(__file__).parents[2]
WORDS = ["reacher", "--methods", "plain:no_hw_opt,trajectories=8", "--seeds", "0-1", "--env-steps", "1000"]


def wrote(directory: Path, run_name: str, success: Sequence[float], final: float | None = None) -> None:
    """Let a run have an evaluation after each iteration of 400 environment steps, 2 CPU seconds and 3 s by the wall."""
    events: list[AnyEvent] = [StateChanged(status="starting", iteration=0, time=100.0)]
    for i, share in enumerate(success, start=1):
        at = {"iteration": i, "env_steps": 400 * i, "phi": [1.0] * 5, "cpu_seconds": 2.0 * i, "time": 100 + 3.0 * i}
        events.append(Progress(episode_return=0, success=0, policy_std=1, relabelled_steps=7, search_steps=9, **at))
        events.append(evaluation(share, **at))
    if final is not None:
        events.append(evaluation(final, final=True, episodes=256, **at))
        events.append(StateChanged(status="finished", iteration=len(success), time=at["time"]))
    lines = (encode(structs.replace(event, seq=seq)) + b"\n" for seq, event in enumerate(events, start=1))
    RunFolder(directory / run_name).events.write_bytes(b"".join(lines))


def acknowledged(iteration: int, time: float) -> Acknowledged:
    return Acknowledged(id=1, iteration=iteration, accepted=True, command=Checkpoint(), message="", time=time)


def evaluation(share: float, **at: object) -> Evaluation:
    rates = {"sampled_success": share, "deterministic_success": share / 2}
    return Evaluation(sampled_return=0, deterministic_return=0, **rates, **at)  # pyright: ignore


def standings(directory: Path, study: Study, launcher: Local | None = None) -> list[RunStanding]:
    names = [planned.run for planned in study.runs]
    return Standings(directory, study).read((launcher or Local(1)).states(directory, names))


def test_a_line_says_how_many_seeds_solved_it_after_what_and_what_success_was_at_the_end(tmp_path: Path) -> None:
    study = make_study(tmp_path / "study", 4)
    names = [planned.run for planned in study.runs]
    wrote(tmp_path / "study", names[0], [0.5, 0.97, 1.0], 0.9)
    wrote(tmp_path / "study", names[1], [0.96, 0.5, 0.5], 0.5)
    wrote(tmp_path / "study", names[2], [0.1, 0.2, 0.3], 0.96)  # solved at its end
    wrote(tmp_path / "study", names[3], [0.99])  # still at it
    found = standings(tmp_path / "study", study)
    (line,) = by_variant(study, found)
    assert (line.runs, line.finished, line.solved, line.failures) == (4, 3, 4, [])
    assert (line.median_env_steps, line.median_cpu_seconds) == (600.0, 3.0)
    assert (line.sampled_success, line.deterministic_success) == (0.9, 0.45)
    assert [run.solved.env_steps for run in found if run.solved] == [800, 400, 1200, 400]
    assert (found[0].env_steps, found[0].relabelled_steps, found[0].search_steps) == (1200, 7, 9)
    assert [run.over for run in found] == [True, True, True, False]
    assert share_done(study, found) == pytest.approx((3 + 400 / 1000) / 4)
    assert seconds_left(study, found, 2) == pytest.approx(3.0 + 600 * 3 / 400), "a start, and the rest of the budget"


def test_what_is_left_is_told_from_the_pace_and_the_slots(tmp_path: Path) -> None:
    study = make_study(tmp_path / "study", 5)
    assert seconds_left(study, standings(tmp_path / "study", study), 2) is None
    wrote(tmp_path / "study", study.runs[0].run, [0.1, 0.1, 0.1], 0.1)
    found = standings(tmp_path / "study", study)
    each = 3.0 + 1000 * 3 / 400  # a start, and the budget
    assert seconds_left(study, found, 2) == pytest.approx(4 * each / 2)
    assert seconds_left(study, found, 100) == pytest.approx(each), "no run is done faster than by itself"


def change(status: Status, iteration: int, time: float) -> StateChanged:
    return StateChanged(status=status, iteration=iteration, time=time)


def step(iteration: int, env_steps: int, time: float) -> Progress:
    return Progress(
        iteration=iteration, env_steps=env_steps, time=time, phi=[1.0] * 5, episode_return=0, success=0, policy_std=1
    )


def test_neither_a_pause_nor_the_time_without_a_trainer_is_work() -> None:
    begun = [change("starting", 0, 10), change("running", 0, 12), step(1, 100, 15), step(2, 200, 20)]
    assert work_of(begun) == Work(10, 200)
    paused = [*begun, change("paused", 2, 21), acknowledged(1, 50), change("running", 2, 81), step(3, 300, 85)]
    assert work_of(paused) == Work(11 + 4, 300)
    stopped = [*paused, change("stopped", 3, 87)]
    assert work_of(stopped) == Work(17, 300)
    resumed = [*stopped, change("starting", 3, 1000), step(4, 400, 1005), change("finished", 4, 1006)]
    assert work_of(resumed) == Work(23, 400)


def test_what_a_resume_does_again_counts_as_work_both_times() -> None:
    killed = [change("starting", 0, 0), step(1, 100, 10), step(2, 200, 20), step(3, 300, 30)]
    again = [*killed, change("starting", 1, 500), step(2, 200, 520), step(3, 300, 540)]
    assert work_of(again) == Work(30 + 40, 300 + 200)
    from_the_start = [*killed, change("starting", 0, 500), step(1, 100, 501)]
    assert work_of(from_the_start) == Work(31, 400)


def test_a_loaded_machine_is_known_to_be_slow_whatever_the_cpu_time(tmp_path: Path) -> None:
    study = make_study(tmp_path / "study", 2)
    done, waits = (RunStanding(**structs.asdict(planned), status="queued", over=False) for planned in study.runs)
    done = structs.replace(done, status="finished", over=True, env_steps=1000, cpu_seconds=10, work=Work(40, 1000))
    assert seconds_left(study, [done, waits], 1) == pytest.approx(3 + 40)
    half = structs.replace(waits, status="running", env_steps=500, cpu_seconds=5, work=Work(60, 1000))
    assert seconds_left(study, [done, half], 1) == pytest.approx(500 * (40 + 60) / 2000), (
        "half of its steps were voided"
    )


def test_the_table_and_both_views_say_what_is_going_on(tmp_path: Path) -> None:
    study = make_study(tmp_path / "study", 3)
    wrote(tmp_path / "study", study.runs[0].run, [0.96, 0.5, 0.5], 0.75)
    found = standings(tmp_path / "study", study)
    assert _counts(found) == "1 of 3 runs finished, 2 waiting"
    for kind, is_terminal in ((_Lines, False), (_Bars, True)):
        console = Console(file=io.StringIO(), force_terminal=is_terminal, width=120)
        with Screen(console, quiet=False) as screen:
            screen.say("hello")
            kind(screen, study).show(found, 1, last=True)
        said = console.file.getvalue()  # pyright: ignore
        assert "hello" in said
        assert "1 of 3 runs finished, 2 waiting" in said
        assert "ETA 0:21" in said
    console = Console(file=io.StringIO(), width=160)
    console.print(table_of(study, found))
    heading, line = console.file.getvalue().splitlines()  # pyright: ignore
    assert heading.split("  ")[0] == "task"
    assert line.split() == [
        "reacher", "no_hw_opt,trajectories=8", *("1", "of", "3"), *("1", "of", "3"), *("0.000", "M"), *("2.0", "s"),
        "0.750", "0.375",
    ]  # fmt: skip


@pytest.mark.parametrize("level", [0.5, 0.95])
def test_the_report_says_of_a_run_what_is_said_while_it_runs(tmp_path: Path, level: float) -> None:
    study = make_study(tmp_path / "study", 4, level=level)
    for planned, (success, final) in zip(
        study.runs, [([0.5, 0.97], 0.9), ([0.1, 0.2], 0.96), ([0.4, 0.3], None), ([], None)], strict=True
    ):
        wrote(tmp_path / "study", planned.run, success, final)
    rows = read_results(tmp_path / "study").runs
    for row, standing in zip(rows, standings(tmp_path / "study", study), strict=True):
        for name in ("run", "status", "env_steps", "relabelled_steps", "search_steps", "cpu_seconds",
                     "sampled_success", "deterministic_success"):  # fmt: skip
            assert getattr(row, name) == getattr(standing, name), name
        solved = standing.solved
        assert row.sampled_solved_steps == (solved.env_steps if solved else None)


@pytest.fixture
def standing_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let stand-ins take the place of trainers; the mood is in MOOD."""
    monkeypatch.setitem(
        launchers.LAUNCHERS, "local", lambda slots=2: Local(slots, spawner(os.environ.get("MOOD", "healthy")))
    )


@pytest.mark.usefixtures("standing_in")
def test_a_study_ends_with_its_table_and_the_failures_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "study"
    monkeypatch.setenv("MOOD", "dying")
    assert run(["study", *WORDS, "--out", str(out)]) == 1
    said = capsys.readouterr()
    assert f"2 runs in {out}; watch them: morph-studio serve --runs {out}" in said.err
    assert (
        "1 of 2 runs finished, 1 over without an end; solved: sampled success ≥ 0.95; medians of the seeds" in said.out
    )
    assert "reacher-plain-s0: given up after 3 starts that got no further than iteration 0: " in said.out
    assert run(["study", "--status", str(out)]) == 0
    assert "reacher-plain-s0: given up" in capsys.readouterr().out

    monkeypatch.setenv("MOOD", "healthy")
    assert run(["study", *WORDS, "--out", str(out), "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert said.err == ""
    assert [entry["status"] for entry in document["runs"]] == ["finished"] * 2
    assert document["methods"][0]["finished"] == 2
    assert (document["over"], document["env_steps"], document["study"]) == (True, 1000, str(out))


def test_a_study_that_no_launcher_takes_is_not_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> None:
        raise ValueError("the cluster is full: try again later")

    monkeypatch.setattr(Local, "submit", refuse)
    assert run(["study", *WORDS, "--out", str(tmp_path / "study")]) == 2
    assert "the cluster is full" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


# --- with real trainers -----------------------------------------------------------------------------------------------

TINY = "trajectories=8,proxy.prefit=5,evaluation.episodes=4"
REAL = [
    "reacher", "--methods", f"m:morph,{TINY},search.generations=2", f"d:direct,{TINY[:14]},evaluation.interval=3",
    "--seeds", "0-1", "--env-steps", "6000", "--final-episodes", "8", "--slots", "2",
]  # fmt: skip


def study(out: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "studio.cli", "study", *REAL, "--out", str(out)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment, cwd=ROOT
    )


def furthest(out: Path) -> list[int]:
    folders = [RunFolder(out / planned.run) for planned in read_study(out).runs]
    return [History(folder).iteration if folder.path.exists() else 0 for folder in folders]


def trainer_of(run: Path) -> int:
    """Return the process number of a run's trainer, 0 where none is alive."""
    launch = read_launch(run)
    return launch.trainer.pid if launch and process_alive(launch.trainer.pid, launch.trainer.started) else 0


def found_by(out: Path) -> dict[str, list[tuple[int, list[str]]]]:
    """Return environment steps and phi, to the last bit, of every iteration and evaluation of every run."""
    return {
        planned.run: [
            (event.env_steps, [value.hex() for value in event.phi])
            for event in (*history.progress, *history.evaluations)
        ]
        for planned in read_study(out).runs
        for history in [History(RunFolder(out / planned.run))]
    }


@pytest.mark.slow
def test_kills_of_queue_and_trainers_and_ctrl_c_change_nothing_of_what_is_found(tmp_path: Path) -> None:
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    first = study(killed)
    assert eventually(lambda: (killed / "study.json").exists() and max(furthest(killed)) >= 4, 120)
    first.kill()
    first.wait()
    second = study(killed)
    here = furthest(killed)
    assert eventually(lambda: max(furthest(killed)) > max(here), 120)
    at_work = [run for run in (planned.run for planned in read_study(killed).runs) if trainer_of(killed / run)]
    lost = trainer_of(killed / at_work[0])
    os.kill(lost, signal.SIGKILL)
    # Trainers outlive their queue: that the second one is at work shows where it starts another.
    assert eventually(lambda: trainer_of(killed / at_work[0]) not in (0, lost), 120)
    assert eventually(lambda: sum(furthest(killed)) > sum(here) + 4, 120)
    second.send_signal(signal.SIGINT)
    said, _ = second.communicate(timeout=120)
    assert second.returncode == 130, said
    assert "save a checkpoint after this iteration and stop" in said
    third = study(killed)
    said, _ = third.communicate(timeout=280)
    assert third.returncode == 0, said
    assert "4 of 4 runs finished" in said

    undisturbed = study(whole)
    said, _ = undisturbed.communicate(timeout=280)
    assert undisturbed.returncode == 0, said
    assert found_by(killed) == found_by(whole)
    assert all(len(steps) > 12 for steps in found_by(whole).values())
