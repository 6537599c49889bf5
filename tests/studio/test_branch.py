"""Branches and logs in the studio: what can be wished for, what is refused, and how both are shown everywhere."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import psutil
import pytest
from conftest import TINY, Served, make_run

from morph_core.catalogue import SEARCHES, make_method, make_task
from morph_core.config import flattened, paths_of
from morph_core.history import History
from morph_core.origin import origin_at
from morph_core.protocol import AnyCommand, Parameter, Parent, RunRecord
from morph_core.run_folder import RunFolder
from studio.cli import run
from studio.new_run import Branch, StartRun, method_at, prepare_run, resettled
from studio.trainers import spawn_trainer

TASK = make_task("reacher")


def branched(parent: RunFolder, iteration: int | None = None, **wishes: Any) -> RunRecord:
    wish = StartRun(branch=Branch(parent.id, iteration), **wishes)
    return prepare_run(parent.path.parent, wish).record()


# --- what a branch is -------------------------------------------------------------------------------------------------


def test_a_branch_is_like_its_parent_in_all_that_is_not_wished_for(parent: RunFolder) -> None:
    theirs, ours = parent.record(), branched(parent, 2)
    for name in ("task", "task_options", "method", "seed", "iterations", "env_steps"):
        assert getattr(ours, name) == getattr(theirs, name), name
    assert ours.parent == Parent(parent.id, 2, 2)
    assert ours.begins_at == 2
    assert flattened(ours.config) == flattened(theirs.config) | {"alpha": 2.5}  # as it was in force
    assert [p.initial for p in ours.parameters] == History(parent).progress[1].phi
    assert ours.parameters[4].locked_at == 2.75
    assert {p.name: (p.lo, p.hi) for p in ours.parameters} == {p.name: (p.lo, p.hi) for p in theirs.parameters}


def test_a_branch_takes_the_checkpoint_along_and_leaves_its_parent_as_it_is(parent: RunFolder) -> None:
    before = {path: path.stat().st_mtime_ns for path in parent.path.rglob("*")}
    folder = prepare_run(parent.path.parent, StartRun(branch=Branch(parent.id, 3)))
    after = {path: path.stat().st_mtime_ns for path in parent.path.rglob("*")}
    pins = {parent.path / "pins", parent.path / "pins" / "000002"}  # the checkpoint stays for as long as the parent
    assert after.keys() - before.keys() == pins
    assert all(after[path] == time for path, time in before.items() if path != parent.path)
    inside = folder.path / "origin" / parent.id
    assert (inside / "run.json").read_bytes() == (parent.path / "run.json").read_bytes()
    for name in ("state.json", "weights.safetensors"):
        taken = inside / "checkpoints" / "000002" / name
        assert taken.read_bytes() == (parent.checkpoint(2) / name).read_bytes()
    assert folder.record().parent == Parent(parent.id, 3, 2)


def test_what_is_wished_for_is_laid_over_the_parent(parent: RunFolder) -> None:
    wider = msgspec.structs.replace(branched(parent).parameters[0], lo=0.5, hi=4.5)
    free = msgspec.structs.replace(branched(parent).parameters[4], locked_at=None)
    ours = branched(parent, seed=9, settings={"alpha": 0.25}, parameters=[wider, free], final_episodes=8)
    assert (ours.seed, ours.config["alpha"], ours.final_episodes) == (9, 0.25, 8)
    assert (ours.parameters[0].lo, ours.parameters[0].hi, ours.parameters[4].locked_at) == (0.5, 4.5, None)
    assert ours.config["hidden"] == 8


def test_a_branch_can_begin_with_another_phi(parent: RunFolder) -> None:
    moved = msgspec.structs.replace(branched(parent).parameters[0], initial=1.5)
    ours, theirs = branched(parent, parameters=[moved]), branched(parent)
    assert [p.initial for p in ours.parameters] == [1.5, *(p.initial for p in theirs.parameters[1:])]


def test_another_method_counts_from_0_with_its_own_settings(parent: RunFolder) -> None:
    ours = branched(parent, method="direct", settings={"step": 2})
    assert (ours.method, ours.begins_at, ours.iterations) == ("direct", 0, 4)
    assert ours.config["step"] == 2.0
    assert ours.config["hidden"] == make_method("direct", TASK).hidden


def test_a_preset_is_laid_over_nothing_of_the_parent(parent: RunFolder) -> None:
    ours = branched(parent, preset="paper")
    assert flattened(ours.config) == dict(paths_of(make_method(None, TASK, preset="paper")))
    assert ours.begins_at == 4


@pytest.mark.parametrize("search", list(SEARCHES))
def test_another_search_has_what_was_found_to_work_and_the_rest_stays(parent: RunFolder, search: str) -> None:
    before = method_at(origin_at(History(parent)))
    after = resettled(before, TASK, {"search": search})
    settled = dict(paths_of(after))
    assert settled["search"] == search
    rest = {path: value for path, value in paths_of(before) if not path.startswith("search")}
    assert {path: settled[path] for path in rest} == rest


@pytest.mark.parametrize(
    ("wish", "iterations", "env_steps"),
    [
        ({}, 4, None),
        ({"iterations": 7}, 9, None),
        ({"env_steps": 10_000}, 10_000, 10_000),
        ({"env_steps": 10_000, "iterations": 3}, 5, 10_000),
    ],
)
def test_how_long_a_branch_goes_on(
    parent: RunFolder, wish: dict[str, Any], iterations: int, env_steps: int | None
) -> None:
    ours = branched(parent, 2, **wish)
    assert (ours.iterations, ours.env_steps) == (iterations, env_steps)


def test_a_branch_of_the_end_goes_on_for_a_hundred_iterations_and_a_budget_is_kept_while_it_lasts(
    parent: RunFolder,
) -> None:
    assert branched(parent).iterations == 104
    spent = History(parent).progress[-1].env_steps
    for budget, expected in ((spent, None), (spent + 1, spent + 1)):
        record = msgspec.structs.replace(parent.record(), env_steps=budget, iterations=999)
        (parent.path / "run.json").write_bytes(msgspec.json.encode(record))
        ours = branched(parent)
        assert (ours.env_steps, ours.iterations) == (expected, 999 if expected else 104)


EXCLUDED = Parameter("link_1", "m", 0.05, 0.1, 3.0, 0.05, 5.0)


@pytest.mark.parametrize(
    ("branch", "wish", "sentence"),
    [
        ({"run": "nobody"}, {}, 'unknown run "nobody"; choose from: '),
        ({"run": "../x"}, {}, "is no run name"),
        ({"iteration": 5}, {}, "has no iteration 5; choose 0 to 4"),
        ({}, {"task": "pen_press"}, "is a run of the task reacher: a branch of it can't be one of pen_press"),
        ({}, {"task_options": {"tunnel": "zigzag"}}, "keeps the options of its parent's task, which are .*paper"),
        (
            {},
            {"parameters": [EXCLUDED]},
            r"the initial link_1 must lie inside \[0.05, 0.1\] m, not 3 at iteration 4 of",
        ),
        ({}, {"method": "magic"}, "choose from: morph"),
        ({}, {"settings": {"search.ridge": 1.0}}, "does nothing with search cma"),
        ({}, {"settings": {"alpha": [1]}}, "alpha must be a number"),
        ({}, {"seed": -1}, "seed must be a whole number"),
        ({}, {"iterations": 0}, "iterations must be a whole number from 1"),
        ({}, {"env_steps": 1}, "env_steps must be above the .* that the branch has behind it, not 1"),
        ({}, {"parent": Parent("other", 1)}, "leave out parent"),
    ],
)
def test_a_branch_that_can_not_be_is_refused_in_words_and_not_made(
    parent: RunFolder, branch: dict[str, Any], wish: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        prepare_run(parent.path.parent, StartRun(branch=Branch(**{"run": parent.id, **branch}), **wish))
    assert [path.name for path in parent.path.parent.iterdir()] == [parent.id]


def test_a_damaged_checkpoint_and_another_task_of_the_same_name_are_refused(parent: RunFolder) -> None:
    facts = parent.checkpoint(4) / "state.json"
    sound = json.loads(facts.read_text())
    facts.write_text("{")
    with pytest.raises(
        ValueError, match=f"checkpoint 4 of {parent.id} can't be read: .*the one before is of iteration 2"
    ):
        branched(parent)
    assert branched(parent, 3).begins_at == 2
    sound["parameters"][0]["name"] = "shoulder"
    del sound["sha256"]
    facts.write_text(json.dumps(sound))
    with pytest.raises(ValueError, match="another version of reacher: its design parameters were shoulder, link_2"):
        branched(parent)


def test_a_run_of_format_1_is_branched_from(tmp_path: Path) -> None:
    old = Path(__file__).parents[1] / "data" / "format_1" / "reacher-morph"
    shutil.copytree(old, tmp_path / "old")
    record = branched(RunFolder(tmp_path / "old"))
    assert (record.format, record.begins_at, record.parent) == (2, 4, Parent("old", 4, 4))
    assert [p.initial for p in record.parameters] == History(RunFolder(old)).phi.tolist()


def test_a_task_or_a_branch_is_needed(runs_folder: Path) -> None:
    with pytest.raises(ValueError, match="a task is missing, or a run to branch from"):
        prepare_run(runs_folder, StartRun())


# --- the API ----------------------------------------------------------------------------------------------------------


def test_a_branch_is_started_linked_and_logged_by_the_api(served: Served, trained: RunFolder) -> None:
    shutil.copytree(trained.path, served.runs.folder / trained.id)
    made = served.client.post("/api/runs", json={"branch": {"run": trained.id, "iteration": 3}, "method": "direct"})
    assert made.status_code == 201, made.text
    child = made.json()
    assert child["parent"] == {"run": trained.id, "iteration": 3, "checkpoint": 2}
    assert (child["method"], child["begins_at"]) == ("direct", 0)
    assert served.client.get(f"/api/runs/{trained.id}").json()["children"] == [child["id"]]
    listed = {line["id"]: line["parent"] for line in served.client.get("/api/runs").json()}
    assert listed == {trained.id: None, child["id"]: child["parent"]}
    log = served.client.get(f"/api/runs/{trained.id}/log").json()
    assert (log[1]["words"], log[1]["sender"], log[1]["command"]["alpha"]) == (
        "α set to 2.5, in force from iteration 1", "a test", 2.5
    )  # fmt: skip


@pytest.mark.parametrize(
    ("body", "status", "sentence"),
    [
        ({"branch": {"run": "nobody"}}, 404, "unknown run"),
        ({"branch": {"run": "ended", "iteration": -1}}, 422, ">= 0"),
        ({"branch": {"run": "ended", "iteration": 4}}, 404, "choose 0 to 3"),
        ({"branch": {"iteration": 4}}, 422, "run"),
        ({"branch": {"run": "ended"}, "task": "pen_press"}, 422, "can't be one of pen_press"),
    ],
)
def test_the_api_refuses_a_branch_in_words(served: Served, body: object, status: int, sentence: str) -> None:
    make_run(served.runs.folder, "ended")
    answer = served.client.post("/api/runs", json=body)
    assert answer.status_code == status
    assert sentence in answer.json()["detail"]
    assert served.runs.ids() == ["ended"]


def test_the_api_names_its_caller_to_the_log(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    run_id = served.client.post("/api/runs", json={"task": "reacher"}).json()["id"]
    sent: list[str] = []

    def send(_run: str, _command: AnyCommand, sender: str = "") -> int:
        sent.append(sender)
        return 1

    monkeypatch.setattr(served.runs, "send", send)
    served.client.post(f"/api/runs/{run_id}/commands", json={"type": "pause"})
    assert sent == ["API, 127.0.0.1"]


# --- the command line -------------------------------------------------------------------------------------------------


@pytest.fixture
def words(parent: RunFolder, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run a command on the folder of the parent; return its exit status and what it says."""

    def said(*command: str) -> tuple[int, str, str]:
        code = run([*command, "--runs", str(parent.path.parent)])
        heard = capsys.readouterr()
        return code, heard.out, heard.err

    return said


def test_runs_are_printed_as_a_tree(parent: RunFolder, words: Callable[..., tuple[int, str, str]]) -> None:
    child = branched(parent, 3)
    code, out, _ = words("runs", "--tree")
    assert code == 0
    first, second = out.splitlines()
    assert first.startswith(f"{parent.id}  finished, iteration 4")
    assert second.startswith(f"└── {child.id}  from iteration 2, asked for 3, ")
    listed = {line["id"]: line["parent"] for line in json.loads(words("runs", "--json")[1])}
    assert listed[child.id] == {"run": parent.id, "iteration": 3, "checkpoint": 2}


def test_the_log_is_printed_as_a_table_and_as_json(
    parent: RunFolder, words: Callable[..., tuple[int, str, str]]
) -> None:
    code, out, _ = words("log", parent.id)
    assert code == 0
    assert out.splitlines()[2].split()[0] == "0"
    assert "α set to 2.5, in force from iteration 1" in out.splitlines()[2]
    assert out.splitlines()[2].rstrip().endswith("a test")
    assert [entry["accepted"] for entry in json.loads(words("log", parent.id, "--json")[1])].count(False) == 1
    assert words("log", "nobody")[2].startswith('morph-studio: unknown run "nobody"; choose from: ')


@pytest.mark.slow
def test_a_replay_is_compared_and_a_difference_reported(
    parent: RunFolder, words: Callable[..., tuple[int, str, str]]
) -> None:
    code, out, _ = words("replay", parent.id, "--check")
    assert (code, out) == (0, f"{parent.id}: 4 iterations replayed, phi is the same to the last bit\n")
    record = parent.record()
    changed = msgspec.structs.replace(record, seed=6, versions=record.versions | {"numpy": "0.1"})
    (parent.path / "run.json").write_bytes(msgspec.json.encode(changed))
    code, out, _ = words("replay", parent.id, "--check", "--json")
    found = json.loads(out)
    assert (code, found["difference"]["iteration"]) == (1, 1)
    assert found["difference"]["recorded"] == History(parent).progress[0].phi
    assert found["other_versions"]["numpy"][0] == "0.1"
    assert found["other_processors"] == []


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (("replay", "{run}"), "replay: give one of --check"),
        (("replay", "{run}", "--check", "--until", "9"), "must be an iteration of .* (1 to 4), not 9"),
        (("train", "--branch", "{run}@9"), "has no iteration 9; choose 0 to 4"),
        (("train", "--branch", "{run}@two"), "RUN or RUN@ITERATION, with a whole number"),
        (("train", "--branch", "nobody@2"), 'unknown run "nobody"'),
        (("train", "--branch", "{run}", "--resume", "{run}"), "choose one of --resume"),
        (("train", "mouse_click", "--branch", "{run}"), "can't be one of mouse_click"),
        (("train", "--branch", "{run}", "--bounds", "link_1=0.05:0.1"), "the initial link_1 must lie inside"),
        (("train", "--branch", "{run}", "--bounds", "link_1"), "bounds are NAME=LO:HI"),
        (("train", "--branch", "{run}", "--lock", "link_1=x"), "a lock is NAME or NAME=VALUE"),
        (("train", "--branch", "{run}", "--unlock", "link_9"), 'unknown design parameter "link_9"'),
        (("train", "--branch", "{run}", "--search.ridge", "1"), "does nothing with search cma"),
        (("train", "--resume", "{run}", "--lock", "link_1"), "keeps what it was started with: leave out --lock"),
    ],
)
def test_the_command_line_refuses_in_a_line_and_starts_nothing(
    parent: RunFolder, words: Callable[..., tuple[int, str, str]], command: tuple[str, ...], sentence: str
) -> None:
    code, out, err = words(*(word.replace("{run}", parent.id) for word in command))
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert sentence.replace(".*", parent.id) in err
    assert [path.name for path in parent.path.parent.iterdir()] == [parent.id]


def test_the_flags_of_a_branch_are_laid_over_its_parent(
    parent: RunFolder, words: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    followed: list[RunFolder] = []
    outcome = type("Outcome", (), {"code": 0})
    monkeypatch.setattr("studio.cli.train.follow", lambda folder, *_, **__: followed.append(folder) or outcome)
    code, _, err = words(
        "train", "--branch", f"{parent.id}@3", "--projection", "one_sided", "--bounds", "link_1=0.5:4.5",
        "--lock", "link_2", "--unlock", "link_5", "--iterations", "6",
    )  # fmt: skip
    assert code == 0
    assert f"begins at iteration 2 of {parent.id}, the nearest checkpoint up to iteration 3" in err
    (folder,) = followed
    ours, theirs = folder.record(), parent.record()
    assert flattened(ours.config) == flattened(theirs.config) | {"alpha": 2.5, "projection": "one_sided"}
    first, second, *_, last = ours.parameters
    assert (first.lo, first.hi, second.locked_at, last.locked_at) == (0.5, 4.5, second.initial, None)
    assert (ours.iterations, ours.seed, ours.task_options) == (8, 5, {"tunnel": "paper"})
    words("train", "--branch", parent.id, "--search", "drift", "--search.ridge", "0.3")
    assert followed[-1].record().config["search"]["ridge"] == 0.3  # pyright: ignore[reportIndexIssue]
    assert followed[-1].record().config["hidden"] == 8


# --- real processes ---------------------------------------------------------------------------------------------------


def wait_until(history: History, claim: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 100
    while not claim():
        assert time.monotonic() < deadline
        time.sleep(0.05)
        history.poll()


@pytest.mark.slow
def test_a_branch_that_was_killed_ends_where_its_parent_did_and_is_replayed(tmp_path: Path) -> None:
    parent = prepare_run(tmp_path, StartRun(task="reacher", iterations=12, settings=TINY))
    assert spawn_trainer(parent).wait(100) == 0
    theirs = {p.iteration: p.phi for p in History(parent).progress}
    child = prepare_run(tmp_path, StartRun(branch=Branch(parent.id, 5)))
    shutil.rmtree(parent.path)
    trainer, history = spawn_trainer(child), History(child)
    wait_until(history, lambda: history.iteration >= 7)
    trainer.kill()
    trainer.wait()
    assert spawn_trainer(child).wait(100) == 0
    history.poll()
    assert [p.iteration for p in history.progress] == list(range(5, 13))
    assert all(p.phi == theirs[p.iteration] for p in history.progress)

    command = [sys.executable, "-m", "studio.cli", "replay", str(child.path), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stdout.count("the same to the last bit")) == (0, 1), done.stderr
    stopped = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while not any("morph_core.replay" in child.cmdline() for child in psutil.Process(stopped.pid).children()):
        assert stopped.poll() is None
        time.sleep(0.05)
    stopped.send_signal(signal.SIGINT)
    said = stopped.communicate(timeout=30)[1]
    assert stopped.returncode == 130, said
    assert re.search(r"stopped: phi is the same up to iteration \d+", said)
