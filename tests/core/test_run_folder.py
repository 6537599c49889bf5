"""The run folder: one writer, torn lines, an inbox, truth about who is alive."""

import errno
import fcntl
import math
import os
import platform
import resource
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import psutil
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from morph_core import protocol
from morph_core.config import LARGEST
from morph_core.history import History
from morph_core.protocol import Acknowledged, Heartbeat, Pause, Progress, StateChanged, Stop
from morph_core.pulse import LOST_AFTER
from morph_core.run_folder import (
    EventLog,
    HeartbeatFile,
    HeldError,
    RunFolderError,
    create_run,
    find_run,
    hold,
    list_runs,
    new_run_id,
    read_episode,
    write_episode,
)
from tests.core.conftest import make_run


def progress(iteration: int) -> Progress:
    return Progress(
        iteration=iteration, env_steps=10 * iteration, phi=[float(iteration)] * 5, episode_return=-1.0, success=0.0,
        policy_std=0.5,
    )  # fmt: skip


def beat(status: protocol.Status, pid: int, started: float, at: float, host: str = platform.node()) -> Heartbeat:
    return Heartbeat(host, pid, started, at, status, "learning", 1, 6)


def test_events_come_back_in_order_with_rising_seq(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    log = EventLog(folder)
    for i in range(3):
        log.append(progress(i))
    log.close()
    reopened = EventLog(folder)
    reopened.append(progress(3))
    reopened.close()
    events, _ = folder.read_events()
    assert [e.seq for e in events] == [1, 2, 3, 4]
    assert [e.iteration for e in events] == [0, 1, 2, 3]


def test_nothing_is_left_of_a_torn_line_that_is_longer_than_the_next(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    folder.events.write_bytes(b'{"torn": "' + 9999 * b"x")
    log = EventLog(folder)
    written = log.append(progress(1))
    log.close()
    assert folder.events.read_bytes() == protocol.encode(written) + b"\n"


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(1, 900))
def test_a_log_cut_anywhere_keeps_its_whole_events_and_goes_on(tmp_path: Path, cut: int) -> None:
    folder = make_run(tmp_path, f"cut{cut}-{time.monotonic_ns()}")
    log = EventLog(folder)
    for i in range(4):
        log.append(progress(i))
    log.close()
    whole = folder.events.read_bytes()
    folder.events.write_bytes(whole[: max(0, len(whole) - cut)])
    kept, _ = folder.read_events()
    assert [e.seq for e in kept] == list(range(1, len(kept) + 1))
    assert len(kept) == whole[: max(0, len(whole) - cut)].count(b"\n")
    log = EventLog(folder)
    log.append(progress(9))
    log.close()
    assert [e.seq for e in folder.read_events()[0]] == list(range(1, len(kept) + 2))


def test_a_line_that_is_no_event_is_skipped(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    folder.events.write_bytes(b'{"kind":"from the future"}\nrubbish\n' + protocol.encode(progress(1)) + b"\n")
    events, _ = folder.read_events()
    assert [e.iteration for e in events] == [1]


def test_a_full_disk_leaves_the_log_as_it_was(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    log = EventLog(folder)
    log.append(progress(1))
    before = folder.events.read_bytes()
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 20, limits[1]))
    try:
        with pytest.raises(OSError, match="large"):
            log.append(progress(2))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert folder.events.read_bytes() == before
    log.append(progress(2))
    assert [e.seq for e in folder.read_events()[0]] == [1, 2]


def test_commands_are_numbered_and_come_in_order(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    sent = [protocol.Pause(), protocol.SetAlpha(2.0), protocol.Resume()]
    assert [folder.send(command) for command in sent] == [1, 2, 3]
    pending = list(folder.pending())
    assert [order.command for _, order in pending if order] == sent
    for path, _ in pending:
        path.unlink()
    log = EventLog(folder)
    log.append(protocol.Acknowledged(id=3, iteration=1, accepted=True, command=protocol.Resume()))
    assert folder.send(protocol.Stop()) == 4


@pytest.mark.parametrize("known", [10**11, 10**12, LARGEST])
def test_a_command_is_found_whatever_numbers_a_log_from_elsewhere_holds(tmp_path: Path, known: int) -> None:
    folder = make_run(tmp_path)
    log = EventLog(folder)
    log.append(Acknowledged(id=known, iteration=0, accepted=True, command=Pause()))
    log.append(Acknowledged(id=3, iteration=0, accepted=True, command=Pause()))
    (folder.commands / "999999999999.json").write_text("{}")
    assert folder.send(Stop()) == 4
    assert [order.command for _, order in folder.pending() if order] == [Stop()]


def test_a_log_that_counts_beyond_any_reader_is_not_written_to(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    folder.events.write_text(f'{{"kind":"state","seq":{LARGEST},"status":"running","iteration":0}}\n')
    with pytest.raises(RunFolderError, match="no event can follow"):
        EventLog(folder)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e200])
def test_what_no_reader_would_take_is_not_written(tmp_path: Path, value: float) -> None:
    folder = make_run(tmp_path)
    log = EventLog(folder)
    with pytest.raises(FloatingPointError, match="episode_return"):
        log.append(Progress(iteration=1, env_steps=1, phi=[1.0] * 5, episode_return=value, success=0, policy_std=1))
    assert folder.events.read_bytes() == b""
    assert log.seq == 0


def test_rubbish_in_the_inbox_is_no_order(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    (folder.commands / "000001.json").write_text('{"id": 1, "command": {"type": "rm -rf"}}')
    assert [order for _, order in folder.pending()] == [None]


def test_a_folder_has_one_holder(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    said = f"held by another trainer .{platform.node()} pid {os.getpid()}"
    with hold(folder), pytest.raises(HeldError, match=said), hold(folder):
        pass
    with hold(folder):
        pass


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_a_folder_that_can_not_be_locked_is_not_called_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    said = f"can't be locked .{os.strerror(number)}.: put the runs on a file system with locks"
    with pytest.raises(RunFolderError, match=said) as refused, hold(make_run(tmp_path)):
        pass
    assert not isinstance(refused.value, HeldError)


def test_what_was_said_is_on_the_disk_after_a_sync(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, synced = make_run(tmp_path), []
    monkeypatch.setattr(os, "fsync", lambda number: synced.append(Path(f"/proc/self/fd/{number}").resolve().name))
    log, file = EventLog(folder), HeartbeatFile(folder)
    log.append(progress(1))
    log.sync()
    file.write(beat("running", 1, 0.0, 0.0))
    file.sync()
    assert synced == ["events.jsonl", "heartbeat.json"]


def test_a_run_is_written_once(tmp_path: Path) -> None:
    record = make_run(tmp_path).record()
    with pytest.raises(RunFolderError, match="there already"):
        create_run(tmp_path, record)
    assert list_runs(tmp_path) == ["run"]


@pytest.mark.parametrize("name", ["../x", "a/b", "", ".", "..", "x" * 200, "a b", "a\x00b", "/etc", ".hidden", "ü"])
def test_names_that_are_no_run_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(RunFolderError, match="no run name"):
        find_run(tmp_path, name)


def test_a_link_out_of_the_runs_folder_is_no_run(tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "link").symlink_to(tmp_path / "outside")
    with pytest.raises(RunFolderError, match="unknown run"):
        find_run(tmp_path / "runs", "link")


def test_an_unknown_run_lists_the_known_ones(tmp_path: Path) -> None:
    make_run(tmp_path, "one")
    with pytest.raises(RunFolderError, match='unknown run "two"; choose from: one'):
        find_run(tmp_path, "two")


@pytest.mark.parametrize("content", [b"", b"{", b'{"format": 1}', b'{"format": "two"}', b"\xff\xfe", b'{"id": 5}'])
def test_a_damaged_record_is_an_error_with_a_reason(tmp_path: Path, content: bytes) -> None:
    folder = make_run(tmp_path)
    (folder.path / "run.json").write_bytes(content)
    with pytest.raises(RunFolderError, match="can't be read"):
        History(folder)


@pytest.mark.parametrize("content", [b'{"format": 3}', b'{"format": 3, "parameters": "elsewhere"}'])
def test_a_record_of_a_format_that_is_not_known_yet_is_refused_with_what_to_do(tmp_path: Path, content: bytes) -> None:
    folder = make_run(tmp_path)
    (folder.path / "run.json").write_bytes(content)
    said = "run.json of run has format 3; this version knows up to 2: open it with a newer morph-studio"
    with pytest.raises(RunFolderError, match=f"^{said}$"):
        History(folder)


def test_episodes_come_back_and_damaged_ones_are_an_error(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    name = write_episode(folder, 12, {"qpos": np.arange(6.0).reshape(3, 2)})
    assert name == "episodes/000012.npz"
    assert read_episode(folder, 12)["qpos"].tolist() == [[0, 1], [2, 3], [4, 5]]
    folder.episode(12).write_bytes(b"PK\x03\x04 torn")
    with pytest.raises(RunFolderError, match="can't be read"):
        read_episode(folder, 12)
    with pytest.raises(RunFolderError, match="no episode of iteration 13"):
        read_episode(folder, 13)


def test_run_names_say_when_and_what() -> None:
    assert new_run_id("reacher", "morph", 3, 0.0).endswith("-reacher-morph-s3")


def test_a_heartbeat_of_any_length_is_readable(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    file = HeartbeatFile(folder)
    file.write(msgspec.structs.replace(beat("running", 1, 0.0, 0.0), message="x" * 900))
    file.write(beat("paused", 2, 0.0, 0.0))
    read = folder.heartbeat()
    assert read is not None
    assert (read.status, read.pid, read.message) == ("paused", 2, "")
    assert (folder.path / "heartbeat.json").stat().st_size == 4096


def test_a_heartbeat_longer_than_its_place_is_shortened_not_torn(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    HeartbeatFile(folder).write(msgspec.structs.replace(beat("failed", 1, 0.0, 0.0), message='"ü' * 9000))
    read = folder.heartbeat()
    assert read is not None
    assert read.status == "failed"
    assert read.message.startswith('"ü')


def test_a_heartbeat_from_elsewhere_lives_as_long_as_it_changes_for_its_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, clock = make_run(tmp_path), 100.0
    monkeypatch.setattr("morph_core.pulse.time", SimpleNamespace(time=time.time, monotonic=lambda: clock))
    EventLog(folder).append(StateChanged(status="running", iteration=0))
    file, now = HeartbeatFile(folder), time.time()
    file.write(beat("running", 7, now - 100, now, "cluster-node"))
    history = History(folder)
    for seen in (LOST_AFTER - 1, 2 * LOST_AFTER - 2):
        clock = 100.0 + seen
        assert history.status == "running"
        file.write(beat("running", 7, now - 100, now + seen / 100, "cluster-node"))
        history.poll()
    clock += LOST_AFTER + 1
    history.poll()
    assert history.status == "lost"


@pytest.mark.parametrize("said_by", ["study.json", "run/launch.json"])
def test_a_run_that_something_will_start_is_queued_until_it_has_a_trainer(tmp_path: Path, said_by: str) -> None:
    folder = make_run(tmp_path)
    assert History(folder).status == "starting"
    (tmp_path / said_by).touch()
    history = History(folder)
    assert (history.status, history.message) == ("queued", "no trainer has taken it up yet")
    me = psutil.Process()
    HeartbeatFile(folder).write(beat("starting", me.pid, me.create_time(), time.time()))
    history.poll()
    assert history.status == "starting"


def test_the_report_of_a_study_is_no_run(tmp_path: Path) -> None:
    make_run(tmp_path)
    (tmp_path / "report").mkdir()
    assert list_runs(tmp_path) == ["report", "run"]
    (tmp_path / "study.json").touch()
    assert list_runs(tmp_path) == ["run"]


def test_running_lost_and_ended_are_told_apart(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    log, file = EventLog(folder), HeartbeatFile(folder)
    log.append(StateChanged(status="running", iteration=0))
    me, now = psutil.Process(), time.time()
    file.write(beat("running", me.pid, me.create_time(), now - 60))
    assert History(folder).status == "running"  # the process is there, however late its heartbeat
    assert History(folder).pulse.is_alive
    file.write(beat("running", 2**22 + 1, now - 100, now))
    assert History(folder).status == "lost"  # no such process here
    file.write(beat("running", 2**22 + 1, now - 100, now, "cluster-node"))
    assert History(folder).status == "running"  # it moves
    for skew in (-50, 50):
        file.write(beat("running", 2**22 + 1, now - 100, now + skew, "cluster-node"))
        assert History(folder).status == "running"  # its clock is not ours
    file.write(beat("running", 2**22 + 1, now - 1000, now - 300, "cluster-node"))
    assert History(folder).status == "lost"
    file.write(beat("running", me.pid, me.create_time() - 1000, now - 60))
    assert History(folder).status == "lost"  # the pid was reused
    assert "resume" in History(folder).message
    assert not History(folder).pulse.is_alive
    file.write(msgspec.structs.replace(beat("failed", 2**22 + 1, 0.0, now - 60), message="disk full"))
    assert History(folder).status == "failed"  # not even the event could be written
    log.append(StateChanged(status="finished", iteration=6, message="done"))
    assert History(folder).status == "finished"


def test_a_resume_voids_what_came_after_its_checkpoint(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    log = EventLog(folder)
    for i in (1, 2, 3):
        log.append(progress(i))
    history = History(folder)
    log.append(StateChanged(status="starting", iteration=2))
    log.append(progress(3))
    history.poll()
    assert [p.iteration for p in history.progress] == [1, 2, 3]
    assert history.design("latest")[0] == 3
    assert history.design("0")[1].tolist() == [3.0] * 5
    assert history.design("2")[1].tolist() == [2.0] * 5
    for wrong in ("7", "-1", "nan", "bset"):
        with pytest.raises(RunFolderError, match="choose best, latest"):
            history.design(wrong)
