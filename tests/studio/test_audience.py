"""Spectators see what the presenter's browser shows, and the server refuses them everything else."""

import asyncio
import contextlib
import json
import math
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import httpx
import msgspec
import pytest
from conftest import TOKEN, Page, Served, append, eventually, make_run, progress, serving
from hypothesis import given
from hypothesis import strategies as st
from starlette.datastructures import Headers
from test_bridge import CAMERA, VERSION, closes, say
from test_scene_copy import connection, copy_of, decoded, made, placed
from test_security import addresses
from viser import _messages
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from morph_core.history import History
from studio import audience as audience_module
from studio import evolutions as evolutions_module
from studio.audience import Audience
from studio.desks import Presenting
from studio.evolutions import Evolutions
from studio.invitation import Invitation, may_ask
from studio.security import MOST_GUESSES, PAGES, Guesses
from studio.settings import Settings
from studio.spectators import aspect_of
from studio.viewer.presented import Presented, curves_of
from studio.viewer.scene_copy import SceneCopy

KEY = "a-spectator-of-the-tests"
SEEN = Presented(title="A task of the tests", run="a-run", iteration=7, latest=9)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("audience")
    with serving(Settings(port=0, runs=folder / "runs", token=TOKEN, hosts=(), state=folder)) as running:
        yield running


@dataclass
class Hall:
    """A server whose audience is open, and what a spectator's browser has."""

    served: Served
    state: dict[str, Any] = field(init=False)
    spectator: httpx.Client = field(init=False)

    def __post_init__(self) -> None:
        self.served.app.state.access.guesses = Guesses()
        self.state = self.served.client.post("/api/audience", json={}).json()
        self.spectator = self.browser()
        assert self.spectator.get(f"/{self.state['link']}").status_code == 303

    @property
    def audience(self) -> Audience:
        return self.served.app.state.audience

    def browser(self, **cookies: str) -> httpx.Client:
        return httpx.Client(base_url=f"http://127.0.0.1:{self.served.port}", cookies=cookies, verify=False, timeout=20)

    @contextlib.contextmanager
    def listening(self, key: str = KEY) -> Iterator[Iterator[tuple[str, Any]]]:
        """Take a seat; give the events that come."""
        with self.spectator.stream("GET", "/audience/events", params={"seat": key}, timeout=30) as stream:
            yield events_of(stream.iter_lines())

    def watch(
        self, key: str = KEY, path: str = "/audience/viewer/", cookies: httpx.Cookies | None = None
    ) -> ClientConnection:
        """Open the scene's websocket as a spectator's page does."""
        brought = cookies or self.spectator.cookies
        return connect(
            f"ws://127.0.0.1:{self.served.port}{path}{key}",
            origin=Origin(f"http://127.0.0.1:{self.served.port}"),
            additional_headers={"Cookie": "; ".join(f"{name}={value}" for name, value in brought.items())},
            subprotocols=[VERSION],
            max_size=None,
            proxy=None,
            close_timeout=0.3,
        )


@pytest.fixture
def hall(shared: Served) -> Iterator[Hall]:
    hall = Hall(shared)
    yield hall
    hall.spectator.close()
    shared.client.delete("/api/audience")
    shared.viewer.presents = None


def events_of(lines: Iterator[str]) -> Iterator[tuple[str, Any]]:
    """Yield kind and content of each event; whoever waits for one that does not come is not left waiting."""
    kind, silences = "", 0
    for line in lines:
        silences += line.startswith(":")
        assert silences < 3, "nothing more is said"
        if line.startswith("event: "):
            kind = line.removeprefix("event: ")
        elif line.startswith("data: "):
            yield kind, json.loads(line.removeprefix("data: "))


def next_of(events: Iterator[tuple[str, Any]], kind: str) -> Any:
    return next(content for name, content in events if name == kind)


def presenting(
    scene: SceneCopy, position: tuple[float, ...] = (0.0, -2.0, 1.0), history: History | None = None
) -> Presenting:
    """Return a browser that shows a scene, without a viewer behind it."""
    camera = SimpleNamespace(
        position=position, look_at=(0.0, 0.0, 0.0), up_direction=(0.0, 0.0, 1.0), fov=0.7, aspect=1.0
    )
    client: Any = SimpleNamespace(camera=camera)
    viewer: Any = SimpleNamespace(presented=(SEEN, history))
    return Presenting(client, viewer, scene)


# --- what is refused --------------------------------------------------------------------------------------------------

OPEN_TO_SPECTATORS = {
    ("GET", "/healthz"), ("GET", "/audience"), ("GET", "/audience/events"), ("GET", f"/audience/viewer/{KEY}/"),
    ("PUT", f"/audience/seats/{KEY}"), ("WEBSOCKET", f"/audience/viewer/{KEY}"),
    ("GET", f"/audience/runs/{KEY}/evolution.html"),
    *(("GET", f"/page/{name}")
      for name in ("audience.css", "audience.js", "icon.svg", "theme.js", "words.js", "vendor/charts.js")),
}  # fmt: skip


def test_of_all_routes_a_spectator_gets_the_short_list_alone(hall: Hall) -> None:
    page = files("studio") / "page"
    shipped = [f"/page/{name}" for name in names_in(page)]
    routes = {(method, path.replace("/x", f"/{KEY}")) for method, path in addresses(hall.served.app)}
    assert len(routes) > 50
    assert OPEN_TO_SPECTATORS - {("GET", "/healthz")} <= routes | {("GET", path) for path in shipped}
    for method, path in sorted(routes | {("GET", path) for path in shipped}):
        if method == "WEBSOCKET":
            status = status_of_socket(hall, path)
        else:
            status = hall.spectator.request(method, path).status_code
        if (method, path) in OPEN_TO_SPECTATORS:
            assert status in (200, 404, 422, 4403), (method, path, status)
        else:
            assert status == (401 if path in PAGES and method == "GET" else 403), (method, path, status)


def names_in(folder: Any, before: str = "") -> Iterator[str]:
    for each in folder.iterdir():
        yield from names_in(each, f"{before}{each.name}/") if each.is_dir() else [before + each.name]


def status_of_socket(hall: Hall, path: str) -> int:
    """Return the status with which a websocket is refused; 4403 where it is the seat that is missing."""
    try:
        with hall.watch(path, ""):
            return 101
    except InvalidStatus as error:
        return 4403 if path.startswith("/audience") else error.response.status_code


@pytest.mark.parametrize(
    "path",
    ["/audience/", "//audience", "/audience/viewer", "/audience/viewer/short/", f"/audience/viewer/{KEY}/../../x",
     "/page/../api/runs", "/page/index.html", "/audience/../api/runs", "/AUDIENCE", "/audience%2f..%2fapi%2fruns",
     "/audience\n", "/nowhere", "/audience/runs/a/../b/evolution.html", "/audience/runs/.trash/evolution.html",
     "/audience/runs/a-run/evolution.html/..", "/audience/runs/a%2fb/evolution.html"],
)  # fmt: skip
def test_no_odd_path_leads_a_spectator_further(hall: Hall, path: str) -> None:
    with socket.create_connection(("127.0.0.1", hall.served.port)) as raw:
        cookie = "; ".join(f"{name}={value}" for name, value in hall.spectator.cookies.items())
        head = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{hall.served.port}\r\nCookie: {cookie}\r\n\r\n"
        raw.sendall(head.encode())
        assert raw.recv(4096).split()[1] in (b"403", b"400")


def test_what_is_allowed_is_so_by_one_method_alone() -> None:
    for path in (
        "/audience",
        "/audience/events",
        f"/audience/seats/{KEY}",
        f"/audience/viewer/{KEY}",
        "/audience/runs/a-run/evolution.html",
        "/page/theme.js",
    ):
        assert sum(may_ask(method, path) for method in ("GET", "PUT", "POST", "PATCH", "DELETE", "WEBSOCKET")) == 1, (
            path
        )


def test_each_kind_of_message_but_the_camera_is_dropped_and_viser_hears_none(hall: Hall) -> None:
    kinds = [kind for kind in _messages.Message.get_subclasses() if not kind.__name__.startswith("_")]
    assert len(kinds) > 100
    heard: list[str] = []
    server = hall.served.viewer.server._websock_server
    for kind in kinds:
        server.register_handler(kind, lambda _, message: heard.append(type(message).__name__))
    extra = {"uuid": "u", "updates": {"value": 1}, "name": "/robot/box", "value": True, "position": [9, 9, 9]}
    with hall.listening() as events:
        next_of(events, "stage")
        with hall.watch() as browser:
            for kind in kinds:
                message = {**CAMERA, **extra, "type": kind.__name__}
                if kind is not _messages.ViewerCameraMessage:
                    assert aspect_of(msgspec.msgpack.encode(message)) is None, kind
            for kind in (_messages.GuiUpdateMessage, _messages.CommandTriggerMessage, _messages.ShareUrlRequest):
                say(browser, {**CAMERA, **extra, "type": kind.__name__})
            say(browser, {**CAMERA, "image_width": 300, "image_height": 200})
            seat = hall.audience.seat(KEY)
            assert seat is not None
            assert eventually(lambda: seat.aspect == 1.5)
    assert heard == []


@given(st.binary(max_size=200))
def test_no_bytes_break_what_reads_them(message: bytes) -> None:
    assert aspect_of(message) is None


@given(st.dictionaries(st.sampled_from(sorted(CAMERA)), st.floats() | st.text() | st.lists(st.floats()) | st.none()))
def test_a_camera_that_is_none_is_dropped(forged: dict[str, object]) -> None:
    aspect = aspect_of(msgspec.msgpack.encode(CAMERA | forged))
    assert aspect is None or 0.1 <= aspect <= 10


def test_a_message_that_is_too_long_is_dropped() -> None:
    assert aspect_of(msgspec.msgpack.encode(CAMERA)) == 1.0
    assert aspect_of(msgspec.msgpack.encode(CAMERA | {"more": "x" * 5000})) is None


def test_cookies_links_and_tokens_are_worth_nothing_in_each_others_place(hall: Hall) -> None:
    access = hall.served.app.state.access
    own, other = access.cookie_name, access.invitation.cookie_name
    ticket = access.invitation.ticket
    for cookies in (
        {own: access.invitation.cookie},
        {own: ticket},
        {other: access.cookie},
        {other: TOKEN},
        {other: ""},
    ):
        with hall.browser(**cookies) as browser:
            assert browser.get("/audience").status_code == 401
            assert browser.get("/api/runs").status_code == 401
    with hall.browser() as browser:
        assert browser.get("/", params={"token": ticket}).status_code == 401
        assert browser.get("/api/runs", headers={"Authorization": f"Bearer {ticket}"}).status_code == 401
        assert browser.get("/audience", params={"link": TOKEN}).status_code == 401
        assert "let anybody in" in browser.get("/audience", params={"link": "<script>"}).text
    assert not Invitation("name").has_cookie(Headers({"Cookie": "name="}))


def test_whoever_has_the_token_may_watch_too(hall: Hall) -> None:
    assert hall.served.client.get("/audience").status_code == 200
    with hall.browser(**dict(hall.spectator.cookies)) as browser:
        assert browser.get("/", params={"token": TOKEN}).status_code == 303
        assert browser.get("/api/runs").status_code == 200


def test_wrong_links_are_slowed_and_spectators_are_not(hall: Hall) -> None:
    with hall.browser() as stranger:
        answers = [stranger.get("/audience", params={"link": f"guess{i}"}).status_code for i in range(MOST_GUESSES)]
        assert set(answers) == {401}
        assert stranger.get(f"/{hall.state['link']}").status_code == 429
    assert hall.spectator.get("/audience", params={"link": "an old one"}).status_code == 200
    assert hall.spectator.get("/", params={"token": "guess"}).status_code == 429
    hall.served.app.state.access.guesses = Guesses()


def test_a_preview_of_the_link_is_neither_let_in_nor_counted(hall: Hall) -> None:
    with hall.browser() as preview:
        for _ in range(MOST_GUESSES + 1):
            answer = preview.get(f"/{hall.state['link']}", headers={"User-Agent": "Slackbot"})
            assert answer.status_code == 401
            assert "set-cookie" not in answer.headers


@pytest.mark.parametrize(("site", "secure"), [("http", False), ("https", True)])
def test_under_a_prefix_the_link_leads_to_the_page_below_it(hall: Hall, site: str, secure: bool) -> None:
    headers = {"X-Forwarded-Prefix": "/user/me", "X-Forwarded-Proto": site}
    with hall.browser() as browser:
        entered = browser.get(f"/{hall.state['link']}", headers=headers)
        assert (entered.status_code, entered.headers["location"]) == (303, "./audience")
        cookie = entered.headers["set-cookie"].lower()
        assert "httponly" in cookie
        assert ("secure" in cookie) is secure
        browser.cookies.set(*next(iter(hall.spectator.cookies.items())))
        assert browser.get("/audience", headers=headers).status_code == 200
        assert browser.get("/api/runs", headers=headers).status_code == 403


# --- the link ---------------------------------------------------------------------------------------------------------


def test_a_revoked_link_sends_all_away_at_once_and_a_new_one_is_new(hall: Hall) -> None:
    with hall.listening() as events:
        next_of(events, "stage")
        assert hall.served.client.get("/api/audience").json()["watching"] == 1
        with hall.watch() as browser:
            state = hall.served.client.delete("/api/audience").json()
            assert (state["open"], state["link"], state["watching"]) == (False, None, 0)
            assert "has ended this link" in next_of(events, "ended")
            assert closes(browser) == 4403
    assert hall.spectator.get("/audience").status_code == 401
    assert hall.spectator.get("/audience/events", params={"seat": KEY}).status_code == 401
    with pytest.raises(InvalidStatus):
        hall.watch()
    again = hall.served.client.post("/api/audience", json={}).json()["link"]
    assert again != hall.state["link"]
    assert hall.spectator.get(f"/{hall.state['link']}").status_code == 401
    assert hall.spectator.get(f"/{again}").status_code == 303
    assert hall.served.client.post("/api/audience", json={"presenter": "the-key-of-a-page"}).json()["link"] == again


@pytest.mark.parametrize("wish", [{"presenter": "short"}, {"presenter": 3}, {"link": "mine"}, []])
def test_an_invitation_that_is_none_is_refused(hall: Hall, wish: object) -> None:
    assert hall.served.client.post("/api/audience", json=wish).status_code == 422


def test_a_scene_needs_a_seat_and_the_client_of_this_viser(hall: Hall) -> None:
    with pytest.raises(InvalidStatus):
        hall.watch()
    assert hall.spectator.put(f"/audience/seats/{KEY}", json={"follows": False}).status_code == 404
    with hall.listening() as events:
        next_of(events, "stage")
        for wish in ({"follows": 1}, {}, {"follows": True, "run": "x"}):
            assert hall.spectator.put(f"/audience/seats/{KEY}", json=wish).status_code == 422
        assert hall.spectator.put(f"/audience/seats/{KEY}", json={"follows": False}).json() == {"follows": False}
        with hall.watch() as first, hall.watch():
            assert closes(first) == 1000, "a page has one scene"
    assert eventually(lambda: hall.audience.state.watching == 0)


def test_one_too_many_is_told_so_in_words(hall: Hall, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audience_module, "MOST", 1)
    with hall.listening() as events:
        next_of(events, "stage")
        with hall.listening("another-spectator-here") as more:
            assert "no place for more" in next_of(more, "full")
        with hall.listening(KEY) as again:
            next_of(again, "stage")  # the same page, come again
            assert "come again" in next_of(events, "ended")


def test_spectators_are_told_what_is_shown_and_when_nobody_shows_anything(
    hall: Hall, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audience_module, "_LEFT_AFTER", 0.1)
    with hall.listening() as events:
        stage = next_of(events, "stage")
        assert (stage["phase"], stage["watching"]) == ("waiting", 1)
        hall.served.viewer.presents = presenting(copy_of(connection()))
        stage = next(s for kind, s in events if kind == "stage" and s["phase"] == "on" and s["seen"]["run"])
        assert (stage["seen"]["title"], stage["seen"]["iteration"]) == ("A task of the tests", 7)
        hall.served.viewer.presents = None
        left = next(s for kind, s in events if kind == "stage" and s["phase"] == "left")
        assert left["seen"]["run"] == "a-run", "what was seen last stays"


# --- on one's own -----------------------------------------------------------------------------------------------------


def test_a_spectator_looks_alone_at_runs_that_were_shown_and_at_no_others(hall: Hall) -> None:
    shown, other = (make_run(hall.served.runs.folder, f"2026010{i}-000000-reacher-morph-s0") for i in (1, 2))
    hall.served.viewer.presents = presenting(copy_of(connection()), history=History(shown))
    with hall.listening() as events:
        assert next(s["runs"] for kind, s in events if kind == "stage" and s["runs"]) == [shown.id]
        answer = hall.spectator.get(f"/audience/runs/{shown.id}/evolution.html")
        assert (answer.status_code, answer.headers["content-type"]) == (200, "text/html; charset=utf-8")
        assert answer.headers["content-security-policy"].startswith("sandbox allow-scripts;"), "of no origin"
        assert "default-src 'none'" in answer.text, "it asks the server for nothing"
        refused = hall.spectator.get(f"/audience/runs/{other.id}/evolution.html")
        assert (refused.status_code, "has not shown this run" in refused.text) == (404, True)
        hall.served.client.delete("/api/audience")
    assert hall.audience.offered == (), "the next audience begins anew"
    hall.served.client.post("/api/audience", json={})
    assert hall.served.client.get(f"/audience/runs/{shown.id}/evolution.html").status_code == 404


def test_the_page_of_a_run_is_written_once_for_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, written = make_run(tmp_path), []

    def build(histories: list[History]) -> Any:
        written.append(histories[0].iteration)
        return SimpleNamespace(content=b"iteration %d" % histories[0].iteration)

    monkeypatch.setattr(evolutions_module, "build_evolution", build)

    async def look() -> None:
        pages = Evolutions(lambda _: History(folder))
        async with anyio.create_task_group() as tasks:
            for _ in range(5):
                tasks.start_soon(pages.page, "a run")
        append(folder, progress(4))
        assert await pages.page("a run") == b"iteration 3"
        monkeypatch.setattr(evolutions_module, "REST", 0.0)
        monkeypatch.setattr(evolutions_module, "SHARE", math.inf)
        assert await pages.page("a run") == b"iteration 4"
        await pages.page("a run")  # it has not gone on
        for i in range(evolutions_module.KEPT):
            await pages.page(f"another run {i}")
        await pages.page("a run")

    anyio.run(look)
    assert written == [3, 4, *[4] * evolutions_module.KEPT, 4], "of few runs it is kept"


# --- the scene --------------------------------------------------------------------------------------------------------


@dataclass
class Stage:
    """An audience at work without a server, and the scene that it watches."""

    audience: Audience = field(default_factory=lambda: Audience(Invitation("name")))
    scene: SceneCopy = field(default_factory=lambda: copy_of(connection()))
    encoded: list[int] = field(default_factory=list)
    """Number of messages of each frame that was encoded."""
    present: Presenting | None = None

    def presenting(self, key: str | None) -> Presenting | None:
        del key
        return self.present or presenting(self.scene)


def at_work(do: Callable[[Stage], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Run `do` beside an audience at work, looking often."""
    stage, real = Stage(), audience_module.frame_of

    def frame_of(messages: Any, *, first: bool = False) -> bytes:
        stage.encoded.append(len(messages))
        return real(messages, first=first)

    monkeypatch.setattr(audience_module, "frame_of", frame_of)
    monkeypatch.setattr(audience_module, "SCENES_A_SECOND", 200.0)

    async def play() -> None:
        async with anyio.create_task_group() as tasks:
            stopping = anyio.Event()
            tasks.start_soon(stage.audience.run, stage, stopping)
            with anyio.fail_after(10):
                await do(stage)
            stopping.set()

    asyncio.run(play())


async def next_frame(frames: AsyncIterator[bytes]) -> list[dict[str, Any]]:
    return decoded(await anext(frames))


async def pointed(frames: AsyncIterator[bytes]) -> list[float]:
    """Return where the next frame puts the camera, which looks at the origin."""
    messages = {message["type"]: message for message in await next_frame(frames)}
    assert messages["SetCameraLookAtMessage"]["look_at"] == [0.0, 0.0, 0.0]
    return messages["SetCameraPositionMessage"]["position"]


def test_a_frame_is_encoded_once_for_all_and_a_slow_spectator_gets_fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    async def do(stage: Stage) -> None:
        stage.scene._insert_message(made("a"))
        seats = [stage.audience.take_seat(f"spectator-number-{i:04d}") for i in range(20)]
        assert None not in seats
        frames = [stage.audience.scenes(seat, seat) for seat in seats if seat]
        for each in frames:
            assert [m["type"] for m in await next_frame(each)] == ["FrameMessage", "ReplayDoneMessage"]
        slow, *fast = frames
        for x in range(5):
            stage.scene._insert_message(placed("a", float(x)))
            for each in fast:
                (moved,) = await next_frame(each)
                assert moved["position"] == [float(x), 0.0, 0.0]
        (moved,) = await next_frame(slow)
        assert moved["position"] == [4.0, 0.0, 0.0], "what it missed it does not get"
        assert len(stage.encoded) == 1 + 5 + 1

    at_work(do, monkeypatch)


def test_a_camera_follows_the_presenters_until_a_spectator_looks_round(monkeypatch: pytest.MonkeyPatch) -> None:
    async def do(stage: Stage) -> None:
        stage.scene._insert_message(made("a"))
        seat = stage.audience.take_seat(KEY)
        assert seat is not None
        frames = stage.audience.scenes(seat, seat)
        await next_frame(frames)
        stage.audience.hear(seat, 0.36)
        assert await pointed(frames) == [0.0, -4.0, 2.0], "a narrow page sees all of it"
        stage.audience.hear(seat, 1.5)
        assert await pointed(frames) == [0.0, -2.0, 1.0]
        stage.audience.follow(seat, False)
        stage.present = presenting(stage.scene, (5.0, 0.0, 0.0))
        stage.scene._insert_message(placed("a", 1.0))
        assert [m["type"] for m in await next_frame(frames)] == ["SetPositionMessage"]
        stage.scene._insert_message(placed("a", 2.0))
        assert [m["type"] for m in await next_frame(frames)] == ["SetPositionMessage"], "and no camera in between"
        stage.audience.follow(seat, True)
        assert await pointed(frames) == [5.0, 0.0, 0.0]

    at_work(do, monkeypatch)


def test_another_browser_takes_the_first_ones_scene_away(monkeypatch: pytest.MonkeyPatch) -> None:
    async def do(stage: Stage) -> None:
        stage.scene._insert_message(made("a"))
        seat = stage.audience.take_seat(KEY)
        assert seat is not None
        frames = stage.audience.scenes(seat, seat)
        await next_frame(frames)
        other = copy_of(connection())
        other._insert_message(made("b"))
        stage.present = presenting(other)
        assert [(m["type"], m["name"]) for m in await next_frame(frames)] == [("RemoveSceneNodeMessage", "a")]
        assert [(m["type"], m["name"]) for m in await next_frame(frames)] == [("FrameMessage", "b")]

    at_work(do, monkeypatch)


def test_a_spectator_who_takes_nothing_holds_nobody_up(hall: Hall) -> None:
    scene = copy_of(connection())
    scene._insert_message(made("a"))
    hall.served.viewer.presents = presenting(scene)
    stop = threading.Event()

    def move() -> None:
        big = _messages.SceneNodeUpdateMessage
        while not stop.wait(0.01):
            scene._insert_message(big("a", {"points": "x" * 200_000}))

    mover = threading.Thread(target=move)
    with hall.listening("a-spectator-who-is-slow") as slow, hall.listening() as events:
        next_of(slow, "stage")
        next_of(events, "stage")
        with hall.watch("a-spectator-who-is-slow") as stalled, hall.watch() as browser:
            stalled.recv()
            mover.start()
            try:
                taken = [len(browser.recv(timeout=30)) for _ in range(20)]
            finally:
                stop.set()
                mover.join()
    assert len(taken) == 20


def test_a_spectators_page_that_leaves_frees_its_place_and_scene(hall: Hall) -> None:
    with contextlib.ExitStack() as stack:
        with hall.listening() as events:
            next_of(events, "stage")
            browser = stack.enter_context(hall.watch())
        assert eventually(lambda: hall.audience.state.watching == 0)
        assert closes(browser) == 4403


# --- what is said -----------------------------------------------------------------------------------------------------


def test_the_viewer_says_what_it_shows(page: Page, tmp_path: Any) -> None:
    folder = make_run(tmp_path / "runs", ended="finished")
    page.show(folder)
    page.take()
    seen, history = page.viewer.presented
    assert history is not None
    assert (seen.run, seen.method, seen.status) == (folder.id, "morph", "finished")
    assert seen.iteration == page.viewer.timeline.shown_iteration
    assert "arm" in seen.title.lower() or seen.title
    assert any(entry.words == "goal" for entry in seen.legend)
    page.viewer.stage.play(history, "recorded", "")
    assert eventually(lambda: page.viewer.presented[0].doing == "its evolution in short")
    page.viewer.stage.end_film()
    page.viewer.timeline.turn_to(0)
    assert page.viewer.presented[0].success is None, "of an evaluation that came later"
    page.viewer.open(None)
    seen, history = page.viewer.presented
    assert (seen.run, history) == (None, None)


def test_the_curves_of_a_run_are_thinned_and_begin_with_none(tmp_path: Any) -> None:
    folder = make_run(tmp_path / "runs", ended="finished")
    history = History(folder)
    (evaluation,) = history.evaluations[:1]
    history.evaluations[:] = []
    assert curves_of(history).iteration == []
    history.evaluations[:] = [msgspec.structs.replace(evaluation, iteration=i) for i in range(1000)]
    curves = curves_of(history)
    assert len(curves.iteration) == 200
    assert (curves.iteration[0], curves.iteration[-1]) == (0, 999)
    (links,) = curves.phi
    assert (links.name, links.unit) == ("link", "m")
    assert [curve.name for curve in links.curves] == ["1", "2", "3", "4", "5"]
    assert {len(curve.values) for curve in links.curves} == {200}
