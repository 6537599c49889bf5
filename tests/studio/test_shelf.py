"""What the runs page is made of: marks that last, a trash that gives back, outcomes, traces and thumbnails."""

import io
import subprocess
import sys
import time
import unicodedata
from pathlib import Path

import msgspec
import numpy as np
import pytest
from conftest import make_hand_run, make_run, stand_in
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

from morph_core.history import History
from morph_core.protocol import Evaluation, Progress, StateChanged
from morph_core.run_folder import EventLog, RunFolder, RunFolderError, list_runs
from studio.cli.runs import ListArguments
from studio.new_run import StartRun
from studio.runs import Runs
from studio.shelf import trash
from studio.shelf.marks import (
    FILE,
    LONGEST_NAME,
    LONGEST_NOTE,
    LONGEST_TAG,
    MOST_TAGS,
    Marks,
    MarksChange,
    changed,
    read_marks,
    write_marks,
)
from studio.shelf.outcome import landmarks, outcome_of
from studio.shelf.thumbnails import HEIGHT, WIDTH, Thumbnails
from studio.shelf.traces import overlay, thinned

# --- marks ------------------------------------------------------------------------------------------------------------

NOTED = Marks(starred=True, name="Long fingers", note="try α = .3\nagain", tags=("hand", "to print"), archived=True)
SEEN = st.text(st.characters(categories=("L", "N", "P", "S"), exclude_characters=","), min_size=1, max_size=30)
SEEN = SEEN.filter(lambda text: unicodedata.is_normalized("NFC", text))


@given(st.booleans(), SEEN, SEEN, st.lists(SEEN, max_size=MOST_TAGS))
def test_marks_come_back_as_they_were_written(
    tmp_path_factory: pytest.TempPathFactory, flag: bool, name: str, note: str, tags: list[str]
) -> None:
    folder = tmp_path_factory.mktemp("run")
    marks = changed(Marks(), MarksChange(starred=flag, name=name, note=note, tags=tuple(tags), archived=not flag))
    write_marks(folder, marks)
    assert read_marks(folder) == marks
    assert marks == Marks(starred=flag, name=name, note=note, tags=tuple(dict.fromkeys(tags)), archived=not flag)


def test_what_a_change_leaves_out_stays_as_it_is() -> None:
    assert changed(NOTED, MarksChange(starred=False)) == msgspec.structs.replace(NOTED, starred=False)
    assert changed(NOTED, MarksChange(note="", tags=())) == msgspec.structs.replace(NOTED, note="", tags=())


def test_blanks_and_doubled_tags_are_left_out() -> None:
    marks = changed(Marks(), MarksChange(name="  a \n b ", tags=(" x  y", "x y", "", "z")))
    assert (marks.name, marks.tags) == ("a b", ("x y", "z"))
    composed, in_parts = "caf\u00e9", "cafe\u0301"  # what keyboards send, and what some file systems make of it
    marks = changed(Marks(), MarksChange(name=in_parts, tags=(in_parts, composed)))
    assert (marks.name, marks.tags) == (composed, (composed,))
    assert ListArguments(tag=in_parts).takes(marks)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (MarksChange(name="x" * (LONGEST_NAME + 1)), f"at most {LONGEST_NAME} characters, this one has 81"),
        (MarksChange(note="x" * (LONGEST_NOTE + 1)), f"at most {LONGEST_NOTE} characters"),
        (MarksChange(tags=("x" * (LONGEST_TAG + 1),)), f"at most {LONGEST_TAG} characters and no comma"),
        (MarksChange(tags=("a,b",)), "no comma"),
        (MarksChange(tags=tuple(str(i) for i in range(MOST_TAGS + 1))), f"at most {MOST_TAGS} tags, these are 13"),
        (MarksChange(name="gnp‮.exe"), r"U\+202E is not"),
        (MarksChange(note="a\x00b"), r"U\+0000 is not"),
        (MarksChange(tags=("\ud800",)), r"U\+D800 is not"),
    ],
)
def test_what_is_too_long_or_not_seen_is_refused(change: MarksChange, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        changed(NOTED, change)


@pytest.mark.parametrize(
    "content", [b"", b"{", b"\xff\xfe", b"[]", b'{"starred": 3}', b'{"name": "%s"}' % (b"x" * 81), b'{"tags": ["a,b"]}']
)
def test_a_file_of_marks_that_can_not_be_used_is_no_marks_and_is_not_written_over(
    runs_folder: Path, content: bytes
) -> None:
    folder, runs = make_run(runs_folder, "run"), Runs(runs_folder)
    (folder.path / FILE).write_bytes(content)
    assert read_marks(folder.path) == Marks()
    for change in (lambda: runs.mark("run", MarksChange(starred=True)), lambda: runs.star("run", "latest", True)):
        with pytest.raises(ValueError, match=r"marks\.json, which can't be read.*move it away"):
            change()
    assert (folder.path / FILE).read_bytes() == content


def test_a_folder_in_place_of_the_marks_breaks_nothing(runs_folder: Path) -> None:
    (make_run(runs_folder, "run").path / FILE).mkdir()
    (line,) = Runs(runs_folder).summaries()
    assert (line.status, line.marks) == ("stopped", Marks())


def test_marks_are_read_anew_when_somebody_else_has_written_them(runs_folder: Path) -> None:
    folder = make_run(runs_folder, "run")
    runs = Runs(runs_folder)
    assert runs.mark("run", MarksChange(starred=True)) == Marks(starred=True)
    assert runs.summary("run").marks.starred
    write_marks(folder.path, NOTED)
    assert runs.summary("run").marks == NOTED
    assert runs.mark("run", MarksChange(starred=False)).name == NOTED.name


def test_a_run_without_a_record_can_still_be_marked(runs_folder: Path) -> None:
    (make_run(runs_folder, "run").path / "run.json").unlink()
    runs = Runs(runs_folder)
    runs.mark("run", MarksChange(note="torn"))
    assert (runs.summary("run").status, runs.summary("run").marks.note) == ("unreadable", "torn")


# --- the trash --------------------------------------------------------------------------------------------------------


def test_a_deleted_run_is_gone_and_comes_back_whole(runs_folder: Path) -> None:
    folder = make_run(runs_folder, "run")
    runs = Runs(runs_folder)
    runs.show("run")
    runs.mark("run", MarksChange(name="Long fingers"))
    before = runs.row("run")
    content = folder.events.read_bytes()
    trashed = runs.discard("run")
    assert (runs.ids(), runs.shown, trashed.id) == ([], None, "run")
    assert trashed.purged - trashed.deleted == 7 * 86400
    assert [t.id for t in trash.trashed_runs(runs_folder)] == ["run"]
    with pytest.raises(RunFolderError, match='unknown run "run"'):
        runs.get("run")
    runs.restore("run")
    assert folder.events.read_bytes() == content
    assert runs.row("run") == before
    assert trash.trashed_runs(runs_folder) == []


def test_a_run_at_work_is_not_deleted(runs_folder: Path) -> None:
    runs = Runs(runs_folder, stand_in)
    run_id = runs.start(StartRun(task="reacher"))
    with pytest.raises(ValueError, match=r"is (starting|running): stop it, then delete it"):
        runs.discard(run_id)
    assert runs.ids() == [run_id]


def test_a_run_that_waits_for_its_trainer_is_not_deleted(runs_folder: Path) -> None:
    folder = make_run(runs_folder, "run", ended=None)
    (folder.path / "launch.json").write_text('{"launcher": "local"}')
    with pytest.raises(ValueError, match="is queued: stop it"):
        Runs(runs_folder).discard("run")


def test_a_run_that_is_held_is_not_deleted_whatever_its_log_says(runs_folder: Path) -> None:
    folder = make_run(runs_folder, "run")
    holder = (
        "import sys; from pathlib import Path; from morph_core.run_folder import RunFolder, hold\n"
        "with hold(RunFolder(Path(sys.argv[1]))): print(flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", holder, str(folder.path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        with pytest.raises(ValueError, match="run can't be deleted: run is held by another trainer"):
            Runs(runs_folder).discard("run")
        process.kill()
    assert Runs(runs_folder).discard("run").id == "run"


def test_a_damaged_run_can_be_deleted(runs_folder: Path) -> None:
    (make_run(runs_folder, "run").path / "run.json").write_text("torn")
    runs = Runs(runs_folder)
    assert runs.summary("run").status == "unreadable"
    runs.discard("run")
    assert runs.ids() == []


def test_the_newest_of_two_deleted_runs_of_one_name_comes_back_and_never_over_another(runs_folder: Path) -> None:
    runs = Runs(runs_folder)
    for note in ("first", "second"):
        make_run(runs_folder, "run")
        runs.mark("run", MarksChange(note=note))
        runs.discard("run")
        time.sleep(0.002)
    runs.restore("run")
    assert runs.summary("run").marks.note == "second"
    with pytest.raises(ValueError, match="another run is called run by now"):
        runs.restore("run")
    assert len(trash.trashed_runs(runs_folder)) == 1


@pytest.mark.parametrize("name", ["", "..", "../run", "run/..", "1000000000000.run", "x" * 300])
def test_nothing_but_a_deleted_run_is_restored(runs_folder: Path, name: str) -> None:
    make_run(runs_folder, "run")
    runs = Runs(runs_folder)
    runs.discard("run")
    with pytest.raises(RunFolderError, match="choose from: run"):
        runs.restore(name)


def in_trash(runs: Path) -> list[str]:
    return [t.id for t in trash.trashed_runs(runs)]


def test_the_trash_is_purged_by_age_and_by_number(runs_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trash, "MOST", 2)
    now = 1.8e9
    for i, age in enumerate((0, 60, 7200, 8 * 86400)):
        trash.discard(make_run(runs_folder, f"run-{i}"), now - age)
    trash.purge(runs_folder, now)
    assert in_trash(runs_folder) == ["run-0", "run-1"], "the third is beyond the number and older than an hour"
    trash.discard(make_run(runs_folder, "run-4"), now + 1)
    trash.purge(runs_folder, now + 1)
    assert in_trash(runs_folder) == ["run-4", "run-0", "run-1"], "what was deleted just now can be undone"
    assert trash.empty(runs_folder) == 3
    assert list((runs_folder / trash.FOLDER).iterdir()) == []


def test_a_deletion_purges_what_has_lain_in_the_trash_for_too_long(runs_folder: Path) -> None:
    trash.discard(make_run(runs_folder, "old"), time.time() - 8 * 86400)
    make_run(runs_folder, "run")
    Runs(runs_folder).discard("run")
    assert in_trash(runs_folder) == ["run"]


@pytest.mark.parametrize("deleted_by", [3600.0, -56 * 365 * 86400.0, 365 * 86400.0])
def test_no_step_of_the_clock_purges_a_run_or_keeps_it(
    runs_folder: Path, monkeypatch: pytest.MonkeyPatch, deleted_by: float
) -> None:
    now, uptime = time.time(), [100.0]
    monkeypatch.setattr(trash, "_uptime", lambda: uptime[0])
    monkeypatch.setattr(time, "time", lambda: now + deleted_by)
    runs = Runs(runs_folder)
    for name in ("run-1", "run-2", "run-3"):
        make_run(runs_folder, name)
        assert runs.discard(name).deleted == pytest.approx(max(0, now + deleted_by), abs=1e-3)
    for step in (0.0, 9 * 86400.0, -9 * 86400.0, 1e9):
        monkeypatch.setattr(time, "time", lambda step=step: now + step)
        trash.purge(runs_folder)
        assert len(in_trash(runs_folder)) == 3
    runs.restore("run-1")
    uptime[0] += 7 * 86400 - 1
    trash.purge(runs_folder)
    assert sorted(in_trash(runs_folder)) == ["run-2", "run-3"]
    monkeypatch.setattr(trash, "_start_of_machine", lambda: "0badcafe")  # started anew: only the wall clock is left
    monkeypatch.setattr(time, "time", lambda: now + deleted_by + 60)
    trash.purge(runs_folder)
    assert len(in_trash(runs_folder)) == 2
    monkeypatch.undo()
    monkeypatch.setattr(trash, "_uptime", lambda: 100.0 + 7 * 86400)
    trash.purge(runs_folder)
    assert in_trash(runs_folder) == []


def test_another_run_by_the_name_of_a_deleted_one_is_read_anew(runs_folder: Path) -> None:
    runs = Runs(runs_folder)
    for ended in ("stopped", "failed"):
        make_run(runs_folder, "run", ended=ended)
        assert runs.get("run").status == ended
        assert runs.row("run").status == ended
        runs.discard("run")


def test_the_trash_follows_no_link_and_leaves_what_is_not_its_own(runs_folder: Path, tmp_path: Path) -> None:
    other = make_run(tmp_path / "elsewhere", "other")
    (runs_folder / trash.FOLDER).mkdir(parents=True)
    (runs_folder / trash.FOLDER / "1000000000000.link").symlink_to(other.path)
    (runs_folder / trash.FOLDER / "notes.txt").write_text("mine")
    assert trash.empty(runs_folder) == 0
    assert other.events.exists()
    assert (runs_folder / trash.FOLDER / "notes.txt").exists()
    assert list_runs(runs_folder) == []


# --- outcomes ---------------------------------------------------------------------------------------------------------


def evaluation(i: int, success: float, returned: float = 0.0, at: float = 0.0) -> Evaluation:
    return Evaluation(
        time=at, iteration=i, env_steps=100 * i, phi=[float(i)] * 5, sampled_success=success, sampled_return=returned,
        deterministic_success=0.0, deterministic_return=0.0,
    )  # fmt: skip


def progress(i: int, at: float = 0.0) -> Progress:
    return Progress(
        time=at, iteration=i, env_steps=100 * i, phi=[1.0] * 5, episode_return=0.0, success=0.0, policy_std=1.0
    )


def test_an_outcome_is_the_last_and_the_best_evaluation_steps_and_time() -> None:
    events = [
        StateChanged(time=10, status="starting", iteration=0), progress(1, 11), evaluation(1, 0.5, 2.0, 12),
        evaluation(2, 0.5, 3.0, 13), evaluation(3, 0.25, 9.0, 14), progress(4, 15),
        StateChanged(time=16, status="stopped", iteration=4),
    ]  # fmt: skip
    outcome = outcome_of(events)
    assert (outcome.env_steps, outcome.seconds) == (400, 6.0)
    assert outcome.last is not None
    assert outcome.best is not None
    assert (outcome.last.iteration, outcome.best.iteration, outcome.best.phi) == (3, 2, [2.0] * 5)


def test_what_a_resume_has_voided_is_no_outcome_and_a_pause_between_trainers_no_time() -> None:
    events = [
        StateChanged(time=0, status="starting", iteration=0), evaluation(1, 0.1, at=5), progress(2, 8),
        evaluation(2, 0.9, at=10), StateChanged(time=1000, status="starting", iteration=1),
    ]  # fmt: skip
    outcome = outcome_of(events)
    assert (outcome.env_steps, outcome.seconds) == (100, 10.0)
    assert outcome.best is not None
    assert outcome.best.iteration == 1


def test_a_run_that_has_not_begun_has_come_to_nothing(runs_folder: Path) -> None:
    make_run(runs_folder, "run", ended=None)
    outcome = Runs(runs_folder).outcome("run")
    assert (outcome.env_steps, outcome.seconds, outcome.last, outcome.best) == (None, None, None, None)


KINDS = st.sampled_from(["progress", "evaluation", "starting", "stopped"])


@given(
    st.lists(st.tuples(KINDS, st.integers(0, 9), st.floats(0, 1)), max_size=30),
    st.sampled_from([b"", b'{"ki', b"{}\n", b'{"kind":"evaluation","time":"?"}\n']),
)
@example([("progress", 3, 0.0)], b'{"kind":"evaluation","time":"?"}\n')
def test_landmarks_tell_what_the_whole_log_tells(
    tmp_path_factory: pytest.TempPathFactory, told: list[tuple[str, int, float]], tail: bytes
) -> None:
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    log = EventLog(folder)
    for kind, i, share in told:
        made = {"progress": progress(i), "evaluation": evaluation(i, share)}
        log.append(made.get(kind) or StateChanged(status="starting" if kind == "starting" else "stopped", iteration=i))
    log.close()
    with folder.events.open("ab") as file:
        file.write(tail)
    assert outcome_of(landmarks(folder.path)) == outcome_of(folder.read_events()[0])


def test_the_best_of_an_outcome_is_the_best_of_the_history(runs_folder: Path) -> None:
    folder = make_run(runs_folder, "run")
    best, outcome = History(folder).best, Runs(runs_folder).outcome("run")
    assert best is not None
    assert outcome.best is not None
    assert (outcome.best.iteration, outcome.best.phi) == (best.iteration, best.phi)


def test_an_outcome_grows_with_the_log(runs_folder: Path) -> None:
    folder = make_run(runs_folder, "run")
    runs = Runs(runs_folder)
    assert runs.outcome("run").env_steps == 300
    for in_memory in (False, True):
        if in_memory:
            runs.get("run")
        log = EventLog(folder)
        log.append(progress(7 + in_memory))
        log.close()
        assert runs.outcome("run").env_steps == 700 + 100 * in_memory


# --- traces -----------------------------------------------------------------------------------------------------------


def test_runs_of_one_method_have_a_mean_where_all_of_them_were_evaluated(runs_folder: Path) -> None:
    record = make_run(runs_folder, "run").record()
    first = [evaluation(i, 0.1 * i) for i in (1, 2, 3, 4)]
    second = [evaluation(i, 0.1 * i + 0.2) for i in (2, 3, 4, 5)]
    alone = msgspec.structs.replace(record, method="direct")
    drawn = overlay([("a", record, first), ("b", record, second), ("c", alone, first), ("d", record, [])])
    assert [t.run for t in drawn.traces] == ["a", "b", "c", "d"]
    (mean,) = drawn.means
    assert (mean.method, mean.task, mean.runs) == ("morph", "reacher", 2)
    assert (mean.env_steps[0], mean.env_steps[-1]) == (200, 400)
    np.testing.assert_allclose(np.array(mean.success.mean)[[0, -1]], [0.3, 0.5])
    np.testing.assert_allclose(np.array(mean.success.low), np.interp(mean.env_steps, [200, 400], [0.2, 0.4]))
    np.testing.assert_allclose(np.array(mean.success.high), np.interp(mean.env_steps, [200, 400], [0.4, 0.6]))


def test_runs_that_never_ran_at_the_same_steps_have_no_mean(runs_folder: Path) -> None:
    record = make_run(runs_folder, "run").record()
    halves = [[evaluation(i, 0.5) for i in steps] for steps in ((1, 2), (2, 3))]
    assert overlay([("a", record, halves[0]), ("b", record, halves[1])]).means == []


@example([0.5] * 30 + [0.9, 0.1] + [0.5] * 30, 20)
@given(st.lists(st.floats(0, 1), min_size=1, max_size=300), st.integers(20, 100))
def test_thinned_traces_keep_ends_highs_and_lows(success: list[float], limit: int) -> None:
    whole = [evaluation(i, share, returned=-share * (i % 7)) for i, share in enumerate(success)]
    kept = thinned(whole, limit)
    assert len(kept) <= limit + 2
    assert [kept[0], kept[-1]] == [whole[0], whole[-1]]
    for measure in ("sampled_success", "sampled_return"):
        values, some = ([getattr(e, measure) for e in part] for part in (whole, kept))
        assert (min(values), max(values)) == (min(some), max(some))


# --- thumbnails -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["reacher", "pen_press", "mouse_click"])
def test_a_thumbnail_shows_the_design_on_a_clear_ground(runs_folder: Path, task: str) -> None:
    make_run(runs_folder, "run") if task == "reacher" else make_hand_run(runs_folder, task, "run")
    runs, thumbnails = Runs(runs_folder), Thumbnails()
    pictures = []
    for which in ("best", "0"):
        record, phi = runs.design("run", which)
        pictures.append(thumbnails.of(record.task, record.task_options, phi))
    image = np.array(Image.open(io.BytesIO(pictures[0])))
    assert image.shape == (HEIGHT, WIDTH, 4)
    assert 0.005 < (image[..., 3] > 128).mean() < 0.9
    assert pictures[0] != pictures[1], "another design has another picture"


def test_thumbnails_are_kept_within_their_room(monkeypatch: pytest.MonkeyPatch) -> None:
    from studio.shelf import thumbnails

    drawn: list[float] = []

    def draw(*design: list[float]) -> bytes:
        drawn.append(design[-1][0])
        return bytes(100)

    monkeypatch.setattr(thumbnails, "draw_thumbnail", draw)
    kept = Thumbnails(most_bytes=250)
    for value in (1.0, 2.0, 1.0, 3.0, 1.0, 2.0):
        kept.of("reacher", {}, [value])
    assert drawn == [1.0, 2.0, 3.0, 2.0], "the one that was least recently asked for has made room"


@pytest.mark.parametrize(
    ("task", "options", "phi"),
    [
        ("reach", {}, [1.0] * 5),
        ("reacher", {"tunnel": 3}, [1.0] * 5),
        ("reacher", {"tunnel": ["zigzag"]}, [1.0] * 5),
        ("reacher", {}, [1.0] * 4),
        ("reacher", {}, [float("nan")] * 5),
        ("reacher", {}, [1e9] * 5),
    ],
)
def test_what_can_not_be_built_has_no_thumbnail(task: str, options: dict[str, object], phi: list[float]) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        Thumbnails().of(task, options, phi)
