"""The local queue: its cap, its claims and what survives a kill, with stand-ins that learn nothing."""

import contextlib
import json
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from conftest import eventually

from morph_core.history import History
from morph_core.protocol import Stop
from morph_core.run_folder import RunFolder, process_alive
from studio.cli.study import _cancel, _status
from studio.limits import cores
from studio.study.launcher import Place
from studio.study.local import Local, read_launch
from studio.study.plan import PlannedTask, Study, parse_variant, plan_study, write_study
from studio.study.standing import Standings

ROOT = Path(__file__).parents[2]
STAND_IN = """
import os, platform, signal, sys, time
import psutil
from pathlib import Path
from morph_core.protocol import Acknowledged, Heartbeat, Progress, StateChanged, Stop
from morph_core.run_folder import EventLog, HeartbeatFile, RunFolder, hold

folder, mood = RunFolder(Path(sys.argv[1])), sys.argv[2]
journal = os.open(folder.path.parent / "journal", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
def note(what):
    os.write(journal, f"{what} {folder.id} {time.monotonic()} {os.getpid()}\\n".encode())
note("begin")
if mood == "stillborn":
    note("end")
    raise ImportError("no module named torch, says the stand-in")
ended = []
signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
with hold(folder):
    done = max((e.iteration for e in folder.read_events()[0] if isinstance(e, Progress)), default=0)
    log, heart, me = EventLog(folder), HeartbeatFile(folder), psutil.Process()
    heart.write(Heartbeat(platform.node(), me.pid, me.create_time(), time.time(), "running", "collecting", done, 3))
    log.append(StateChanged(status="starting", iteration=done))
    if mood == "dying" and folder.id.endswith("-s0"):
        note("end")
        raise FloatingPointError("loss is NaN, says the stand-in")
    born = time.monotonic()
    while done < 3 and not ended and time.monotonic() < born + 60:  # no test leaves it behind for long
        time.sleep(0.15 if mood != "slow" else 2)
        for path, order in folder.pending():
            path.unlink()
            log.append(Acknowledged(id=order.id, iteration=done, accepted=True, command=order.command))
            ended.append(isinstance(order.command, Stop))
        if mood == "endless":
            continue
        done += 1
        log.append(Progress(iteration=done, env_steps=400 * done, phi=[1.0] * 5, episode_return=0.0, success=0.0,
                            policy_std=0.5))
        if mood == "stumbling":
            note("end")
            os._exit(9)
    log.append(StateChanged(status="stopped" if done < 3 else "finished", iteration=done))
    note("end")
"""
QUEUE = """
import sys, time
from pathlib import Path
from test_study_local import queue, spawner
from studio.study.plan import read_study
directory, slots, mood = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
queue(directory, read_study(directory), slots, mood)
"""


def spawner(mood: str):
    """Return a `spawn` of stand-ins that inherit the locks of the queue."""

    def spawn(folder: RunFolder, *, held: Sequence[int] = ()) -> subprocess.Popen[bytes]:
        with (folder.path / "trainer.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-c", STAND_IN, str(folder.path), mood], stdout=log, stderr=log, cwd=ROOT,
                env=os.environ | {"PYTHONPATH": str(ROOT)}, start_new_session=True, pass_fds=held,
            )  # fmt: skip

    return spawn


def queue(directory: Path, study: Study, slots: int, mood: str = "healthy") -> Local:
    """Work on a study until all its runs are over."""
    local, names = Local(slots, spawner(mood)), [planned.run for planned in study.runs]
    local.submit(directory, names)
    standings = Standings(directory, study)
    while not all(run.over for run in standings.read(local.states(directory, names))) or local.working(directory):
        local.tend(directory)
        time.sleep(0.02)
    return local


def queue_process(directory: Path, slots: int, mood: str = "healthy") -> subprocess.Popen[bytes]:
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "studio")])
    return subprocess.Popen(
        [sys.executable, "-c", QUEUE, str(directory), str(slots), mood], env=os.environ | {"PYTHONPATH": path}
    )


def make_study(directory: Path, seeds: int, level: float = 0.95) -> Study:
    variant = parse_variant("no_hw_opt,trajectories=8")
    plan = plan_study([PlannedTask("reacher")], [variant], range(seeds), env_steps=1000, level=level)
    return write_study(directory, plan)


@pytest.fixture
def directory(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "study"
    for path in (tmp_path / "study").glob("*/launch.json"):
        launch = read_launch(path.parent)
        if launch and process_alive(launch.trainer.pid, launch.trainer.started):
            with contextlib.suppress(ProcessLookupError):
                os.kill(launch.trainer.pid, signal.SIGKILL)


def journal(directory: Path) -> list[tuple[str, str, float, int]]:
    """Return what the stand-ins have noted: "begin" or "end", the run, the time and the pid."""
    try:
        lines = (directory / "journal").read_text().splitlines()
    except FileNotFoundError:
        return []
    return [(what, run, float(when), int(pid)) for what, run, when, pid in map(str.split, lines)]


def most_at_once(directory: Path) -> int:
    changes = sorted((when, 1 if what == "begin" else -1) for what, _, when, _ in journal(directory))
    at_work, most = 0, 0
    for _, change in changes:
        at_work += change
        most = max(most, at_work)
    return most


def statuses(directory: Path, study: Study) -> list[str]:
    return [History(RunFolder(directory / planned.run)).status for planned in study.runs]


def test_a_queue_finishes_every_run_and_keeps_its_cap(directory: Path) -> None:
    study = make_study(directory, 5)
    queue(directory, study, 2)
    assert statuses(directory, study) == ["finished"] * 5
    assert len(journal(directory)) == 10, "nothing was started twice"
    assert most_at_once(directory) == 2


@pytest.mark.slow
def test_two_queues_share_the_work_and_a_killed_one_loses_nothing(directory: Path) -> None:
    study = make_study(directory, 7)
    first = queue_process(directory, 2)
    assert eventually(lambda: len(journal(directory)) >= 3, 60)
    first.kill()
    first.wait()
    others = [queue_process(directory, 2) for _ in range(2)]
    assert [other.wait(120) for other in others] == [0, 0]
    assert statuses(directory, study) == ["finished"] * 7
    assert sorted(run for what, run, _, _ in journal(directory) if what == "begin") == sorted(
        planned.run for planned in study.runs
    ), "no run was started twice: those of the killed queue went on"
    assert most_at_once(directory) == 2


def test_a_killed_trainer_is_started_again_from_where_it_was(directory: Path) -> None:
    study = make_study(directory, 1)
    local = Local(1, spawner("slow"))
    names = [study.runs[0].run]
    local.submit(directory, names)
    local.tend(directory)
    folder = RunFolder(directory / names[0])
    assert eventually(lambda: History(folder).iteration == 1, 30)
    launch = read_launch(folder.path)
    assert launch
    os.kill(launch.trainer.pid, signal.SIGKILL)
    assert eventually(lambda: not process_alive(launch.trainer.pid, launch.trainer.started))
    queue(directory, study, 1)
    assert History(folder).status == "finished"
    assert [p.iteration for p in History(folder).progress] == [1, 2, 3]


@pytest.mark.parametrize("mood", ["dying", "stillborn"])
def test_a_run_is_given_up_after_three_starts_that_got_no_further_and_the_rest_goes_on(
    directory: Path, mood: str
) -> None:
    study = make_study(directory, 2)
    local = queue(directory, study, 1, mood)
    first = study.runs[0].run
    assert [run for what, run, _, _ in journal(directory) if what == "begin"].count(first) == 3
    place = local.states(directory, [first])[first]
    cause = "loss is NaN" if mood == "dying" else "no module named torch"
    assert place.given_up
    assert place.why.startswith("given up after 3 starts that got no further than iteration 0: ")
    assert cause in place.why
    assert statuses(directory, study)[1] == ("finished" if mood == "dying" else "queued")

    local.requeue(directory, [first])
    assert local.states(directory, [first])[first] == Place()
    queue(directory, study, 1, "healthy")
    assert History(RunFolder(directory / first)).status == "finished"


def tended(local: Local, directory: Path, folder: RunFolder) -> int:
    """Let the queue tend its runs, as it does again and again; return the iteration that one of them has reached."""
    local.tend(directory)
    return History(folder).iteration


def test_a_run_that_gets_further_each_time_is_not_given_up(directory: Path) -> None:
    study = make_study(directory, 1)
    folder, local = RunFolder(directory / study.runs[0].run), Local(1, spawner("stumbling"))
    local.submit(directory, [folder.id])
    for reached in (1, 2, 3):  # each trainer dies after one iteration
        assert eventually(lambda reached=reached: tended(local, directory, folder) >= reached, 30)
        assert eventually(lambda: not local.tend(directory) and read_launch(folder.path), 30)
        assert eventually(lambda: len(journal(directory)) % 2 == 0, 30)
    launch = read_launch(folder.path)
    assert launch
    assert launch.starts == 1
    assert not launch.given_up
    local.leave(directory, at_once=True)


def test_a_run_that_a_user_has_stopped_stays_stopped(directory: Path) -> None:
    study = make_study(directory, 2)
    local, names = Local(2, spawner("endless")), [planned.run for planned in study.runs]
    local.submit(directory, names)
    local.tend(directory)
    first = RunFolder(directory / names[0])
    assert eventually(lambda: first.heartbeat() is not None, 30)
    first.send(Stop())
    assert eventually(lambda: History(first).status == "stopped", 30)
    assert eventually(lambda: not local.tend(directory) and local.working(directory) == 1), "its slot stays free"
    (standing, _) = Standings(directory, study).read(local.states(directory, names))
    assert (standing.over, standing.reason) == (True, "stopped by a user")
    assert [run for what, run, _, _ in journal(directory) if what == "begin"].count(names[0]) == 1
    local.leave(directory, at_once=True)


@pytest.mark.slow
def test_leaving_stops_the_trainers_and_starts_no_other(directory: Path) -> None:
    study = make_study(directory, 3)
    local, names = Local(2, spawner("slow")), [planned.run for planned in study.runs]
    local.submit(directory, names)
    local.tend(directory)
    assert eventually(lambda: len(journal(directory)) == 2, 30)
    assert "2 trainers save a checkpoint after this iteration and stop" in local.leave(directory)
    assert eventually(lambda: local.tend(directory) or not local.working(directory), 30)
    assert sorted(statuses(directory, study)) == ["queued", "stopped", "stopped"]
    queue(directory, study, 2)
    assert statuses(directory, study) == ["finished"] * 3


def test_trainers_of_a_dead_queue_are_stopped_too(directory: Path) -> None:
    study = make_study(directory, 1)
    dead = queue_process(directory, 1, "endless")
    assert eventually(lambda: len(journal(directory)) == 1, 30)
    folder = RunFolder(directory / study.runs[0].run)
    assert eventually(lambda: read_launch(folder.path), 30)
    dead.kill()
    dead.wait()
    local = Local(1, spawner("endless"))
    local.submit(directory, [folder.id])
    local.tend(directory)
    assert local.working(directory) == 0, "the run has its trainer"
    assert "1 trainer save" in local.leave(directory)
    assert eventually(lambda: History(folder).status == "stopped", 30)


def test_a_study_is_cancelled_from_another_process_and_goes_on_when_asked(
    directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = make_study(directory, 3)
    working = queue_process(directory, 1, "endless")
    assert eventually(lambda: len(journal(directory)) == 1, 30)
    assert _cancel(directory, False) == 0
    assert "cancelled 3 runs" in capsys.readouterr().out
    assert working.wait(30) == 0, "a queue ends when all its runs are over"
    assert sorted(statuses(directory, study)) == ["queued", "queued", "stopped"]
    assert _status(directory, True) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["over"]
    assert [run["reason"] for run in document["runs"]] == ["cancelled"] * 3
    Local(1).requeue(directory, [planned.run for planned in study.runs])
    queue(directory, study, 2)
    assert statuses(directory, study) == ["finished"] * 3


def test_each_slot_has_a_core_of_its_own(directory: Path) -> None:
    study = make_study(directory, 2)
    local, names = Local(2, spawner("endless")), [planned.run for planned in study.runs]
    local.submit(directory, names)
    local.tend(directory)
    pids = [launch.trainer.pid for name in names if (launch := read_launch(directory / name))]
    mine = cores()
    assert [os.sched_getaffinity(pid) for pid in pids] == [{mine[0]}, {mine[1 % len(mine)]}]
    places = local.states(directory, names)
    assert [places[name].where for name in names] == [f"slot {k} of {platform.node()}" for k in (0, 1)]
    local.leave(directory, at_once=True)


def test_a_run_with_a_trainer_of_somebody_else_is_left_alone(directory: Path) -> None:
    study = make_study(directory, 1)
    folder = RunFolder(directory / study.runs[0].run)
    other = spawner("endless")(folder)  # resumed in the studio
    assert eventually(lambda: len(journal(directory)) == 1, 30)
    local = Local(1, spawner("healthy"))
    local.submit(directory, [folder.id])
    local.tend(directory)
    assert local.working(directory) == 0
    other.kill()
    other.wait()
    local.tend(directory)
    assert local.working(directory) == 1
    local.leave(directory, at_once=True)


def test_runs_of_another_launcher_are_not_taken(directory: Path) -> None:
    study = make_study(directory, 1)
    run = study.runs[0].run
    (directory / run / "launch.json").write_text('{"launcher": "elsewhere", "job": "42_0"}')
    with pytest.raises(ValueError, match="in the hands of the launcher elsewhere: go on with --launcher elsewhere"):
        Local(1).submit(directory, [run])
