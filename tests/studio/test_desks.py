"""Each browser has a viewer of its own, driven here by raw connections to a real viser server."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import pytest
import viser
from conftest import NAME, Cutter, Neighbours, Oracle, Served, Stars, eventually, make_run
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

from morph_core.history import History
from morph_core.protocol import AnyCommand, Pause
from studio.bridge import GuardedViser
from studio.desks import KEPT, MOST, Desks, key_of
from studio.export.bundle import Bundle
from studio.recordings import Recordings
from studio.viewer.view import View
from studio.viewer.viewer import Viewer

OTHER = "20260202-000000-reacher-morph-s1"
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1, 1, 1], "fov": 1.0, "near": 0.1, "far": 100.0,
    "look_at": [0, 0, 0], "up_direction": [0, 0, 1], "image_height": 100, "image_width": 100,
}  # fmt: skip


@dataclass
class Room:
    """Desks on a guarded viser server, with two runs to be shown."""

    guarded: GuardedViser
    histories: dict[str, History]
    desks: Desks = field(init=False)
    commands: list[tuple[str, AnyCommand, str]] = field(default_factory=list)
    viewers: list[Viewer] = field(default_factory=list)
    free: threading.Event = field(default_factory=threading.Event)
    """Set unless whoever makes viewers is held up."""
    breaking: bool = False
    """Whether no viewer can be made."""

    def __post_init__(self) -> None:
        self.free.set()
        self.desks = Desks(self.guarded.server, self.make)

    def make(self, client: viser.ClientHandle) -> Viewer:
        self.free.wait(20)
        if self.breaking:
            raise RuntimeError("no viewer today, says the test")
        viewer = Viewer(
            client,
            on_command=lambda run_id, command, sender: self.commands.append((run_id, command, sender)),
            on_start=lambda _: NAME,
            on_resume=lambda _: None,
            on_branch=lambda *_: NAME,
            on_export=lambda *_: Bundle("design.zip", {}, [], b"zip"),
            answers=Oracle(),
            family=lambda _: None,
            album=Stars(),
            others=Neighbours(self.histories),
            films=Cutter(),
            recordings=Recordings(),
        )
        self.viewers.append(viewer)
        return viewer

    def show(self, without: str = "") -> None:
        histories = {name: history for name, history in self.histories.items() if name != without}
        self.desks.show(histories, {name: (h.status, "") for name, h in histories.items()}, NAME)

    def shows(self, key: str, run: str | None, iteration: int | None = None) -> bool:
        """Tell whether the browser of this key comes to show a run, at an iteration or following it."""

        def claim() -> bool:
            self.show()
            seen = self.desks.seen(key)
            return seen.connected and (seen.run, seen.iteration) == (run, iteration)

        return bool(eventually(claim))

    @contextlib.contextmanager
    def browser(self, key: str) -> Iterator[Connection]:
        with connect(
            f"{self.guarded.address}?{key}",
            subprotocols=[Subprotocol("viser-v1.1.1")],
            max_size=None,
            proxy=None,
            close_timeout=0.3,
        ) as connection:
            connection.send(msgspec.msgpack.encode(CAMERA))
            yield connection

    def viewer_of(self, key: str) -> Viewer:
        def find() -> Viewer | None:
            return next((viewer for desk, viewer in self.desks._seated() if desk.key == key), None)

        viewer = eventually(find)
        assert isinstance(viewer, Viewer)
        return viewer


@pytest.fixture
def room(tmp_path: Path) -> Iterator[Room]:
    folders = [make_run(tmp_path / "runs", name, ended="finished") for name in (NAME, OTHER)]
    guarded = GuardedViser()
    room = Room(guarded, {folder.id: History(folder) for folder in folders})
    yield room
    room.desks.stop()
    guarded.stop()


def key(name: str) -> str:
    return f"{name}-of-the-tests-desks"


def players() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name in ("viewer-player", "what-if")]


def test_what_one_browser_chooses_another_does_not_see(room: Room) -> None:
    with room.browser(key("a")), room.browser(key("b")):
        assert room.shows(key("a"), NAME)
        assert room.shows(key("b"), NAME)
        room.desks.put(key("a"), View(run=OTHER, iteration=2, ticks={"trail": True, "speed": 0.5, "loop": False}))
        assert room.shows(key("a"), OTHER, 2)
        assert room.shows(key("b"), NAME)
        a, b = (room.desks.seen(key(name)).ticks for name in "ab")
        assert (a["trail"], a["speed"], a["loop"]) == (True, 0.5, False)
        assert (b["trail"], b["speed"], b["loop"]) == (False, 1.0, True)
        assert room.desks.selected == {NAME, OTHER}


def test_steering_goes_to_the_run_and_says_who_did_it(room: Room) -> None:
    with room.browser(key("a")), room.browser(key("b")):
        assert room.shows(key("b"), NAME)
        viewer = room.viewer_of(key("b"))
        client = next(c for c in room.guarded.server.get_clients().values() if key_of(c) == key("b"))
        viewer.wishes.send(lambda: [Pause()], client)
        assert room.commands == [(NAME, Pause(), f"studio, browser {client.client_id}")]


def test_a_browser_that_comes_again_finds_what_it_left(room: Room) -> None:
    with room.browser(key("a")):
        assert room.shows(key("a"), NAME)
        viewer = room.viewer_of(key("a"))
        viewer.open(OTHER, 1)
        viewer.looks.ghost.value = False
        assert room.shows(key("a"), OTHER, 1)
    assert eventually(lambda: not room.desks.seen(key("a")).connected)
    assert room.desks.seen(key("a")).run == OTHER
    with room.browser(key("a")):
        assert room.shows(key("a"), OTHER, 1)
        assert room.desks.seen(key("a")).ticks["ghost"] is False


def test_a_choice_made_before_a_browser_was_shown_anything_is_kept(room: Room) -> None:
    with room.browser(key("a")):
        room.viewer_of(key("a"))
        room.desks.put(key("a"), View(run=OTHER, iteration=2))
        assert room.shows(key("a"), OTHER, 2)
        room.show()
        assert room.desks.seen(key("a")).run == OTHER


def test_every_browser_turns_to_a_run_that_all_are_asked_to_show(room: Room) -> None:
    with room.browser(key("a")), room.browser(key("b")):
        assert room.shows(key("a"), NAME)
        assert room.shows(key("b"), NAME)
        room.desks.turn_to(OTHER, 1)
        assert room.shows(key("a"), OTHER, 1)
        assert room.shows(key("b"), OTHER, 1)


def test_a_run_deleted_elsewhere_is_said_and_comes_back_with_its_iteration(room: Room) -> None:
    with room.browser(key("a")):
        assert room.shows(key("a"), NAME)
        viewer = room.viewer_of(key("a"))
        viewer.turn_to(2)
        assert room.shows(key("a"), NAME, 2)
        room.show(without=NAME)
        assert "deleted or moved" in viewer.run.failure.content
        assert not viewer.run.pause.visible
        assert room.desks.seen(key("a")).run == NAME
        assert room.shows(key("a"), NAME, 2)
        assert not viewer.run.failure.visible


def test_one_browser_too_many_waits_until_another_leaves(room: Room) -> None:
    with contextlib.ExitStack() as others:
        leaving = others.enter_context(contextlib.ExitStack())
        leaving.enter_context(room.browser(key("first")))
        for i in range(1, MOST):
            others.enter_context(room.browser(key(f"{i}")))
        assert eventually(lambda: len(room.desks._seated()) == MOST)
        others.enter_context(room.browser(key("late")))
        assert eventually(lambda: room.desks._waiting)
        assert room.desks.seen(key("late")).connected
        assert room.desks.seen(key("late")).run is None
        leaving.close()
        assert room.shows(key("late"), NAME)


def test_a_browser_that_leaves_takes_its_threads_along(room: Room) -> None:
    before = len(players())
    with room.browser(key("a")), room.browser(key("b")):
        assert eventually(lambda: len(room.desks._seated()) == 2)
        assert len(players()) == before + 4
    assert eventually(lambda: len(players()) == before)


def test_a_browser_that_leaves_before_its_viewer_is_made_leaves_nothing(room: Room) -> None:
    before = len(players())
    room.free.clear()
    with room.browser(key("a")):
        assert eventually(lambda: room.desks._desks)
    assert eventually(lambda: not room.desks._desks)
    room.free.set()
    assert eventually(lambda: room.viewers)
    assert eventually(lambda: len(players()) == before)


def test_the_trouble_of_one_browser_is_not_anothers(room: Room, caplog: pytest.LogCaptureFixture) -> None:
    with room.browser(key("a")), room.browser(key("b")):
        assert room.shows(key("a"), NAME)
        assert room.shows(key("b"), NAME)
        broken = room.viewer_of(key("a"))

        def show(*_: object) -> None:
            raise RuntimeError("this desk is broken, says the test")

        broken.show = show  # pyright: ignore[reportAttributeAccessIssue]
        room.desks.put(key("b"), View(run=OTHER))
        assert room.shows(key("b"), OTHER)
        assert "this desk is broken" in caplog.text


def test_a_viewer_that_can_not_be_made_leaves_its_place_to_others(room: Room) -> None:
    room.breaking = True
    with room.browser(key("a")):
        assert eventually(lambda: room.guarded.server.get_clients())
        assert eventually(lambda: not room.desks._desks)
        room.breaking = False
        with room.browser(key("b")):
            assert room.shows(key("b"), NAME)


def test_no_more_views_are_kept_than_allowed(room: Room) -> None:
    for i in range(KEPT + 5):
        room.desks.put(key(f"{i}"), View(run=OTHER))
    assert room.desks.seen(key("4")).run is None
    assert room.desks.seen(key("5")).run == OTHER


@pytest.mark.parametrize("wrong", ["", "short", "a" * 65, "with-a-slash/of-the-tests", "-of-the-tests-desks%41"])
def test_a_key_that_is_none_is_left_out(room: Room, wrong: str) -> None:
    with room.browser(wrong):
        (client,) = eventually(lambda: list(room.guarded.server.get_clients().values()))  # pyright: ignore
        assert key_of(client) is None


def test_what_an_input_does_not_offer_is_not_put_back(room: Room) -> None:
    with room.browser(key("a")):
        assert room.shows(key("a"), NAME)
        before = room.desks.seen(key("a")).ticks
        room.desks.put(key("a"), View(run=NAME, ticks={"speed": 99.0, "loop": "yes", "trail": 1.0, "no such": True}))
        assert room.desks.seen(key("a")).ticks == before


# --- over HTTP --------------------------------------------------------------------------------------------------------


def test_a_page_reads_and_sets_what_its_viewer_shows(served: Served) -> None:
    wish = {"run": "run", "iteration": 3, "ticks": {"trail": True, "speed": 0.5}, "presents": True}
    address = f"/api/desks/{key('a')}"
    nothing = {"run": None, "iteration": None, "ticks": {}, "presents": False, "connected": False}
    assert served.client.get(address).json() == nothing
    assert served.client.put(address, json=wish).json() == wish
    assert served.client.get(address).json() == {**wish, "connected": True}


@pytest.mark.parametrize(
    "wish",
    [{"run": "r" * 129}, {"iteration": -1}, {"ticks": {"speed": 1e30}}, {"ticks": {str(i): True for i in range(65)}},
     {"ticks": {"speed": [1.0]}}, {"color": "red"}, {"run": 3}, {"presents": 1}],
)  # fmt: skip
def test_a_view_that_is_none_is_refused(served: Served, wish: dict[str, object]) -> None:
    assert served.client.put(f"/api/desks/{key('a')}", json=wish).status_code == 422
    assert served.viewer.views == {}


@pytest.mark.parametrize("wrong", ["short", "a" * 65, "with.a.dot.of.the.tests", "%2e%2e"])
def test_a_key_that_is_none_is_refused(served: Served, wrong: str) -> None:
    assert served.client.get(f"/api/desks/{wrong}").status_code in (404, 422)


def test_the_bridge_hands_the_key_on(served: Served) -> None:
    from test_bridge import browse, say

    found: list[str | None] = []
    served.viewer.server.on_client_connect(lambda client: found.append(key_of(client)))
    page: Callable[[str], int] = lambda path: served.client.get(path).status_code  # noqa: E731
    assert page(f"/viewer/{key('a')}/") == 200
    for path in (f"/viewer/{key('a')}", "/viewer/short", "/viewer"):
        with browse(served, path=path) as browser:
            say(browser, CAMERA)
            assert eventually(lambda: found)
        assert found.pop() == (key("a") if path.endswith(key("a")) else None)
