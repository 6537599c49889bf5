"""No more trainers than the machine has room for: further runs wait, in order, in sight, over a restart."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import eventually, stand_in

from morph_core.history import History
from morph_core.protocol import Kill, Stop
from morph_core.run_folder import RunFolder
from studio.cli.arguments import UsageError
from studio.cli.stop import main as stop
from studio.inquest import KILLED
from studio.new_run import StartRun
from studio.overdue import KILL_OFFERED_AFTER
from studio.runs import Runs
from studio.waiting import Wait, Waiting

WISH = StartRun(task="reacher")
DEAF = """
import platform, os, sys, time
import psutil
from pathlib import Path
from morph_core.protocol import Heartbeat, StateChanged
from morph_core.run_folder import EventLog, HeartbeatFile, RunFolder, hold

folder = RunFolder(Path(sys.argv[1]))
with hold(folder):
    EventLog(folder).append(StateChanged(status="running", iteration=0))
    beats = HeartbeatFile(folder)
    while True:
        beats.write(Heartbeat(host=platform.node(), pid=os.getpid(), process_started=psutil.Process().create_time(),
            time=time.time(), status="running", stage="learning", iteration=0, iterations=9))
        time.sleep(.1)
"""
"""A trainer that looks into its inbox no more: its iteration takes for ever."""


def deaf(folder: RunFolder, **_: object) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", DEAF, str(folder.path)])


@pytest.fixture
def runs(runs_folder: Path) -> Runs:
    return Runs(runs_folder, stand_in, trainers=2)


def states(runs: Runs) -> dict[str, str]:
    return {line.id: line.status for line in runs.summaries()}


def test_further_runs_wait_in_order_and_begin_when_there_is_room(runs: Runs, runs_folder: Path) -> None:
    first, second, third, fourth = (runs.start(WISH) for _ in range(4))
    assert [states(runs)[name] for name in (third, fourth)] == ["queued"] * 2
    assert runs.summary(third).reason == "number 1 in the queue: 2 trainers are at work already"
    assert runs.summary(fourth).reason.startswith("number 2 in the queue")
    assert eventually(lambda: states(runs)[first] == states(runs)[second] == "running")
    runs.tend()
    assert states(runs)[third] == "queued"
    runs.send(first, Stop())
    again = Runs(runs_folder, stand_in, trainers=2)  # as after a restart of the server
    assert again.summary(third).reason.startswith("number 1 in the queue")
    assert eventually(lambda: states(again)[first] == "stopped")
    again.tend()
    assert eventually(lambda: states(again)[third] == "running")
    assert again.summary(fourth).reason.startswith("number 1 in the queue")
    with pytest.raises(ValueError, match=r"waits already: number 1"):
        again.resume(fourth)


def test_a_run_that_waits_can_be_taken_out_and_started_later(runs: Runs, capsys: pytest.CaptureFixture[str]) -> None:
    names = [runs.start(WISH) for _ in range(3)]
    assert stop([names[2], "--runs", str(runs.folder)]) == 0
    assert "to go on: morph-studio train --resume" in capsys.readouterr().out
    History(runs.get(names[2]).folder).record.created  # noqa: B018 - it is still there
    assert eventually(lambda: runs.status(runs.get(names[2]))[0] in ("starting", "stopped"))
    assert not Waiting(runs.folder).all()
    runs.resume(names[2])
    assert states(runs)[names[2]] == "queued"


def test_a_resumed_run_waits_like_a_new_one_with_all_that_was_asked(runs: Runs) -> None:
    names = [runs.start(WISH) for _ in range(2)]
    assert eventually(lambda: set(states(runs).values()) == {"running"})
    runs.send(names[0], Stop())
    assert eventually(lambda: states(runs)[names[0]] == "stopped")
    assert eventually(lambda: not runs._inquest.is_alive(runs.get(names[0])))
    runs.start(WISH)
    runs.resume(names[0], 7)
    assert Waiting(runs.folder).all() == [Wait(names[0], 7)]
    assert states(runs)[names[0]] == "queued"


def test_two_servers_give_each_start_to_one_of_them(tmp_path: Path) -> None:
    one, other = Waiting(tmp_path), Waiting(tmp_path)
    for number in range(5):
        (one if number % 2 else other).add(Wait(f"run{number}"))
    assert [wait.run for wait in one.all()] == [f"run{number}" for number in range(5)] == [w.run for w in other.all()]
    assert one.take("run0")
    assert not other.take("run0")
    assert (other.place("run0"), other.place("run1"), other.place("run4")) == (0, 1, 4)


def test_what_is_no_file_of_the_queue_is_passed_over(tmp_path: Path) -> None:
    waiting = Waiting(tmp_path)
    waiting.add(Wait("run"))
    folder = tmp_path / ".waiting"
    (folder / "000002.json").write_text("{")
    (folder / "000003.json").symlink_to("/dev/zero")
    os.mkfifo(folder / "000004.json")
    (folder / "notes.txt").write_text("hello")
    assert waiting.all() == [Wait("run")]
    waiting.add(Wait("last"))
    assert waiting.place("last") == 2


def test_a_run_that_can_not_be_started_now_waits_on(runs_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = Runs(runs_folder, stand_in, trainers=1)
    runs.start(WISH)
    second = runs.start(WISH)
    monkeypatch.setattr(runs._crew, "_trainers", 2)

    def no_room(folder: RunFolder, **_: object) -> subprocess.Popen[bytes]:
        raise BlockingIOError(11, f"no process for {folder.id}")

    monkeypatch.setattr(runs._crew, "_spawn", no_room)
    with pytest.raises(BlockingIOError):
        runs.tend()
    assert Waiting(runs_folder).place(second) == 1


# --- a stop that is not obeyed ----------------------------------------------------------------------------------------


@pytest.fixture
def unheeded(runs_folder: Path) -> tuple[Runs, str]:
    runs = Runs(runs_folder, deaf)
    name = runs.start(WISH)
    assert eventually(lambda: states(runs)[name] == "running")
    return runs, name


def age(folder: RunFolder, seconds: float) -> None:
    for path, _ in folder.pending():
        then = time.time() - seconds
        os.utime(path, (then, then))


def kill_by_command_line(runs: Runs, name: str) -> None:
    assert stop([name, "--kill", "--runs", str(runs.folder)]) == 0


@pytest.mark.parametrize("kill", [lambda runs, name: runs.send(name, Kill()), kill_by_command_line])
def test_a_stop_that_is_not_obeyed_is_followed_by_the_offer_to_end_the_trainer(
    unheeded: tuple[Runs, str], kill: Callable[[Runs, str], object]
) -> None:
    runs, name = unheeded
    folder = runs.get(name).folder
    runs.send(name, Stop())
    assert "Kill" not in runs.summary(name).reason
    age(folder, KILL_OFFERED_AFTER + 5)
    assert f"to end it at once: Kill, or morph-studio stop {name} --kill" in runs.summary(name).reason
    kill(runs, name)
    assert eventually(lambda: runs.summary(name).status == "failed")
    assert runs.summary(name).reason == KILLED
    assert not list(folder.pending()), "the next trainer would obey the stop"
    with pytest.raises(ValueError, match=r"has no trainer on this machine|is failed"):
        runs.send(name, Kill())


def test_only_what_is_at_work_here_can_be_ended(runs: Runs) -> None:
    with pytest.raises(UsageError, match="unknown run"):
        stop(["nothing", "--runs", str(runs.folder)])
