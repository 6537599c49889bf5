"""Films made in the background: one at a time, how far they are, how they end, and what is refused."""

import contextlib
import errno
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import msgspec
import psutil
import pytest
from conftest import NAME, Cutter, Page, Served, eventually, make_run

from morph_core.history import History
from morph_core.run_folder import RunFolderError
from studio.film import __main__ as process
from studio.film.errors import DiskFullError, FilmError
from studio.filming import CPU_SECONDS, Films, FilmState, FilmWish, Order
from studio.viewer.filming import FilmPanel

ACTS = {
    "whole": "say(frames=4); say(frames=4, done=2); out.write_bytes(b'film'); say(frames=4, done=4)",
    "long": "say(frames=4, done=1); time.sleep(60)",
    "dumb": "time.sleep(60)",
    "encoding": "subprocess.Popen(['sleep', '60'], start_new_session=True); say(frames=4, done=1); time.sleep(60)",
    "slow": "say(frames=4, done=1, resting=True); time.sleep(60)",
    "refused": "say(failed='no such episode, says the test'); sys.exit(1)",
    "dying": "say(frames=4); raise FloatingPointError('NaN, says the test')",
    "killed": "say(frames=4); os.kill(os.getpid(), 9)",
    "greedy": "say(frames=4); signal.signal(signal.SIGXCPU, signal.SIG_DFL); os.kill(os.getpid(), signal.SIGXCPU)",
}
"""What the process does in place of a film, by a word for it."""


class Theatre:
    """Films whose process plays an act instead."""

    def __init__(self, runs: Path) -> None:
        self.act = "whole"
        self.children: list[subprocess.Popen[bytes]] = []
        self.orders: list[Order] = []
        self.runs = runs
        self.films = Films(self.find, self.spawn)

    def find(self, run: str) -> Path:
        if run != NAME:
            raise RunFolderError("no such run, says the test")
        return self.runs / run

    def spawn(self, order: Order, log: Path) -> subprocess.Popen[bytes]:
        self.orders.append(order)
        code = (
            "import json, os, pathlib, signal, subprocess, sys, time\nout = pathlib.Path(sys.argv[1])\n"
            f"def say(**said): print(json.dumps(said), flush=True)\n{ACTS[self.act]}"
        )
        with log.open("wb") as errors:
            self.children.append(
                subprocess.Popen([sys.executable, "-S", "-c", code, order.out], stdout=subprocess.PIPE, stderr=errors)
            )
        return self.children[-1]

    def comes_to(self, state: str) -> FilmState:
        assert eventually(lambda: self.films.state.state == state), self.films.state
        return self.films.state


@pytest.fixture
def theatre(tmp_path: Path) -> Iterator[Theatre]:
    theatre = Theatre(tmp_path)
    yield theatre
    theatre.films.close()
    assert all(child.poll() is not None for child in theatre.children)
    assert not any(Path(order.out).parent.exists() for order in theatre.orders)


def test_a_film_is_made_and_kept_until_another_one_is_begun(theatre: Theatre) -> None:
    films = theatre.films
    assert films.start(FilmWish(run=NAME)).frames == 4
    state = theatre.comes_to("ready")
    assert (state.name, state.size, state.number, state.done) == (f"{NAME}-evolution.mp4", 4, 1, 4)
    path = films.file(1)
    assert path
    assert path.read_bytes() == b"film"
    assert films.file(2) is None
    films.start(FilmWish(run=NAME, format="svg", design="3"))
    assert theatre.comes_to("ready").name == f"{NAME}-3.svg"
    assert (films.file(1), path.exists()) == (None, False)
    assert films.cancel() == FilmState(number=2)


def test_it_is_one_at_a_time_and_is_given_up_at_once(theatre: Theatre) -> None:
    theatre.act = "long"
    theatre.films.start(FilmWish(run=NAME))
    assert eventually(lambda: theatre.films.state.done == 1)
    with pytest.raises(ValueError, match="is being made, and it is one at a time"):
        theatre.films.start(FilmWish(run=NAME))
    assert theatre.films.cancel().state == "cancelled"
    assert theatre.children[0].poll() is not None
    theatre.act = "whole"
    assert theatre.films.start(FilmWish(run=NAME)).number == 2
    theatre.comes_to("ready")


@pytest.mark.parametrize("act", ["dumb", "encoding"])
def test_what_is_given_up_ends_with_all_that_works_for_it(theatre: Theatre, act: str) -> None:
    theatre.act = act
    waiting = threading.Thread(target=theatre.films.start, args=[FilmWish(run=NAME)])
    waiting.start()
    assert eventually(lambda: theatre.films.state.done == (act == "encoding") and theatre.films.state.number == 1)
    helpers = psutil.Process(theatre.children[0].pid).children()
    assert len(helpers) == (act == "encoding")
    assert theatre.films.cancel().state == "cancelled"
    waiting.join(10)
    assert not waiting.is_alive()
    assert eventually(lambda: not any(helper.is_running() and helper.status() != "zombie" for helper in helpers))


def test_what_a_killed_server_has_left_is_removed_and_what_another_one_makes_stays(
    theatre: Theatre, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    theatre.act = "long"
    theatre.films.start(FilmWish(run=NAME))
    (at_work,) = tmp_path.glob("morph-film-*")
    left, strange = tmp_path / "morph-film-left", tmp_path / "morph-film-strange"
    for folder in (left, strange):
        folder.mkdir()
    (left / "lock").touch()
    (left / "film.mp4").touch()
    Films(theatre.find)
    assert set(tmp_path.glob("morph-film-*")) == {at_work, strange}


def test_a_film_that_has_no_place_is_refused_and_the_next_one_is_made(
    theatre: Theatre, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    theatre.films.start(FilmWish(run=NAME))
    theatre.comes_to("ready")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device, says the test")

    with monkeypatch.context() as within:
        within.setattr(theatre.films, "_spawn", full)
        with pytest.raises(ValueError, match=f"no film can be made in {tmp_path}: No space left"):
            theatre.films.start(FilmWish(run=NAME))
    assert theatre.films.state == FilmState(number=1)
    assert not list(tmp_path.glob("morph-film-*"))
    theatre.films.start(FilmWish(run=NAME))
    theatre.comes_to("ready")


def test_it_is_said_that_a_film_rests_as_long_as_it_is_made(theatre: Theatre) -> None:
    theatre.act = "slow"
    theatre.films.start(FilmWish(run=NAME))
    assert eventually(lambda: theatre.films.state.resting)
    assert not theatre.films.cancel().resting


@pytest.mark.parametrize(
    ("act", "reason"),
    [("dying", "NaN, says the test"), ("killed", "for want of memory"), ("greedy", "30 minutes of processor time")],
)
def test_a_process_that_ends_without_a_film_is_told_with_its_reason(theatre: Theatre, act: str, reason: str) -> None:
    theatre.act = act
    with contextlib.suppress(ValueError):  # it may end so soon that whoever asked is told
        theatre.films.start(FilmWish(run=NAME))
    assert reason in theatre.comes_to("failed").reason


def test_what_can_not_be_filmed_is_refused_at_once(theatre: Theatre) -> None:
    theatre.act = "refused"
    with pytest.raises(ValueError, match="no such episode, says the test"):
        theatre.films.start(FilmWish(run=NAME))
    with pytest.raises(RunFolderError):
        theatre.films.start(FilmWish(run=NAME, beside="another"))
    assert len(theatre.orders) == 1


@pytest.mark.parametrize(
    ("wish", "sentence"),
    [
        ({"format": "svg", "seconds": 5}, "seconds goes with mp4 and gif"),
        ({"format": "png", "beside": NAME}, "beside goes with mp4 and gif"),
        ({"at": 1}, "at goes with svg and png"),
        ({"beside_design": "best"}, "beside_design goes with beside"),
        ({"design": "best", "seconds": 5}, "seconds goes with an evolution"),
        ({"design": "first"}, "Expected `str` matching regex"),
        ({"height": 4320}, "height"),
        ({"seconds": 61}, "<= 60"),
        ({"format": "avi"}, "format"),
        ({"out": "/etc/passwd"}, "unknown field `out`"),
    ],
)
def test_a_wish_that_does_not_fit_together_is_refused_by_the_api(
    served: Served, wish: dict[str, object], sentence: str
) -> None:
    answer = served.client.post("/api/films", json={"run": NAME, **wish})
    assert answer.status_code == 422
    assert sentence in answer.json()["detail"]


def test_the_api_has_a_still_drawn_and_gives_it(served: Served, runs_folder: Path) -> None:
    make_run(runs_folder)
    assert served.client.post("/api/films", json={"run": "nobody"}).status_code == 404
    begun = served.client.post("/api/films", json={"run": NAME, "format": "svg", "design": "3"})
    assert (begun.status_code, begun.json()["number"]) == (202, 1)
    assert eventually(lambda: served.client.get("/api/films").json()["state"] == "ready", 60)
    answer = served.client.get("/api/films/1")
    assert answer.headers["content-type"].startswith("image/svg+xml")
    assert answer.headers["content-disposition"] == f'attachment; filename="{NAME}-3.svg"'
    assert answer.content.startswith(b"<svg")
    assert served.client.get("/api/films/2").status_code == 404
    assert served.client.delete("/api/films").json()["state"] == "none"
    assert served.client.get("/api/films/1").status_code == 404


# --- the process ------------------------------------------------------------------------------------------------------


def test_the_process_gives_way_to_all_others_and_ends_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    import resource

    nice, limits = [], []
    monkeypatch.setattr(os, "nice", nice.append)
    monkeypatch.setattr(resource, "setrlimit", lambda which, limit: limits.append((which, limit[0])))
    order = Order(FilmWish(run=NAME, format="svg"), [str(make_run(tmp_path).path)], str(tmp_path / "still.svg"))
    assert process.main([msgspec.json.encode(order).decode()]) == 0
    assert (nice, limits) == ([19], [(resource.RLIMIT_CPU, CPU_SECONDS)])
    assert capfdbinary.readouterr().out == b'{"frames":1}\n'
    order = msgspec.structs.replace(order, wish=FilmWish(run=NAME, design="7"))
    assert process.main([msgspec.json.encode(order).decode()]) == 1
    assert b"has no iteration 7" in capfdbinary.readouterr().out


def test_a_film_rests_beside_work_that_keeps_the_processors_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, worked, others, slept = [0.0], [0.0], [0.0], []
    monkeypatch.setattr(process.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(process.time, "process_time", lambda: worked[0])
    monkeypatch.setattr(process.time, "sleep", slept.append)
    monkeypatch.setattr(process.psutil, "cpu_count", lambda: 4)
    monkeypatch.setattr(process.psutil, "cpu_times", lambda: SimpleNamespace(user=others[0]))
    rests = process.Rests()
    for taken, busy in ((0.9, False), (1.1, True), (4.0, True), (0.0, False)):
        clock[0], worked[0], others[0] = clock[0] + 1, worked[0] + 0.5, others[0] + taken
        assert rests.take() is busy
    assert slept == [2.0, 2.0]


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (DiskFullError("the same command goes on"), "has no room for it: make room, or wish for a smaller"),
        (OSError(errno.EROFS, "Read-only file system"), "the disk does not take it: Read-only file system"),
    ],
)
def test_what_the_disk_refuses_is_said_for_the_studio(
    error: Exception, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capfdbinary: pytest.CaptureFixture[bytes],
) -> None:  # fmt: skip
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(process, "give_way", lambda: None)
    monkeypatch.setattr(process, "make", fail)
    order = Order(FilmWish(run=NAME), [str(make_run(tmp_path).path)], str(tmp_path / "home" / "film.mp4"))
    assert process.main([msgspec.json.encode(order).decode()]) == 1
    said = capfdbinary.readouterr().out.decode()
    assert sentence in said
    assert "command" not in said


def test_a_wish_is_planned_as_on_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    history = History(make_run(tmp_path))
    film = process.film_of(FilmWish(run=NAME, seconds=2), [history])
    assert (film.kind, film.width, film.height, film.fps, film.seconds) == ("evolution", 1920, 1080, 30, 2)
    wish = FilmWish(run=NAME, beside=NAME, beside_design="3", format="gif", height=360)
    film = process.film_of(wish, [history, history])
    assert (film.kind, film.width, film.height, [side.iteration for side in film.sides]) == (
        "episode",
        640,
        360,
        [3, 3],
    )
    idle, autogroup = [], tmp_path / "autogroup"
    monkeypatch.setattr(os, "sched_setscheduler", lambda _, policy, __: idle.append(policy))
    monkeypatch.setattr(process, "_AUTOGROUP", autogroup)
    monkeypatch.setattr(process.Reel, "render", lambda *_: None)
    monkeypatch.setattr(process.Reel, "join", process.Reel.clear)
    process.make(FilmWish(run=NAME), [history], tmp_path / "film.mp4")
    assert (idle, autogroup.read_text()) == ([os.SCHED_IDLE], "19")
    monkeypatch.setattr(process, "MOST_FRAMES", 10)
    with pytest.raises(FilmError, match="in the studio 10 are the most; morph-studio replay --video makes longer ones"):
        process.make(FilmWish(run=NAME), [history], tmp_path / "film.mp4")
    assert not list(tmp_path.glob("film*"))


# --- the panel --------------------------------------------------------------------------------------------------------


def form_of(page: Page) -> tuple[FilmPanel, Cutter]:
    return page.viewer.film, page.films


def test_the_panel_wishes_for_what_it_says(page: Page, tmp_path: Path) -> None:
    panel, films = form_of(page)
    assert not page.viewer.export.ways.visible
    page.show(make_run(tmp_path))
    assert page.viewer.export.ways.visible
    panel.submit()
    page.viewer.export.design.value = "iteration"
    page.viewer.export.iteration.value = 3
    panel.what.value, panel.format.value = "episode", "gif"
    films.state = FilmState()
    panel.submit()
    panel.what.value = "still"
    assert (panel.format.value, panel.size.visible) == ("svg", False)
    panel.submit()
    assert films.wishes == [
        FilmWish(run=NAME, height=1080),
        FilmWish(run=NAME, format="gif", design="3", height=540),
        FilmWish(run=NAME, format="svg", design="3"),
    ]
    page.viewer.export.iteration.value = 77
    panel.submit()
    assert "has no iteration 77" in panel.note.content
    films.refusal = "ffmpeg is missing, says the test"
    page.viewer.export.iteration.value = 3
    panel.submit()
    assert "ffmpeg is missing" in panel.note.content


def test_the_panel_shows_how_far_the_film_is_and_hands_it_out(page: Page, tmp_path: Path) -> None:
    panel, films = form_of(page)
    history = page.show(make_run(tmp_path))
    panel.submit()
    films.state = msgspec.structs.replace(films.state, frames=400, done=100, seconds_left=90.0)
    page.viewer.refresh()
    assert "100 of 400 frames, about 2 min left" in panel.note.content
    assert (panel.bar.value, panel.bar.visible, panel.make.visible, panel.cancel.visible) == (25.0, True, False, True)
    assert not panel.size.visible
    films.path = tmp_path / "film.mp4"
    films.path.write_bytes(b"film")
    films.state = msgspec.structs.replace(films.state, state="ready", size=1_200_000)
    panel.update(history)
    assert (panel.download.label, panel.bar.visible, panel.make.visible) == ("Download 1.2 MB", False, True)
    assert panel.size.visible
    sent: list[tuple[str, bytes]] = []

    class Browser:
        def send_file_download(self, name: str, content: bytes, *, save_immediately: bool) -> None:
            assert save_immediately
            sent.append((name, content))

    panel.send(Browser())  # pyright: ignore[reportArgumentType]
    assert sent == [("film.mp4", b"film")]
    films.path = None
    panel.send(Browser())  # pyright: ignore[reportArgumentType]
    assert "make it anew" in panel.note.content
    films.state = msgspec.structs.replace(films.state, state="failed", reason="no room, says the test")
    panel.update(history)
    assert "no room" in panel.note.content
    assert not panel.download.visible
