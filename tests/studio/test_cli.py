"""The command line: what it prints, what it refuses, and how it ends."""

import json
import os
import platform
import re
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import psutil
import pytest
from conftest import design_of, eventually, make_hand_run, stand_in

from morph_core.history import History
from morph_core.protocol import Evaluation, Heartbeat, InjectDesign, Progress, StateChanged, Status
from morph_core.run_folder import EventLog, HeartbeatFile, RunFolder, hold, list_runs
from studio.cli import COMMANDS, run
from studio.cli.evaluate import _print_result
from studio.cli.follow import Outcome, _in_short
from studio.cli.train import _document
from studio.new_run import StartRun, prepare_run
from studio.shelf.marks import Marks, write_marks
from tests import forked

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, "-m", "studio.cli"]
ENVIRONMENT = {k: v for k, v in os.environ.items() if k not in ("PORT", "MORPH_RUNS", "MORPH_TOKEN")} | {
    "PYTHONPATH": str(ROOT)
}
SMALL = ("--trajectories", "8", "--proxy.prefit", "5", "--evaluation.episodes", "4", "--search.generations", "2")


def morph_studio(*words: str, cwd: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    return forked.morph_studio(*words, cwd=cwd, environment=ENVIRONMENT | environment)


@pytest.fixture
def refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[list[str]], str]:
    """Run a command in this process, in an empty folder; return the one line with which it is refused."""
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.chdir(empty)
    for name in ("PORT", "MORPH_RUNS", "MORPH_TOKEN"):
        monkeypatch.delenv(name, raising=False)

    def refusal(words: list[str]) -> str:
        assert run(words) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert len(said.err.splitlines()) == 1, said.err
        assert list(empty.iterdir()) == [], "nothing was started"
        return said.err

    return refusal


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    """A hand-made run of two iterations out of five, the first the better one."""
    folder = prepare_run(tmp_path / "runs", StartRun(task="reacher", seed=3, iterations=5))
    log = EventLog(folder)
    log.append(StateChanged(status="running", iteration=0))
    for iteration, success in ((1, 0.75), (2, 0.5)):
        phi = [3.0, 2.0, 1.0, 0.5, float(iteration)]
        log.append(Progress(iteration=iteration, env_steps=9, phi=phi, episode_return=0, success=0, policy_std=0.5))
        log.append(
            Evaluation(
                iteration=iteration, env_steps=9, phi=phi, sampled_success=success, sampled_return=-1.5,
                deterministic_success=0, deterministic_return=0,
            )
        )  # fmt: skip
    log.append(StateChanged(status="stopped", iteration=2))
    log.close()
    return folder


def test_milestones_and_diverged_episodes_are_reported(tmp_path: Path) -> None:
    history = History(make_hand_run(tmp_path, "pen_press"))
    assert _in_short(history).startswith("success 0.25  lifted 0.75  pressed 0.50  return 0.00  phi 0.10 ")
    assert _in_short(history).endswith("  diverged 3")
    document = _document(history, Outcome(0, "finished", ""))
    assert document["relabelled_steps"] == 1024
    assert document["diverged"] == 3
    assert document["last_evaluation"]["milestones"] == {"lifted": 0.75, "pressed": 0.5}  # pyright: ignore[reportIndexIssue, reportOptionalSubscript]
    assert document["last_evaluation"]["diverged"] == 2  # pyright: ignore[reportIndexIssue, reportOptionalSubscript]


def test_an_evaluation_is_printed_with_what_came_before_success(capsys: pytest.CaptureFixture[str]) -> None:
    score = {"success": 0.25, "success_interval": [0.07, 0.59], "episode_return": -1.0, "return_interval": [-1.5, -0.5]}
    score |= {"milestones": {"lifted": 0.75}, "diverged": 0}
    result = {
        "run": "r",
        "iteration": 3,
        "policy_iteration": 3,
        "episodes": 8,
        "phi": {"length_1": 0.2},
        "sampled": score,
    }
    _print_result(result | {"deterministic": score})
    assert capsys.readouterr().out.splitlines()[1].split() == [
        "policy,", "8", "episodes", "success", "[95", "%]", "lifted", "return", "[95", "%]"
    ]  # fmt: skip
    _print_result(result | {"deterministic": score | {"diverged": 2}})
    heading, *rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert heading[-1] == "diverged"
    scores = ["0.250", "[0.07,", "0.59]", "0.750", "-1.000", "[-1.50,", "-0.50]"]
    assert rows == [["sampled", *scores, "0"], ["deterministic", *scores, "2"]]
    _print_result(result | {"deterministic": score, "iteration": 5})
    assert "iteration 5 has no checkpoint: the policy is that of iteration 3" in capsys.readouterr().out


def test_help_lists_the_commands_within_a_second() -> None:
    before = os.times()
    done = subprocess.run([*COMMAND, "--help"], capture_output=True, text=True, cwd=ROOT, env=ENVIRONMENT, check=True)
    assert [line.split()[0] for line in done.stdout.splitlines() if line.startswith("  ")] == [
        "serve", "train", "study", "runs", "stop", "log", "replay", "evaluate", "compare", "export", "verify", "show",
        "import",
    ]  # fmt: skip
    after = os.times()
    assert after.children_user + after.children_system - before.children_user - before.children_system < 1.0


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str) -> None:
    done = morph_studio(command, "--help")
    assert done.returncode == 0
    assert f"usage: morph-studio {command}" in done.stdout
    assert ("--runs DIR" in done.stdout) is (command not in ("verify", "study"))  # an export lies anywhere


def test_the_settings_of_run_and_task_are_flags_with_their_explanation() -> None:
    shown = morph_studio("train", "reacher", "--help").stdout
    for flag in ("--alpha", "--projection", "--design-interval", "--tunnel", "--z", "--seed", "--resume"):
        assert flag in shown
    assert "weight of the divergence" in shown


def test_the_help_of_train_lists_the_tasks() -> None:
    shown = " ".join(re.sub("[│]", "", morph_studio("train", "--help").stdout).split())
    assert "Choose from: reacher, pen_press, mouse_click" in shown


def test_the_command_line_does_not_load_torch() -> None:
    code = (
        "import sys, studio.cli.train, studio.cli.evaluate, studio.cli.export, studio.cli.runs, studio.cli.serve;"
        "import studio.cli.verify, studio.cli.study, studio.cli.import_design, studio.export.bundle;"
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=ENVIRONMENT, timeout=60).returncode == 0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            "brew",
            f"choose from: {', '.join(COMMANDS)}",
        ),
        ("train", "choose from: reacher, pen_press, mouse_click"),
        ("train reacher --env-steps 0", "env_steps must be a whole number from 1 to 1000000000000, not 0"),
        ("train reacher --env-steps 0.5", "not 0.5"),
        ("train reech", 'unknown task "reech"; choose from: reacher, pen_press, mouse_click'),
        (
            "train reacher --search drift --search.sigma0 1",
            '"search.sigma0" does nothing with search drift, only with cma',
        ),
        ("train reacher extra", "too many words: extra"),
        ("train reacher --alhpa 1", "did you mean --alpha?"),
        ("train reacher --alhpa 1", "choose from: --runs --iterations --env-steps --resume"),
        (
            "train reacher --method sgd",
            "choose from: morph, cmaes_rl, direct, no_hw_opt, transform2act, value_gradient",
        ),
        ("train reacher --preset letter", '--preset can\'t be "letter"; choose from: paper, studio'),
        ("train reacher --preset paper --method direct", "one of the method morph, not of direct"),
        ("train reacher --projection both", "choose from: none, one_sided, as_printed"),
        ("train reacher --tunnel straight", "choose from: zigzag, paper"),
        (
            "train pen_press --servo-limits XM43",
            'can\'t be "XM43" (did you mean XM430-W350?); choose from: none',
        ),
        ("train reacher --alpha nan", "alpha must be finite, not nan"),
        ("train reacher --alpha inf", "alpha must be finite, not inf"),
        ("train reacher --alpha -1", "alpha must lie in [0, 1000000]"),
        ("train reacher --alpha x", "--alpha: 'x' is no number"),
        ("train reacher --alpha", "--alpha needs a value"),
        ("train reacher --trajectories 7", "trajectories must be a multiple of 2"),
        ("train reacher --goal-bonus nan", "goal_bonus must be finite"),
        ("train reacher --iterations 0", "--iterations must be a whole number from 1 to 1000000, not 0"),
        ("train reacher --iterations x", "'x' is no whole number"),
        ("train reacher --seed -1", "seed must be a whole number from 0"),
        ("train --resume nope", 'unknown run "nope"'),
        ("train --resume ../nope", "has no run.json"),
        ("evaluate", "RUN is missing"),
        ("evaluate nope", 'unknown run "nope"'),
        ("export nope", 'unknown run "nope"'),
        ("serve --port 99999", "0 to 65535"),
        ("serve --port x", "'x' is no whole number"),
        ("serve --host 0.0.0.0", "without a token"),
    ],
)
def test_what_is_not_possible_is_refused_in_one_line(
    refused: Callable[[list[str]], str], words: str, sentence: str
) -> None:
    assert sentence in refused(words.split())


def test_a_refusal_exits_with_2_and_no_traceback(tmp_path: Path) -> None:
    done = morph_studio("train", "reacher", "--alpha", "nan", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "morph-studio: train: alpha must be finite, not nan\n"


def test_a_refusal_does_not_say_a_word_without_end_again(refused: Callable[[list[str]], str]) -> None:
    said = refused(["stop", "x" * 100_000])
    assert "x" * 70 in said
    assert len(said) < 200


def test_a_bad_port_in_the_environment_is_refused(
    refused: Callable[[list[str]], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PORT", "eighty")
    assert "PORT must be a whole number" in refused(["serve"])


def test_runs_lists_every_folder_and_says_why_one_is_unreadable(folder: RunFolder) -> None:
    (folder.path.parent / "holiday-pictures").mkdir()
    shown = morph_studio("runs", "--runs", str(folder.path.parent))
    assert shown.returncode == 0
    row = next(line.split() for line in shown.stdout.splitlines() if line.startswith(folder.id))
    assert row == [folder.id, "reacher", "morph", "3", "stopped", "2/5", "0.50", "0.75", "at", "1"]
    assert "holiday-pictures has no run.json: not a run folder" in shown.stdout
    listed = {
        line["id"]: line
        for line in json.loads(morph_studio("runs", "--runs", str(folder.path.parent), "--json").stdout)
    }
    assert listed[folder.id]["best"] == {
        "iteration": 1, "success": 0.75, "episode_return": -1.5, "milestones": {}
    }  # fmt: skip
    assert listed["holiday-pictures"]["status"] == "unreadable"


def test_an_empty_folder_has_no_runs(tmp_path: Path) -> None:
    assert "no runs" in morph_studio("runs", cwd=tmp_path).stdout
    assert json.loads(morph_studio("runs", "--json", cwd=tmp_path).stdout) == []


def test_runs_shows_what_people_have_noted_and_leaves_archived_ones_out(folder: RunFolder) -> None:
    runs = folder.path.parent
    write_marks(folder.path, Marks(starred=True, name="[b]Long fingers[/b]", tags=("to print",)))
    archived = prepare_run(runs, StartRun(task="reacher", seed=4))
    write_marks(archived.path, Marks(archived=True))

    def listed(*words: str) -> list[str]:
        return [line["id"] for line in json.loads(morph_studio("runs", "--runs", str(runs), "--json", *words).stdout)]

    shown = morph_studio("runs", "--runs", str(runs)).stdout
    assert "★ [b]Long fingers[/b] #to print" in shown
    assert archived.id not in shown
    assert listed() == listed("--starred") == listed("--tag", "to print") == [folder.id]
    assert listed("--archived", "only") == [archived.id]
    assert set(listed("--archived", "show")) == {folder.id, archived.id}
    assert listed("--tag", "other") == []
    none = morph_studio("runs", "--runs", str(runs), "--tag", "other", "--starred").stdout
    assert re.search(r'none of the 2 runs in .* is listed: none is starred and tagged "other"; archived ones', none)
    assert "(archived)" in morph_studio("runs", "--runs", str(runs), "--archived", "show").stdout


def test_the_folder_of_runs_may_come_from_the_environment(folder: RunFolder, tmp_path: Path) -> None:
    assert folder.id in morph_studio("runs", cwd=tmp_path, MORPH_RUNS=str(folder.path.parent)).stdout


def test_a_name_with_square_brackets_is_no_markup(folder: RunFolder) -> None:
    folder.path.rename(folder.path.with_name("[bold]x"))
    (folder.path.parent / "a[red]").mkdir()
    assert morph_studio("runs", "--runs", str(folder.path.parent)).returncode == 0


@pytest.mark.parametrize("by_path", [False, True])
def test_export_writes_the_chosen_design(folder: RunFolder, tmp_path: Path, by_path: bool) -> None:
    run = [str(folder.path)] if by_path else [folder.id, "--runs", str(folder.path.parent)]
    done = morph_studio("export", *run, "--design", "2", "--out", str(tmp_path / "arm.zip"))
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == str(tmp_path / "arm.zip")
    with zipfile.ZipFile(tmp_path / "arm.zip") as archive:
        design = json.loads(archive.read("design.json"))
        assert {"robot.xml", "robot.urdf"} < set(archive.namelist())
    assert [p["value"] for p in design["parameters"]] == [3.0, 2.0, 1.0, 0.5, 2.0]


def test_an_export_without_a_place_goes_into_the_run(folder: RunFolder) -> None:
    done = morph_studio("export", str(folder.path), "--formats", "urdf")
    assert Path(done.stdout.strip()) == folder.exports / f"{folder.id}-best-000001.zip"
    with zipfile.ZipFile(done.stdout.strip()) as archive:
        assert "robot.xml" not in archive.namelist()


@pytest.mark.slow
def test_a_design_from_a_bundle_is_shown_and_starts_a_run(folder: RunFolder, tmp_path: Path) -> None:
    bundle = morph_studio("export", str(folder.path), "--formats", "urdf").stdout.strip()
    shown = morph_studio("import", bundle)
    assert shown.returncode == 0
    assert shown.stdout.startswith(f"reacher, iteration 1 of {folder.id}\n  link_1 = ")
    words = ["--iterations", "1", "--seed", "5", "--method", "no_hw_opt", "--runs", str(tmp_path / "new")]
    done = morph_studio("import", bundle, "--start", *words)
    assert done.returncode == 0, done.stderr
    [started] = (tmp_path / "new").iterdir()
    record = History(RunFolder(started)).record
    assert (record.seed, record.method, record.iterations) == (5, "no_hw_opt", 1)
    assert [p.initial for p in record.parameters] == History(folder).design("best")[1].tolist()


def test_a_design_is_handed_to_a_run_that_is_at_work_and_to_no_other(folder: RunFolder, tmp_path: Path) -> None:
    path = tmp_path / "design.json"
    path.write_bytes(msgspec.json.encode(design_of(History(folder), [1.0, 1.0, 1.0, 1.0, 2.0])))
    done = morph_studio("import", str(path), "--into", str(folder.path))
    assert done.returncode == 2
    assert "stopped" in done.stderr
    assert list(folder.pending()) == []
    process = stand_in(folder)
    try:
        assert eventually(lambda: History(folder).status == "running")
        sent = morph_studio("import", str(path), "--into", str(folder.path))
        assert sent.returncode == 0, sent.stderr
        assert eventually(lambda: [a.command for a in History(folder).acknowledged] == [InjectDesign([1, 1, 1, 1, 2])])
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("export RUN --formats dwg", "choose from: mjcf, urdf, stl, 3mf, glb, step"),
        ("export RUN --formats", "choose from: mjcf, urdf"),
        ("export RUN --servo XM430-W350", "the torques of its joints are not simulated"),
        ("export RUN --printer prusa", "choose from: bambu_a1_mini, bambu_x1c"),
        ("export RUN --printer 20x300x300", "has a side outside 50 to 2000 mm"),
        ("export RUN --formats mjcf --printer prusa_xl", "a printer is for the format 3mf, and the formats are: mjcf"),
        ("export RUN --design 9", "choose best, latest or 0 to 2"),
        ("export RUN --design newest", "choose best, latest or an iteration"),
        ("evaluate RUN --design 9", "choose best, latest or 0 to 2"),
        ("evaluate RUN --episodes 0", "--episodes must be a whole number from 1 to 100000, not 0"),
        ("evaluate RUN --phi 1 2", "--phi: phi has 2 entries; 5 are needed: link_1"),
        ("evaluate RUN --phi link_1=9", "link_1 must lie inside [0.05, 5] m, not 9"),
        ("evaluate RUN --phi link_1=-1", "link_1 must lie inside [0.05, 5] m, not -1"),
        ("evaluate RUN --phi link_1=nan", "link_1 must be finite"),
        ("evaluate RUN --phi lnk_1=1", '(did you mean "link_1"?)'),
        ("evaluate RUN --phi link_1=long", '"long" is no number'),
        ("evaluate RUN --phi link_1=1 link_1=2", "named twice"),
        ("evaluate RUN --phi link_1=1 2 3 4 5", "not both"),
        ("evaluate RUN --phi link_1=1 --phi-from nowhere.json", "choose one of --phi and --phi-from"),
        ("evaluate RUN --phi link_1=1", "no checkpoint up to iteration 1"),
        ("evaluate RUN --phi", "--phi"),
        ("evaluate RUN --phi-from nowhere.json", "nowhere.json can't be read"),
        ("import nowhere.json --into RUN", "nowhere.json can't be read"),
        ("import RUN --into RUN --start", "choose one of --into RUN and --start"),
        ("train --resume RUN --alpha 2 --seed 4", "leave out --seed, --alpha"),
        ("train --resume RUN --method direct", "leave out --method"),
        ("train --resume RUN --preset paper", "leave out --preset"),
        ("train --resume RUN --z tip", "leave out --z"),
        ("train --resume RUN --iterations 0", "--iterations must be a whole number from 1 to 1000000, not 0"),
        ("train pen --resume RUN", "a run of the task reacher, not pen"),
    ],
)
def test_what_this_run_does_not_allow_is_refused_in_one_line(
    refused: Callable[[list[str]], str], folder: RunFolder, words: str, sentence: str
) -> None:
    assert sentence in refused(words.replace("RUN", str(folder.path)).split())


def beat(folder: RunFolder, pid: int, started: float) -> None:
    file = HeartbeatFile(folder)
    status: Status = "running"
    file.write(Heartbeat(platform.node(), pid, started, time.time(), status, "collecting", iteration=2, iterations=5))
    file.close()


def test_a_design_without_a_policy_is_not_evaluated(folder: RunFolder) -> None:
    done = morph_studio("evaluate", str(folder.path))
    assert (done.returncode, done.stdout) == (2, "")
    assert "no checkpoint" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_run_with_a_living_trainer_is_not_resumed(folder: RunFolder) -> None:
    beat(folder, os.getpid(), psutil.Process().create_time())
    done = morph_studio("train", "--resume", str(folder.path))
    assert done.returncode == 2
    assert "its trainer is at work" in done.stderr


def test_a_finished_run_wants_to_know_how_many_further_iterations(folder: RunFolder) -> None:
    log = EventLog(folder)
    for iteration in (3, 4, 5):
        log.append(
            Progress(iteration=iteration, env_steps=9, phi=[1.0] * 5, episode_return=0, success=0, policy_std=0.5)
        )
    log.close()
    done = morph_studio("train", "--resume", str(folder.path))
    assert done.returncode == 2
    assert "is done after 5 iterations: give --iterations M for M further ones" in done.stderr
    assert "--iterations M" in done.stderr


# --- with a real trainer ----------------------------------------------------------------------------------------------


def trained(runs: Path, *words: str) -> dict:
    done = morph_studio("train", *words, *SMALL * ("--resume" not in words), "--runs", str(runs), "--json")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return json.loads(done.stdout)


@pytest.mark.slow
def test_train_evaluate_export_and_resume_from_end_to_end(tmp_path: Path) -> None:
    first = trained(tmp_path, "reacher", "--iterations", "3", "--alpha", "2", "--z", "tip", "--seed", "5")
    assert (first["status"], first["iterations"], first["seed"]) == ("finished", 3, 5)
    assert list(first["phi"]) == [f"link_{i + 1}" for i in range(5)]
    assert first["last_evaluation"]["iteration"] == 3
    assert first["env_steps"] > 0
    assert first["cpu_seconds"] > 0
    record = History(RunFolder(Path(first["path"]))).record
    assert (record.config["alpha"], record.task_options, record.iterations) == (2.0, {"z": "tip"}, 3)

    done = morph_studio("evaluate", first["run"], "--runs", str(tmp_path), "--episodes", "3", "--json")
    result = json.loads(done.stdout)
    assert (result["iteration"], result["episodes"]) == (3, 3)
    assert 0 <= result["sampled"]["success"] <= 1
    design = tmp_path / "design.json"
    design.write_bytes(msgspec.json.encode(design_of(History(RunFolder(Path(first["path"]))), [3.0] * 5)))
    words = ["evaluate", first["run"], "--runs", str(tmp_path), "--episodes", "3", "--phi-from", str(design), "--json"]
    assert set(json.loads(morph_studio(*words).stdout)["phi"].values()) == {3.0}
    table = morph_studio("evaluate", first["run"], "--runs", str(tmp_path), "--episodes", "3").stdout
    assert "deterministic" in table

    assert "--iterations M" in morph_studio("train", "--resume", first["path"]).stderr
    further = trained(tmp_path, "reacher", "--resume", first["run"], "--iterations", "2")
    assert (further["run"], further["iterations"], further["status"]) == (first["run"], 5, "finished")
    assert further["cpu_seconds"] > first["cpu_seconds"]
    whole = trained(tmp_path, "reacher", "--iterations", "5", "--alpha", "2", "--z", "tip", "--seed", "5")
    assert whole["phi"] == further["phi"], "3 and 2 further iterations are 5, bit for bit"

    exported = morph_studio("export", first["run"], "--runs", str(tmp_path), "--design", "latest")
    assert zipfile.is_zipfile(exported.stdout.strip())


@pytest.fixture
def running(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], RunFolder]]:
    """A run that would take minutes, after its second iteration."""
    process = subprocess.Popen(
        [*COMMAND, "train", "reacher", *SMALL, "--iterations", "5000", "--runs", str(tmp_path)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=ENVIRONMENT,
    )  # fmt: skip
    trainer = 0
    try:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            for name in list_runs(tmp_path):
                history = History(RunFolder(tmp_path / name))
                trainer = history.heartbeat.pid if history.heartbeat else trainer
                if history.iteration >= 2:
                    yield process, history.folder
                    return
            time.sleep(0.1)
        raise AssertionError("no second iteration within a minute")
    finally:
        process.kill()
        if trainer and psutil.pid_exists(trainer):
            os.kill(trainer, signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_saves_stops_and_says_how_to_go_on(
    running: tuple[subprocess.Popen[str], RunFolder], number: signal.Signals
) -> None:
    process, folder = running
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    history = History(folder)
    assert history.status == "stopped"
    assert folder.checkpoint_iterations()[-1] == history.iteration
    assert f"morph-studio train --resume {folder.path}" in said
    assert "Traceback" not in said
    assert not History(folder).pulse.is_alive
    again = trained(folder.path.parent, "--resume", folder.id, "--iterations", "1")
    assert again["iterations"] == history.iteration + 1


@pytest.mark.slow
def test_a_second_ctrl_c_ends_the_trainer_at_once(running: tuple[subprocess.Popen[str], RunFolder]) -> None:
    process, folder = running
    beat = folder.heartbeat()
    assert beat is not None
    os.kill(beat.pid, signal.SIGSTOP)  # a trainer that would never come to the end of its iteration
    process.send_signal(signal.SIGINT)
    time.sleep(1)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "at once" in said
    assert not psutil.pid_exists(beat.pid)
    again = morph_studio("train", "--resume", str(folder.path), "--iterations", "1", "--json")
    assert again.returncode == 0, "the heartbeat of the dead trainer is no obstacle"


@pytest.mark.slow
def test_a_trainer_that_dies_is_reported_with_its_last_words(
    running: tuple[subprocess.Popen[str], RunFolder],
) -> None:
    process, folder = running
    beat = folder.heartbeat()
    assert beat is not None
    os.kill(beat.pid, signal.SIGKILL)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "killed by SIGKILL" in said
    assert f"--resume {folder.path}" in said


@pytest.mark.slow
def test_a_trainer_that_cannot_start_is_reported_with_the_reason(folder: RunFolder) -> None:
    with hold(folder):
        done = morph_studio("train", "--resume", str(folder.path), "--json")
    assert done.returncode == 1
    document = json.loads(done.stdout)
    assert (document["status"], document["iterations"]) == ("failed", 2)
    assert "held by another trainer" in document["message"]
    assert "held by another trainer" in done.stderr
