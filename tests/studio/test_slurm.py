"""The launcher `slurm` on a stand-in cluster: what it asks of Slurm, what it says of runs, and what it refuses."""

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import anyio
import pytest
from conftest import Blackboard, make_run
from fastapi import FastAPI
from hypothesis import given
from hypothesis import strategies as st

from morph_core.protocol import Acknowledged, AnyCommand, Heartbeat, Pause, Resume, StateChanged, Stop
from morph_core.run_folder import LAUNCH, EventLog, HeartbeatFile, RunFolder
from studio.app import create_app
from studio.cli import run
from studio.new_run import StartRun
from studio.runs import Runs
from studio.settings import Settings
from studio.study import slurm as module
from studio.study.local import CANCELLED, Local
from studio.study.slurm import Slurm, slurm_launch
from studio.study.slurm_options import SlurmOptions, seconds_of
from studio.study.slurm_queue import SlurmError
from studio.trainers import Reserve

FAKE = Path(__file__).with_name("fake_slurm.py")


@dataclass
class Cluster:
    """The stand-in cluster, and what was asked of it."""

    path: Path

    @property
    def queue(self) -> dict[str, str]:
        return json.loads((self.path / "queue").read_text())

    def say(self, **tasks: str) -> None:
        """Let tasks be in another state, such as t42_0="RUNNING|n1|None"; an empty one is forgotten."""
        queue = self.queue | {name.removeprefix("t"): state for name, state in tasks.items()}
        (self.path / "queue").write_text(json.dumps({task: state for task, state in queue.items() if state}))

    def refuse(self, **words: Sequence[str | None]) -> None:
        """Let the next calls of a command fail with these words; an empty one is not refused."""
        (self.path / "refusals").write_text(json.dumps(words))

    def calls(self, name: str) -> list[list[str]]:
        """Return the words of the calls of a command."""
        lines = (self.path / "calls").read_text().splitlines()
        return [words for called, words, _ in map(json.loads, lines) if called == name]

    def environments(self) -> list[dict[str, str]]:
        """Return what the commands saw of their environment."""
        return [json.loads(line)[2] for line in (self.path / "calls").read_text().splitlines()]


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cluster:
    path = tmp_path / "cluster"
    (path / "bin").mkdir(parents=True)
    (path / "queue").write_text("{}")
    (path / "refusals").write_text("{}")
    (path / "calls").touch()
    for name in ("sbatch", "squeue", "scancel", "scontrol"):
        (path / "bin" / name).write_text(f"#!{sys.executable} -ES\n{FAKE.read_text()}")
        (path / "bin" / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{path / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(path))
    return Cluster(path)


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Four runs that have not begun."""
    for i in range(4):
        make_run(tmp_path / "a study", f"r{i}", ended=None)
    return tmp_path / "a study"


RUNS = ["r0", "r1", "r2", "r3"]


def launch_of(study: Path, name: str) -> dict[str, object]:
    return json.loads((study / name / LAUNCH).read_text())


def end(folder: RunFolder, status: str, command: bool = False) -> None:
    log = EventLog(folder)
    log.append(StateChanged(status="starting", iteration=0))
    if command:
        log.append(Acknowledged(id=1, iteration=0, accepted=True, command=Stop()))
    log.append(StateChanged(status=status, iteration=3))  # pyright: ignore[reportArgumentType]
    log.close()


# --- submitting -------------------------------------------------------------------------------------------------------


def test_a_study_is_one_array_with_a_cap_and_each_run_knows_its_task(
    cluster: Cluster, study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MORPH_TOKEN", "hush")
    options = SlurmOptions("short", "1-00:00:00", "lab", "avx512", "3G", parallel=2)
    Slurm(options).submit(study, RUNS)
    [words] = cluster.calls("sbatch")
    for word in ("--parsable", "--array=0-3%2", "--requeue", "--partition=short", "--time=1-00:00:00", "--account=lab",
                 "--constraint=avx512", "--mem=3G", "--signal=B:USR1@120", "--cpus-per-task=1", "--export=ALL",
                 "--open-mode=append"):  # fmt: skip
        assert word in words
    script, listed, *command = words[-7:]
    assert Path(script).read_text() == (files("studio.study") / "slurm_job.sh").read_text()
    assert Path(listed).read_text().splitlines() == [str(study / name) for name in RUNS]
    assert command == [sys.executable, "-P", "-m", "morph_core.train", "--run"]
    assert [launch_of(study, name)["job"] for name in RUNS] == ["42_0", "42_1", "42_2", "42_3"]
    assert launch_of(study, "r0")["launcher"] == "slurm"
    assert all(seen["MORPH_TOKEN"] is None and seen["PYTHONPATH"] for seen in cluster.environments())


def test_what_is_not_given_is_left_to_the_cluster(cluster: Cluster, study: Path) -> None:
    Slurm().submit(study, RUNS)
    [words] = cluster.calls("sbatch")
    assert not [word for word in words if re.match("--(partition|time|account|constraint)", word)]


def test_a_study_that_is_submitted_again_leaves_what_slurm_knows(cluster: Cluster, study: Path) -> None:
    Slurm().submit(study, RUNS)
    cluster.say(t42_0="RUNNING|n1|None", t42_1="", t42_2="FAILED||NonZeroExitCode")
    Slurm().submit(study, RUNS)
    assert [launch_of(study, name)["job"] for name in RUNS] == ["42_0", "43_0", "42_2", "42_3"]


@pytest.mark.usefixtures("cluster")
def test_what_is_finished_or_was_stopped_by_a_user_is_not_submitted(study: Path) -> None:
    end(RunFolder(study / "r0"), "finished")
    end(RunFolder(study / "r1"), "stopped", command=True)
    end(RunFolder(study / "r2"), "stopped")
    Slurm().submit(study, RUNS)
    assert [(study / name / LAUNCH).exists() for name in RUNS] == [False, False, True, True]


def test_many_runs_are_split_and_each_part_waits_for_the_one_before(
    cluster: Cluster, study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LARGEST_ARRAY", 3)
    Slurm().submit(study, RUNS)
    first, second = cluster.calls("sbatch")
    assert "--array=0-2%32" in first
    assert "--array=0-0%32" in second
    assert "--dependency=afterany:42" in second
    assert not [word for word in first if word.startswith("--dependency")]
    assert [launch_of(study, name)["job"] for name in RUNS] == ["42_0", "42_1", "42_2", "43_0"]


def test_a_refusal_of_the_second_part_takes_back_the_first(
    cluster: Cluster, study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LARGEST_ARRAY", 3)
    cluster.refuse(sbatch=[None, "sbatch: error: QOSMaxSubmitJobPerUserLimit"])
    with pytest.raises(SlurmError, match=r"QOSMaxSubmit.*lower --parallel"):
        Slurm().submit(study, RUNS)
    assert set(cluster.queue.values()) == {"CANCELLED||None"}
    assert not list(study.glob("*/launch.json"))


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        ("sbatch: error: invalid partition specified: nope", "sinfo -s lists"),
        ("sbatch: error: Batch job submission failed: Invalid account or account/partition", "sinfo -s|sacctmgr"),
        ("allocation failure: Invalid feature specification", "--constraint"),
        ("sbatch: error: Memory specification can not be satisfied", "less --mem"),
        ("allocation failure: Requested time limit is invalid (missing or exceeds some limit)", "shorter --time"),
        ("sbatch: error: Batch job submission failed: Invalid job array specification", "MaxArraySize"),
        ("sbatch: error: Unable to contact slurm controller (connect failure)", "try again later"),
        ("sbatch: fatal: Could not establish a configuration source", "login node"),
    ],
)
def test_a_refusal_is_said_with_slurms_words_and_what_to_do(
    cluster: Cluster, study: Path, words: str, advice: str
) -> None:
    cluster.refuse(sbatch=[words, words])
    for ask in (Slurm().check, lambda: Slurm().submit(study, RUNS)):
        with pytest.raises(SlurmError, match=f"{re.escape(words)} .*({advice})"):
            ask()
    assert sorted(path.name for path in study.iterdir()) == RUNS
    assert not list(study.glob("*/launch.json"))


def test_without_slurm_the_reason_and_what_to_do_are_said(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(study))
    with pytest.raises(SlurmError, match=r"sbatch is not on this machine: .*login node.*--launcher local"):
        Slurm().check()
    with pytest.raises(SlurmError, match="not on this machine"):
        Slurm().submit(study, RUNS)
    assert sorted(path.name for path in study.iterdir()) == RUNS


def test_no_study_is_written_where_slurm_refuses(
    cluster: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["study", "reacher", "--methods", "direct", "--seeds", "0", "--env-steps", "1e6", "--launcher", "slurm"]
    for refused in (["no"], [None, "no"]):  # by the check, and by the submission itself
        cluster.refuse(sbatch=refused)
        assert run([*words, "--out", str(tmp_path / "out")]) == 2
        assert "Slurm refuses: no" in capsys.readouterr().err
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"time": "tomorrow"}, "MINUTES"), ({"time": "00:04:59"}, "at least 5 minutes"), ({"time": "-1"}, "MINUTES"),
        ({"mem": "lots"}, "K, M, G or T"), ({"mem": "-1G"}, "K, M, G or T"), ({"parallel": 0}, "from 1 to 1000"),
        ({"parallel": 1001}, "from 1 to 1000"), ({"partition": " "}, "not empty"), ({"account": "a\nb"}, "printable"),
        ({"constraint": "x" * 201}, "at most 200"),
    ],
)  # fmt: skip
def test_options_out_of_their_range_are_refused(given: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        SlurmOptions(**given)  # pyright: ignore[reportArgumentType]


@given(st.integers(0, 400), st.integers(0, 23), st.integers(0, 59), st.integers(0, 59))
def test_a_time_limit_means_what_it_means_to_slurm(days: int, hours: int, minutes: int, seconds: int) -> None:
    whole = ((days * 24 + hours) * 60 + minutes) * 60 + seconds
    written = {f"{days}-{hours}:{minutes}:{seconds}": whole, f"{days}-{hours:02}:{minutes:02}": whole - seconds}
    written |= {f"{days}-{hours}": (days * 24 + hours) * 3600, f"{hours + 1}:{minutes}:{seconds}": None}
    written |= {str(minutes + 1): 60 * (minutes + 1), f"{minutes + 1}:{seconds:02}": 60 * (minutes + 1) + seconds}
    written[f"{hours + 1}:{minutes}:{seconds}"] = ((hours + 1) * 60 + minutes) * 60 + seconds
    for limit, expected in written.items():
        assert expected is not None
        if expected >= 300:
            assert seconds_of(limit) == expected
        else:
            with pytest.raises(ValueError, match="at least 5 minutes"):
                seconds_of(limit)


def test_the_warning_comes_before_a_short_limit_and_not_at_its_start() -> None:
    assert "--signal=B:USR1@75" in SlurmOptions(time="5").words()
    assert "--signal=B:USR1@120" in SlurmOptions(time="1-0").words()


# --- where runs are ---------------------------------------------------------------------------------------------------


def test_slurm_is_asked_once_for_all_runs_and_not_again_at_once(cluster: Cluster, study: Path) -> None:
    Slurm().submit(study, RUNS)
    slurm, before = Slurm(), len(cluster.calls("squeue"))
    for _ in range(3):
        assert len(slurm.states(study, RUNS)) == 4
    assert len(cluster.calls("squeue")) == before + 1


def test_a_place_says_where_and_why(cluster: Cluster, study: Path) -> None:
    Slurm().submit(study, RUNS)
    cluster.say(t42_0="RUNNING|n7|None", t42_1="PENDING||JobArrayTaskLimit", t42_2="NODE_FAIL||None", t42_3="")
    places = Slurm().states(study, RUNS)
    assert places["r0"].where == "n7 (Slurm job 42_0: RUNNING)"
    assert "--parallel allows" in places["r1"].why
    assert [places[name].given_up for name in RUNS] == [False, False, True, True]
    assert not places["r1"].where
    assert "NODE_FAIL" in places["r2"].why
    assert "does not know its job any more" in places["r3"].why


def test_an_array_that_was_cancelled_whole_is_one_line_of_slurms(cluster: Cluster, study: Path) -> None:
    Slurm().submit(study, RUNS)
    cluster.say(t42_0="", t42_1="", t42_2="", t42_3="", t42="CANCELLED||None")
    assert {place.why for place in Slurm().states(study, RUNS).values()} == {
        f"Slurm job 42_{i}: CANCELLED" for i in range(4)
    }


def test_where_slurm_does_not_say_nothing_is_known(cluster: Cluster, study: Path) -> None:
    Slurm().submit(study, RUNS)
    slurm = Slurm()
    cluster.refuse(squeue=["slurm_load_jobs error: Unable to contact slurm controller (connect failure)"] * 9)
    assert slurm.states(study, RUNS) == {}
    assert "try again later" in slurm.trouble
    for ask in (slurm.submit, slurm.cancel, slurm.requeue):
        with pytest.raises(SlurmError, match="Unable to contact"):
            ask(study, RUNS)


@pytest.mark.parametrize(
    "content", [b"", b"{", b'{"launcher": "slurm"}', b'{"launcher": "slurm", "job": "--me", "submitted": 1}',
                b'{"launcher": "local", "job": "42_0", "submitted": 1}', b"\xff"]
)  # fmt: skip
def test_a_file_that_names_no_task_of_slurm_is_no_launch(study: Path, content: bytes) -> None:
    (study / "r0" / LAUNCH).write_bytes(content)
    assert slurm_launch(RunFolder(study / "r0")) is None
    assert Slurm().states(study, ["r0"]) == {}


# --- cancelling and going on ------------------------------------------------------------------------------------------


def test_cancelled_runs_are_taken_out_and_stay_out_until_they_are_requeued(cluster: Cluster, study: Path) -> None:
    slurm = Slurm()
    slurm.submit(study, RUNS)
    cluster.say(t42_0="RUNNING|n1|None", t42_1="COMPLETED||None")
    slurm.cancel(study, RUNS[:3])
    assert cluster.calls("scancel") == [["--quiet", "42_0", "42_2"]]
    assert {run: place.given_up for run, place in slurm.states(study, RUNS).items()} == {
        "r0": True, "r1": True, "r2": True, "r3": False,
    }  # fmt: skip
    cluster.say(t42_0="", t42_2="")
    Slurm().submit(study, RUNS)
    assert len(cluster.calls("sbatch")) == 1
    Slurm().requeue(study, ["r0", "r2"])
    assert [launch_of(study, name)["job"] for name in ("r0", "r2")] == ["43_0", "43_1"]
    assert not Slurm().states(study, ["r0"])["r0"].given_up


def test_a_task_that_slurm_knows_is_requeued_and_one_that_it_forgot_is_submitted_anew(
    cluster: Cluster, study: Path
) -> None:
    Slurm(SlurmOptions(partition="short", parallel=3)).submit(study, RUNS)
    cluster.say(t42_0="FAILED||NonZeroExitCode", t42_1="", t42_2="RUNNING|n1|None", t42_3="PENDING||Priority")
    Slurm().requeue(study, RUNS)
    assert cluster.calls("scontrol") == [["requeue", "42_0"]]
    assert [launch_of(study, name)["job"] for name in RUNS] == ["42_0", "43_0", "42_2", "42_3"]
    assert {"--partition=short", "--array=0-0%3"} <= set(cluster.calls("sbatch")[-1]), "as it was submitted before"


def test_what_slurm_will_not_requeue_is_submitted_anew(cluster: Cluster, study: Path) -> None:
    Slurm().submit(study, ["r0"])
    cluster.say(t42_0="CANCELLED||None")
    cluster.refuse(scontrol=["slurm_update error: Access/permission denied"])
    Slurm().requeue(study, ["r0"])
    assert launch_of(study, "r0")["job"] == "43_0"


def test_a_study_requeues_nothing_that_is_finished_or_was_stopped_by_a_user(cluster: Cluster, study: Path) -> None:
    Slurm().submit(study, RUNS)
    cluster.say(**{f"t42_{i}": "COMPLETED||None" for i in range(4)})
    end(RunFolder(study / "r0"), "finished")
    end(RunFolder(study / "r1"), "stopped", command=True)
    Slurm().requeue(study, RUNS)
    assert cluster.calls("scontrol") == [["requeue", "42_2"], ["requeue", "42_3"]]
    Slurm().resume(study, "r1")
    assert cluster.calls("scontrol")[-1] == ["requeue", "42_1"]


def test_further_iterations_are_a_last_one_that_holds_however_often_the_task_is_started(
    cluster: Cluster, study: Path
) -> None:
    Slurm().submit(study, ["r0"])
    cluster.say(t42_0="COMPLETED||None")
    Slurm().resume(study, "r0", until=120)
    assert cluster.calls("sbatch")[-1][-3:] == ["--until", "120", "--run"]
    cluster.say(t43_0="COMPLETED||None")
    Slurm().resume(study, "r0")
    assert cluster.calls("scontrol")[-1] == ["requeue", "43_0"], "the same task, and so the same last iteration"


@pytest.mark.usefixtures("cluster")
def test_a_run_passes_from_one_launcher_to_the_other_once_it_is_cancelled(study: Path) -> None:
    Slurm().submit(study, ["r0"])
    local = Local(1)
    local.requeue(study, ["r0"])
    with pytest.raises(ValueError, match="in the hands of the launcher slurm"):
        local.submit(study, ["r0"])
    Slurm().cancel(study, ["r0"])
    local.requeue(study, ["r0"])
    local.submit(study, ["r0"])
    assert not (study / "r0" / LAUNCH).exists()
    (study / "r0" / LAUNCH).write_text('{"launcher": "local"}')
    with pytest.raises(ValueError, match="in the hands of the launcher local"):
        Slurm().submit(study, ["r0"])
    local.cancel(study, ["r0"])
    Slurm().requeue(study, ["r0"])
    Slurm().submit(study, ["r0"])
    assert launch_of(study, "r0")["job"] == "43_0"
    assert not (study / "r0" / CANCELLED).exists()


# --- the studio on a cluster ------------------------------------------------------------------------------------------


def never(folder: RunFolder, **words: object) -> subprocess.Popen[bytes]:
    raise AssertionError(f"a trainer of {folder.id} was started on the login node, {words}")


@pytest.fixture
def runs(cluster: Cluster, runs_folder: Path) -> Runs:
    assert cluster.queue == {}
    return Runs(runs_folder, never, Slurm(SlurmOptions(partition="short")))


def settled(runs: Runs, run_id: str) -> tuple[str, str]:
    """Return status and reason of a run with what Slurm says of it now."""
    runs._slurm._queue.forget()
    runs.ask_slurm()
    return runs.status(runs.get(run_id))


def test_a_start_goes_to_slurm_and_shows_why_it_waits(cluster: Cluster, runs: Runs) -> None:
    run_id = runs.start(StartRun(task="reacher"))
    assert "--partition=short" in cluster.calls("sbatch")[0]
    assert runs.summary(run_id).status == "queued"
    cluster.say(t42_0="PENDING||Resources")
    assert settled(runs, run_id) == ("queued", "waits for a free core (Slurm job 42_0: PENDING, Resources)")
    assert runs.summary(run_id).reason == "waits for a free core (Slurm job 42_0: PENDING, Resources)"
    cluster.say(t42_0="RUNNING|n1|None")
    assert settled(runs, run_id) == (
        "starting",
        "on n1 (Slurm job 42_0: RUNNING); an iteration takes about a second or less",
    )
    cluster.say(t42_0="FAILED||NonZeroExitCode")
    assert settled(runs, run_id) == ("failed", "Slurm job 42_0: FAILED, NonZeroExitCode")


def test_a_start_that_slurm_refuses_leaves_no_run(cluster: Cluster, runs: Runs) -> None:
    cluster.refuse(sbatch=["sbatch: error: invalid partition specified: short"])
    with pytest.raises(ValueError, match="sinfo -s lists"):
        runs.start(StartRun(task="reacher"))
    assert list(runs.folder.iterdir()) == []
    assert runs.shown is None


def test_a_stop_takes_a_waiting_run_out_of_the_queue_and_resume_puts_it_back(cluster: Cluster, runs: Runs) -> None:
    run_id = runs.start(StartRun(task="reacher"))
    with pytest.raises(ValueError, match="waits in the queue"):
        runs.send(run_id, Pause())
    with pytest.raises(ValueError, match="in Slurm's queue already"):
        runs.resume(run_id)
    assert runs.send(run_id, Stop()) == 0
    assert settled(runs, run_id) == ("stopped", "cancelled: resume queues it once more")
    assert list(runs.get(run_id).folder.pending()) == []
    runs.resume(run_id)
    assert cluster.calls("scontrol") == [["requeue", "42_0"]]
    assert runs.summary(run_id).status == "queued"


@pytest.mark.parametrize(
    ("folder_says", "slurm_says", "shown"),
    [
        ("stopped", "PENDING||BeginTime", "queued"),  # preempted
        ("stopped", "COMPLETED||None", "stopped"),
        ("stopped", "RUNNING|n1|None", "stopped"),
        ("lost", "RUNNING|n1|None", "running"),  # its disk or network is slow
        ("lost", "NODE_FAIL||None", "lost"),
        ("failed", "FAILED||NonZeroExitCode", "failed"),
        ("finished", "PENDING||Priority", "finished"),
    ],
)
def test_what_slurm_knows_counts_where_the_folder_can_not_tell(
    cluster: Cluster, runs: Runs, folder_says: str, slurm_says: str, shown: str
) -> None:
    run_id = runs.start(StartRun(task="reacher"))
    end(runs.get(run_id).folder, "running" if folder_says == "lost" else folder_says)
    if folder_says == "lost":
        HeartbeatFile(runs.get(run_id).folder).write(
            Heartbeat("n1", 1, 0.0, time.time() - 999, "running", "learning", iteration=3, iterations=100)
        )
    cluster.say(t42_0=slurm_says)
    assert settled(runs, run_id)[0] == shown
    assert runs.summary(run_id).status == shown


def test_a_run_of_slurms_goes_back_to_slurm_whoever_resumes_it(
    cluster: Cluster, runs: Runs, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_id = runs.start(StartRun(task="reacher", iterations=9))
    end(runs.get(run_id).folder, "stopped")
    cluster.say(t42_0="COMPLETED||None")
    Runs(runs.folder, never).resume(run_id)
    cluster.say(t42_0="")
    monkeypatch.setattr("studio.cli.train.spawn_trainer", never)
    assert run(["train", "--runs", str(runs.folder), "--resume", run_id]) == 0
    assert f"{run_id} is queued" in capsys.readouterr().err
    assert "--partition=short" in cluster.calls("sbatch")[-1]
    cluster.say(t43_0="COMPLETED||None")
    assert run(["train", "--runs", str(runs.folder), "--resume", run_id, "--iterations", "5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "queued"
    assert "--until" in cluster.calls("sbatch")[-1]
    cluster.say(t44_0="")
    cluster.refuse(sbatch=["no"])
    assert run(["train", "--runs", str(runs.folder), "--resume", run_id]) == 2
    assert "remove" in capsys.readouterr().err


@pytest.mark.parametrize("by_command_line", [True, False])
@pytest.mark.parametrize("said", [[Pause()], [Pause(), Stop()], []])
def test_who_resumes_a_run_takes_its_pause_back(
    cluster: Cluster, runs: Runs, said: list[AnyCommand], by_command_line: bool
) -> None:
    run_id = runs.start(StartRun(task="reacher", iterations=9))
    folder = runs.get(run_id).folder
    log = EventLog(folder)
    for number, command in enumerate(said, start=1):
        log.append(Acknowledged(id=number, iteration=0, accepted=True, command=command))
    log.close()
    end(folder, "stopped")
    cluster.say(t42_0="COMPLETED||None")
    if by_command_line:
        assert run(["train", "--runs", str(runs.folder), "--resume", run_id]) == 0
    else:
        Runs(runs.folder, never).resume(run_id)
    taken_back = [order.command for _, order in folder.pending() if order]
    assert taken_back == ([Resume()] if said == [Pause()] else [])


def test_the_list_of_runs_says_which_wait(runs: Runs, capsys: pytest.CaptureFixture[str]) -> None:
    run_id = runs.start(StartRun(task="reacher"))
    assert run(["runs", "--runs", str(runs.folder), "--json"]) == 0
    [line] = json.loads(capsys.readouterr().out)
    assert (line["id"], line["status"]) == (run_id, "queued")
    assert "other jobs come first" in line["reason"]


def test_showing_runs_never_waits_for_slurm(cluster: Cluster, runs: Runs) -> None:
    run_id = runs.start(StartRun(task="reacher"))
    slow = cluster.path / "bin" / "squeue"
    slow.write_text("#!/bin/sh\nsleep 5\n")
    runs._slurm._queue.forget()
    began = time.monotonic()
    assert runs.status(runs.get(run_id))[0] == "queued"
    assert time.monotonic() - began < 2


async def up_and_down(app: FastAPI) -> None:
    async with app.router.lifespan_context(app):
        pass


@pytest.mark.usefixtures("cluster")
def test_a_server_for_a_cluster_keeps_no_trainer_in_reserve(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[bool] = []
    monkeypatch.setattr(Reserve, "load", lambda _: loaded.append(True))
    for launcher, expected in ((Slurm(), []), (None, [True])):
        app = create_app(
            settings, launcher=launcher, desks=lambda server, runs, what_ifs, *_: Blackboard(server, runs, what_ifs)
        )
        anyio.run(up_and_down, app)
        assert loaded == expected


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--launcher", "slurm", "--mem", "lots"], "K, M, G or T"),
        (["--launcher", "slurm", "--time", "soon"], "MINUTES"),
        (["--partition", "short"], "go with --launcher slurm"),
        (["--launcher", "condor"], "choose from: local, slurm"),
        (["--launcher", "slurm"], "Slurm refuses: no"),
    ],
)
def test_a_server_is_not_started_with_what_slurm_would_refuse(
    cluster: Cluster, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.refuse(sbatch=["no"])
    assert run(["serve", *words]) == 2
    assert said in capsys.readouterr().err
