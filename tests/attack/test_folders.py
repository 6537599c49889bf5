"""A run folder from elsewhere is not trusted to be made of files: whatever stands in it, nothing outside is touched."""

import contextlib
import os
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from morph_core import durable, inside
from morph_core.checkpoint import recover_checkpoints, save_checkpoint
from morph_core.history import History
from morph_core.protocol import Progress, StateChanged, Stop
from morph_core.run_folder import (
    CHECKPOINT,
    EventLog,
    HeartbeatFile,
    RunFolder,
    RunFolderError,
    hold,
    read_episode,
    write_episode,
)
from morph_core.state import start
from morph_core.tasks.reacher import Reacher
from studio.runs import Runs
from studio.trainers import spawn_trainer
from tests.core.conftest import SMALL, make_run

FILES = (
    "run.json", "events.jsonl", "heartbeat.json", "trainer.lock", "trainer.log", "marks.json", "launch.json",
    "checkpoints", "commands", "episodes", "checkpoints/000002", "checkpoints/000002/weights.safetensors",
    "checkpoints/000002/state.json", "episodes/000002.npz", "commands/000001.json",
)  # fmt: skip
"""What a run folder is made of."""
STAND_INS = (
    "link", "link to a folder", "dangling link", "link to zeros", "pipe", "socket", "folder", "hard link", "huge"
)  # fmt: skip
"""What may stand in the place of any of them."""


def put(path: Path, kind: str, elsewhere: Path) -> None:
    """Put something else in the place of a file or folder of a run."""
    durable.shutil.rmtree(path, ignore_errors=True)
    path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True)
    match kind:
        case "link":
            path.symlink_to(elsewhere / "precious")
        case "link to a folder":
            path.symlink_to(elsewhere)
        case "dangling link":
            path.symlink_to(elsewhere / "not there")
        case "link to zeros":
            path.symlink_to("/dev/zero")
        case "pipe":
            os.mkfifo(path)
        case "socket":
            here = Path.cwd()
            os.chdir(path.parent)  # the address of a socket is short
            try:
                socket.socket(socket.AF_UNIX).bind(path.name)
            finally:
                os.chdir(here)
        case "folder":
            path.mkdir()
        case "hard link":
            os.link(elsewhere / "precious", path)
        case "huge":
            with path.open("wb") as file:
                file.truncate(1 << 40)


def everything(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"" for p in sorted(folder.rglob("*"))}


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Fail where the block takes longer, and let it have little memory: nothing waits and nothing reads without end."""
    began, limits = time.monotonic(), resource.getrlimit(resource.RLIMIT_AS)
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + (256 << 20), limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert time.monotonic() - began < seconds


def attempt(action: Callable[[], object]) -> None:
    """Do what a trainer or a reader does; what it refuses, it refuses with an error of ours or of the system."""
    with contextlib.suppress(ValueError, OSError):
        action()


def work(folder: RunFolder) -> None:
    """Do all that a trainer, a server and a reader write, read and delete."""
    attempt(lambda: EventLog(folder).append(StateChanged(status="running", iteration=0)))
    attempt(lambda: HeartbeatFile(folder))
    attempt(lambda: write_episode(folder, 2, {}))
    attempt(lambda: read_episode(folder, 2))
    attempt(lambda: folder.send(Stop()))
    attempt(lambda: list(folder.pending()))
    attempt(lambda: recover_checkpoints(folder))
    attempt(lambda: inside.touch(folder.path, "cancelled"))
    attempt(lambda: inside.open_plain(folder.path, "trainer.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND))

    def held() -> None:
        with hold(folder):
            save_checkpoint(folder, start(Reacher(), SMALL, 0), 0.0)

    attempt(held)


@pytest.mark.parametrize("kind", STAND_INS)
@pytest.mark.parametrize("name", FILES)
def test_nothing_in_a_run_folder_reaches_outside_of_it(tmp_path: Path, name: str, kind: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / ".ssh").mkdir(parents=True)
    (elsewhere / ".ssh" / "key").write_text("key")
    (elsewhere / ".config.old").mkdir()
    (elsewhere / "precious").write_text("precious")
    folder = make_run(tmp_path / "runs")
    put(folder.path / name, kind, elsewhere)
    before = everything(elsewhere)
    runs = Runs(tmp_path / "runs")
    with within(20):
        lines = runs.summaries()
        attempt(lambda: runs.evaluations("run"))
        attempt(lambda: runs.send("run", Stop()))
        work(folder)
    assert [line.id for line in lines] == ["run"]
    assert everything(elsewhere) == before


@pytest.mark.parametrize("kind", STAND_INS[:-1])
@pytest.mark.parametrize("name", ["run.json", "events.jsonl", "heartbeat.json"])
def test_one_bad_run_is_one_unreadable_row_that_says_why(tmp_path: Path, name: str, kind: str) -> None:
    make_run(tmp_path / "runs", "good")
    bad = make_run(tmp_path / "runs", "bad")
    (tmp_path / "precious").write_text("x")
    put(bad.path / name, kind, tmp_path)
    with within(10):
        rows = {line.id: line for line in Runs(tmp_path / "runs").rows()}
    assert rows["good"].status == "starting"
    if kind != "hard link":  # which is a file like any other for those who read
        assert rows["bad"].status == "unreadable" or (name, kind) == ("events.jsonl", "dangling link")
        assert name in rows["bad"].reason or rows["bad"].status != "unreadable"


BEAT = (
    '{"host":"%s","pid":%s,"process_started":%s,"time":%s,"status":"running","stage":"","iteration":1,"iterations":6}'
)
numbers = st.one_of(st.integers(-(2**70), 2**70), st.floats(allow_nan=False, allow_infinity=False))


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(pid=st.integers(-(2**70), 2**70), started=numbers, at=numbers, here=st.booleans(), junk=st.binary(max_size=40))
def test_any_heartbeat_and_any_line_leave_the_list_whole(
    tmp_path: Path, pid: int, started: float, at: float, here: bool, junk: bytes
) -> None:
    folder = RunFolder(tmp_path / "runs" / "bad")
    if not folder.path.exists():
        make_run(tmp_path / "runs", "good")
        make_run(tmp_path / "runs", "bad")
    host = os.uname().nodename if here else "elsewhere"
    (folder.path / "heartbeat.json").write_text(BEAT % (host, pid, started, at))
    folder.events.write_bytes(b'{"kind":"state","status":"running","iteration":0}\n' + junk + b"\n")
    lines = {line.id: line.status for line in Runs(tmp_path / "runs").summaries()}
    assert set(lines) == {"good", "bad"}
    assert lines["good"] == "starting"


@pytest.mark.parametrize("phi", [[1.0], [], [1.0] * 6])
def test_an_event_that_does_not_fit_the_run_makes_it_unreadable(tmp_path: Path, phi: list[float]) -> None:
    folder = make_run(tmp_path)
    EventLog(folder).append(
        Progress(iteration=1, env_steps=1, phi=phi, episode_return=0.0, success=0.0, policy_std=1.0)
    )
    with pytest.raises(RunFolderError, match="design parameters, and the run 5"):
        History(folder)


def test_a_run_without_parameters_is_unreadable(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    text = (folder.path / "run.json").read_text()
    begin = text.index('"parameters": [')
    end = text.index("]", begin)
    (folder.path / "run.json").write_text(text[:begin] + '"parameters": [' + text[end:])
    assert Runs(tmp_path).summaries()[0].reason.endswith("a run has at least one")


NAMES = st.text(st.sampled_from("0123456789abcdef.old draftSsh-"), min_size=1, max_size=24)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(names={".ssh", ".config.old", ".ssh.draft", ".notes.0a1b2c3d.draft", ".000004.mine.draft", ".draft"})
@given(names=st.sets(NAMES.map(lambda name: f".{name}"), max_size=6))
def test_only_drafts_are_deleted_by_name(tmp_path: Path, names: set[str]) -> None:
    parent = tmp_path / str(time.monotonic_ns())
    names = {name for name in names if name.strip(".") and "/" not in name}
    ours = {".000004.0a1b2c3d.draft", ".000005.draft"}
    for name in names | ours:
        (parent / name).mkdir(parents=True)
    durable.recover(parent, CHECKPOINT)
    assert {p.name for p in parent.iterdir()} >= {n for n in names if not n[1:].split(".")[0].isdigit()}
    assert not {p.name for p in parent.iterdir()} & ours


def test_a_folder_that_may_be_a_run_and_is_none_is_listed_with_the_reason(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "runs", "good")
    durable.shutil.copytree(folder.path, tmp_path / "runs" / "my run (copy)")
    durable.shutil.copytree(folder.path, tmp_path / "outside")
    (tmp_path / "runs" / "linked").symlink_to(tmp_path / "outside")
    (tmp_path / "runs" / "in a circle").symlink_to("in a circle")
    (tmp_path / "runs" / "to nowhere").symlink_to("nowhere")
    lines = {line.id: line for line in Runs(tmp_path / "runs").summaries()}
    assert set(lines) == {"good", "my run (copy)", "linked", "in a circle"}
    assert "rename it" in lines["my run (copy)"].reason
    assert "link to a folder elsewhere" in lines["linked"].reason
    assert "can't be looked into: Too many levels" in lines["in a circle"].reason


def test_one_run_that_hangs_keeps_no_other_waiting(tmp_path: Path) -> None:
    make_run(tmp_path, "good")
    make_run(tmp_path, "slow")
    runs = Runs(tmp_path)
    go_on, inside_of_it = threading.Event(), threading.Event()

    def hang() -> None:
        with runs._histories.turn("slow"):
            inside_of_it.set()
            go_on.wait(20)

    thread = threading.Thread(target=hang)
    thread.start()
    inside_of_it.wait(5)
    answered = threading.Event()
    asking = threading.Thread(target=lambda: (runs.get("good"), answered.set()))
    asking.start()
    found = answered.wait(5)
    go_on.set()
    thread.join()
    asking.join()
    assert found


def test_a_trainer_is_not_started_where_its_log_leads_elsewhere(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "runs")
    (tmp_path / "bashrc").write_text("mine")
    (folder.path / "trainer.log").symlink_to(tmp_path / "bashrc")
    with pytest.raises(inside.NotPlainError, match=r"trainer\.log is no plain file"):
        spawn_trainer(folder)
    assert (tmp_path / "bashrc").read_text() == "mine"


@given(size=st.integers(0, 200), most=st.integers(0, 200), offset=st.integers(0, 200))
def test_a_file_is_read_whole_or_refused_with_its_size(
    tmp_path_factory: pytest.TempPathFactory, size: int, most: int, offset: int
) -> None:
    folder = tmp_path_factory.getbasetemp()
    (folder / "some").write_bytes(bytes(range(size)))
    if size - offset > most:
        with pytest.raises(inside.NotPlainError, match=f"has {size - offset} bytes, and at most {most} are read"):
            inside.read(folder, "some", most, offset)
    else:
        assert inside.read(folder, "some", most, offset) == bytes(range(size))[offset:]
