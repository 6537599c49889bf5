"""Hundreds of long runs are listed without reading their logs again, and never with what their folders don't say."""

import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from conftest import append, make_run, progress
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from morph_core import durable
from morph_core.protocol import Evaluation, Heartbeat, StateChanged
from morph_core.run_folder import HeartbeatFile, RunFolder
from studio.index import FILE
from studio.lines import Row
from studio.listing import LONGEST_REASON
from studio.runs import Runs
from studio.shelf.marks import MarksChange


def rows(folder: Path) -> list[Row]:
    """Return the table as a server shows it that was started just now."""
    return Runs(folder).rows()


@pytest.fixture
def three(runs_folder: Path) -> Path:
    make_run(runs_folder, "a", ended="finished")
    make_run(runs_folder, "b", ended="stopped")
    make_run(runs_folder, "c", ended="failed")
    return runs_folder


@pytest.fixture
def logs_read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Note which logs are read."""
    read: list[str] = []
    whole_lines = RunFolder.read_events

    def noted(folder: RunFolder, offset: int = 0) -> object:
        read.append(folder.id)
        return whole_lines(folder, offset)

    monkeypatch.setattr(RunFolder, "read_events", noted)
    monkeypatch.setattr("studio.histories.landmarks", lambda path: read.append(path.name) or [])
    return read


def test_what_one_server_has_read_the_next_one_lists_without_reading_it(three: Path, logs_read: list[str]) -> None:
    first = Runs(three)
    first.rows()
    assert set(logs_read) == {"a", "b", "c"}
    logs_read.clear()
    assert rows(three) == first.rows()
    assert logs_read == []


def test_an_indexed_run_says_what_its_whole_history_says(three: Path) -> None:
    before, again = rows(three), rows(three)
    assert again == before
    best = again[0].outcome.best
    assert best is not None
    assert (best.iteration, best.success, best.phi) == (3, 0.5, [2.7] * 5)
    runs = Runs(three)
    for line in again:
        runs.get(line.id)
    assert runs.rows() == before


def test_a_run_that_went_on_is_read_again(three: Path) -> None:
    rows(three)
    append(
        RunFolder(three / "b"),
        StateChanged(status="starting", iteration=3),
        progress(4, env_steps=400),
        Evaluation(
            iteration=4, env_steps=400, phi=[2.0] * 5, sampled_success=1.0, sampled_return=1.0,
            deterministic_success=1.0, deterministic_return=1.0, milestones={"touched": 1.0},
        ),
        StateChanged(status="finished", iteration=4),
    )  # fmt: skip
    row = next(row for row in rows(three) if row.id == "b")
    assert (row.status, row.iteration, row.success) == ("finished", 4, 1.0)
    assert row.outcome.best is not None
    assert row.outcome.best.milestones == {"touched": 1.0}


@pytest.mark.parametrize("name", ["run.json", "events.jsonl", "heartbeat.json"])
def test_whatever_file_of_a_run_changes_it_is_read_again(three: Path, logs_read: list[str], name: str) -> None:
    rows(three)
    logs_read.clear()
    path = three / "a" / name
    path.touch()
    os.utime(path, ns=(1, 1))
    rows(three)
    assert set(logs_read) == {"a"}


def test_marks_and_new_and_removed_runs_are_seen_at_once(three: Path) -> None:
    rows(three)
    Runs(three).mark("a", MarksChange(name="the best"))
    make_run(three, "d")
    (three / "b").rename(three.parent / "b")
    assert [(row.id, row.marks.name) for row in rows(three)] == [("d", ""), ("c", ""), ("a", "the best")]


def test_a_run_that_goes_while_it_is_listed_is_left_out_and_a_long_reason_is_cut(
    three: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = Runs(three)
    monkeypatch.setattr(runs._listing, "ids", lambda: ["a", "gone", "b"])
    assert [row.id for row in runs.rows()] == ["a", "b"]

    def fail(*_: object) -> None:
        raise ValueError("x" * 9999)

    monkeypatch.setattr(runs._listing, "_line", fail)
    assert [(line.id, len(line.reason)) for line in runs.summaries()] == [("a", LONGEST_REASON), ("b", LONGEST_REASON)]


def test_a_run_at_rest_that_waits_for_its_trainer_is_queued(three: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = Runs(three)
    runs.rows()
    monkeypatch.setattr(runs._statuses, "in_queue", lambda *_: ("queued", "two others go before"))
    assert {(line.status, line.reason) for line in runs.summaries()} == {("queued", "two others go before")}


def lost(folder: Path, name: str) -> HeartbeatFile:
    """Make a run whose trainer is gone without a word; return its heartbeat."""
    run = make_run(folder, name)
    log = run.events.read_bytes().splitlines(keepends=True)
    run.events.write_bytes(b"".join(log[:-1]))
    heart = HeartbeatFile(run)
    heart.write(beat(1))
    return heart


def beat(number: int) -> Heartbeat:
    return Heartbeat(
        host=platform.node(), pid=2**22 + 1, process_started=1.0, time=float(number), status="running",
        stage="learning", iteration=number, iterations=100,
    )  # fmt: skip


def test_runs_whose_trainer_was_lost_are_not_read_again_either(runs_folder: Path, logs_read: list[str]) -> None:
    for number in range(3):
        lost(runs_folder, f"lost-{number}")
    before = rows(runs_folder)
    assert {row.status for row in before} == {"lost"}
    logs_read.clear()
    assert rows(runs_folder) == before
    assert logs_read == []


def test_a_lost_run_whose_heart_beats_again_is_read_again(runs_folder: Path, logs_read: list[str]) -> None:
    heart = lost(runs_folder, "lost")
    rows(runs_folder)
    logs_read.clear()
    time.sleep(0.02)
    heart.write(beat(2))
    rows(runs_folder)
    assert "lost" in logs_read


def test_a_run_that_is_queued_by_now_is_not_lost_any_more(runs_folder: Path) -> None:
    run = make_run(runs_folder, "run", ended=None)
    record = msgspec.json.decode((run.path / "run.json").read_bytes())
    (run.path / "run.json").write_bytes(msgspec.json.encode(record | {"created": 1.0}))
    assert rows(runs_folder)[0].status == "lost"
    (run.path / "launch.json").write_text('{"launcher": "local"}')
    assert rows(runs_folder)[0].status == "queued"


def _nothing(path: Path) -> None:
    path.unlink()


def _torn(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def _of_another_version(path: Path) -> None:
    path.write_text(path.read_text().replace('"made_by":"', '"made_by":"7').replace('"success":0.5', '"success":0.25'))


def _a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _a_link(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def _a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _no_count(path: Path) -> None:
    path.write_text(path.read_text().replace('"iteration":3', '"iteration":9007199254740993'))


def _another_name(path: Path) -> None:
    path.write_text(path.read_text().replace('"id":"a"', '"id":"b"'))


def _at_work(path: Path) -> None:
    path.write_text(path.read_text().replace('"status":"stopped"', '"status":"running"'))


@pytest.mark.parametrize(
    "damage",
    [_nothing, _torn, _of_another_version, _a_folder, _a_link, _a_pipe, _no_count, _another_name, _at_work],
)
def test_a_damaged_index_is_made_anew_and_changes_nothing(three: Path, damage: Callable[[Path], None]) -> None:
    before = rows(three)
    damage(three / FILE)
    assert rows(three) == before
    assert rows(three) == before


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=200) | st.recursive(
    st.none() | st.integers() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["made_by", "runs", "a"]), inner),
).map(msgspec.json.encode))  # fmt: skip
def test_no_content_of_the_index_keeps_runs_from_being_listed(three: Path, content: bytes) -> None:
    (three / FILE).write_bytes(content)
    assert [(row.id, row.status) for row in rows(three)] == [("c", "failed"), ("b", "stopped"), ("a", "finished")]


def test_where_the_index_can_not_be_written_runs_are_listed_all_the_same(
    three: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[Path] = []

    def refuse(path: Path, content: bytes) -> None:
        tried.append(path)
        raise PermissionError(13, f"{path} takes no {len(content)} bytes")

    monkeypatch.setattr(durable, "write_file", refuse)
    runs = Runs(three)
    assert len(runs.rows()) == 3
    assert len(runs.rows()) == 3
    assert tried == [three / FILE], "what can't be written is not tried again before there is something new"
    assert not (three / FILE).exists()


def test_the_folder_that_does_not_exist_yet_stays_so(tmp_path: Path) -> None:
    assert rows(tmp_path / "none") == []
    assert not (tmp_path / "none").exists()
