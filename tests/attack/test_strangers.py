"""What somebody without a token can take from the studio: no time, no connections, and a line of the log a minute."""

import contextlib
import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
import pytest
import uvicorn
from hypothesis import example, given
from hypothesis import strategies as st
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send

from studio import patience
from studio.credentials import cookie_of
from studio.patience import PatientProtocol
from studio.security import GUESSED_WITHIN, MOST_GUESSES, MOST_GUESSES_OF_ALL, Guesses
from studio.seldom import SaidOnce, Seldom
from studio.settings import Settings
from tests.studio.conftest import TOKEN, Served, eventually, serving

WRONG = {"Authorization": "Bearer wrong"}


@pytest.fixture
def served(tmp_path) -> Iterator[Served]:
    with serving(Settings(port=0, runs=tmp_path / "runs", token=TOKEN, hosts=(), state=tmp_path)) as running:
        yield running


# --- cookies --------------------------------------------------------------------------------------------------------


@given(junk=st.text(st.characters(codec="latin-1", exclude_characters="\r\n\0"), max_size=60), after=st.booleans())
@example(junk='a="' + '\\"' * 30_000 + '"', after=True)  # over which the standard library is busy for seconds
def test_a_cookie_is_found_among_any_others_at_once(junk: str, after: bool) -> None:
    cookies = [junk.replace("mine", "his"), "mine=word"]
    header = "; ".join(cookies if after else reversed(cookies))
    assert cookie_of(Headers({"cookie": header}), "mine") == "word"
    assert cookie_of(Headers({"cookie": junk.replace("mine", "his")}), "mine") == ""


# --- tokens -----------------------------------------------------------------------------------------------------------


def test_wrong_tokens_are_slowed_and_the_cookie_still_opens(served: Served) -> None:
    address = f"http://127.0.0.1:{served.port}"
    assert served.client.get("/", params={"token": TOKEN}).status_code == 303
    with httpx.Client(base_url=address) as stranger:
        answers = [stranger.get("/api/runs", headers=WRONG).status_code for _ in range(MOST_GUESSES // 2)]
        answers += [stranger.get("/", params={"token": f"guess{i}"}).status_code for i in range(MOST_GUESSES // 2)]
        assert set(answers) == {401}
        refused = stranger.get("/api/runs", headers=WRONG)
        assert refused.status_code == 429
        assert refused.headers["retry-after"] == "60"
        assert stranger.get("/", params={"token": TOKEN}).status_code == 429, "not even the right one is looked at"
        assert stranger.get("/healthz").status_code == 200
    with httpx.Client(base_url=address, cookies=served.client.cookies) as owner:
        assert owner.get("/api/runs").status_code == 200
        assert owner.get("/api/runs", headers=WRONG).status_code == 200, "whatever else it brings"


def test_one_address_does_not_keep_another_out_and_all_together_have_an_end() -> None:
    now = [0.0]
    guesses = Guesses(lambda: now[0])
    for _ in range(MOST_GUESSES):
        assert not guesses.are_too_many("a")
        guesses.note("a")
    assert guesses.are_too_many("a")
    assert not guesses.are_too_many("b")
    now[0] = GUESSED_WITHIN
    assert not guesses.are_too_many("a")
    for number in range(MOST_GUESSES_OF_ALL):
        guesses.note(str(number))
    assert guesses.are_too_many("new")


def test_no_token_at_all_is_no_guess(served: Served) -> None:
    with httpx.Client(base_url=f"http://127.0.0.1:{served.port}") as stranger:
        assert {stranger.get("/api/runs").status_code for _ in range(2 * MOST_GUESSES)} == {401}
        assert stranger.get("/api/runs", headers={"Authorization": f"Bearer {TOKEN}"}).status_code == 200


# --- the log ----------------------------------------------------------------------------------------------------------


def test_refused_websockets_write_a_line_a_minute(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    handshake = (
        f"GET /viewer HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\nOrigin: http://evil\r\n\r\n"
    )
    with caplog.at_level(logging.WARNING):
        for _ in range(30):
            with socket.create_connection(("127.0.0.1", served.port)) as stranger:
                stranger.sendall(handshake.encode())
                assert b" 403 " in stranger.recv(100)
    assert [record.message for record in caplog.records if record.name.startswith("studio")] == [
        "refused a websocket of 127.0.0.1"
    ]


def test_a_seldom_warning_counts_what_it_has_not_said(caplog: pytest.LogCaptureFixture) -> None:
    now = [0.0]
    warning = Seldom(logging.getLogger("studio.test"), lambda: now[0])
    with caplog.at_level(logging.WARNING):
        for now[0] in (0.0, 1.0, 59.9, 60.0, 61.0):
            warning.warn("trouble")
    assert [record.message for record in caplog.records] == ["trouble", "trouble (2 more since the last line)"]
    assert not any(record.exc_info for record in caplog.records)
    now[0] = 130.0
    try:
        raise ValueError("deep inside")
    except ValueError:
        warning.warn("trouble", traceback=True)
    assert caplog.records[-1].levelno == logging.ERROR
    assert caplog.records[-1].exc_info


def test_a_line_is_said_once_a_minute_a_traceback_always_and_what_others_say_never() -> None:
    now = [0.0]
    said = SaidOnce("never", lambda: now[0])

    def passes(sentence: str, traceback: object = None) -> bool:
        return said.filter(logging.LogRecord("x", logging.ERROR, "", 1, sentence, (), traceback))  # pyright: ignore

    assert [passes("a"), passes("a"), passes("b"), passes("never")] == [True, False, True, False]
    assert passes("a", (ValueError, ValueError(), None))
    now[0] = 60.0
    assert passes("a")


# --- connections ------------------------------------------------------------------------------------------------------


@contextmanager
def listening(
    monkeypatch: pytest.MonkeyPatch, seconds: float, most: int = 128, body: bytes = b"hello"
) -> Iterator[tuple[uvicorn.Server, int]]:
    """Serve an application that reads bodies whole and answers with one, with so much patience."""

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            while (await receive()).get("more_body"):
                pass
            await PlainTextResponse(body)(scope, receive, send)

    monkeypatch.setattr(patience, "SECONDS", seconds)
    monkeypatch.setattr(patience, "MOST_WAITING", most)
    listener = socket.create_server(("127.0.0.1", 0))
    config = uvicorn.Config(app, log_level="error", http=PatientProtocol, lifespan="off", timeout_keep_alive=1)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    assert eventually(lambda: server.started)
    yield server, listener.getsockname()[1]
    server.should_exit = True
    thread.join(10)


UNFINISHED = {
    "nothing": b"",
    "half a header": b"GET / HTTP/1.1\r\nHost: x\r\nX-Long: ",
    "half a body": b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 1000\r\n\r\nhalf",
    "a second half header": b"GET / HTTP/1.1\r\nHost: x\r\n\r\nGET / HT",
    "a chunk without an end": b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhe",
}


def test_what_is_not_finished_is_closed_and_others_are_served_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    with listening(monkeypatch, 0.3) as (server, port):
        slow = [socket.create_connection(("127.0.0.1", port)) for _ in UNFINISHED for _ in range(4)]
        for number, connection in enumerate(slow):
            connection.sendall(list(UNFINISHED.values())[number % len(UNFINISHED)])
        assert httpx.get(f"http://127.0.0.1:{port}/").text == "hello"
        assert eventually(lambda: not server.server_state.connections)
        for connection in slow:
            connection.close()


@pytest.mark.parametrize("field", ["Protocol: \xff,,", "Version: \xff", "Protocol: a b", "Key: \xff"])
def test_a_header_of_a_websocket_that_nobody_can_read_leaves_no_traceback(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, field: str
) -> None:
    right = {"Key": "dGhlIHNhbXBsZSBub25jZQ==", "Version": "13", **dict([field.split(": ")])}
    header = "".join(f"Sec-WebSocket-{name}: {value}\r\n" for name, value in right.items())
    with listening(monkeypatch, 60) as (server, port):
        with socket.create_connection(("127.0.0.1", port), 5) as stranger:
            upgrade = "GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            stranger.sendall((upgrade + header + "\r\n").encode("latin-1"))
            stranger.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionError):
                while stranger.recv(1000):
                    pass
        assert httpx.get(f"http://127.0.0.1:{port}/").text == "hello"
        assert eventually(lambda: not server.server_state.connections)
    assert not [record for record in caplog.records if record.exc_info]


ENDLESS = {
    "one header": (b"GET / HTTP/1.1\r\nHost: x\r\nX-Long: ", b"x" * 65536),
    "many headers": (b"GET / HTTP/1.1\r\nHost: x\r\n", b"X-More: x\r\n" * 5000),
    "an address": (b"GET /", b"x" * 65536),
    "a second header": (b"GET / HTTP/1.1\r\nHost: x\r\n\r\nGET / HTTP/1.1\r\nX-Long: ", b"x" * 65536),
    "trailers": (
        b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n1\r\nx\r\n0\r\n",
        b"X-More: x\r\n" * 5000,
    ),
    "an extension of a chunk": (b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n1;", b"x" * 65536),
}


@pytest.mark.parametrize("what", ENDLESS)
def test_what_never_ends_is_not_read_for_long(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    first, again = ENDLESS[what]
    with listening(monkeypatch, 60) as (_, port), socket.create_connection(("127.0.0.1", port), 5) as stranger:
        stranger.sendall(first)
        with pytest.raises(OSError):  # noqa: PT011 - reset, or closed
            stranger.sendall(again * (4 * patience.LONGEST_REQUEST // len(again)))
        assert httpx.get(f"http://127.0.0.1:{port}/").text == "hello"


def test_an_answer_that_nobody_takes_holds_no_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    with listening(monkeypatch, 0.3, body=b"x" * (8 << 20)) as (server, port):
        with socket.socket() as stranger:
            stranger.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            stranger.connect(("127.0.0.1", port))
            stranger.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
            assert eventually(lambda: server.server_state.connections)
            assert eventually(lambda: not server.server_state.connections)
        assert len(httpx.get(f"http://127.0.0.1:{port}/").content) == 8 << 20


def test_one_that_waits_gives_way_where_too_many_do(monkeypatch: pytest.MonkeyPatch) -> None:
    with listening(monkeypatch, 60, most=10) as (server, port):
        idle = [socket.create_connection(("127.0.0.1", port)) for _ in range(40)]
        assert eventually(lambda: 0 < len(server.server_state.connections) <= 11)
        assert httpx.get(f"http://127.0.0.1:{port}/").text == "hello"
        for connection in idle:
            connection.close()


def test_a_slow_answer_and_a_slow_but_whole_request_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    with listening(monkeypatch, 1.0) as (_, port), socket.create_connection(("127.0.0.1", port)) as careful:
        for piece in (b"POST / HTTP/1.1\r\nHost: x\r\n", b"Content-Length: 4\r\n\r\n", b"ab", b"cd"):
            careful.sendall(piece)
            threading.Event().wait(0.2)
        assert careful.recv(1000).startswith(b"HTTP/1.1 200")
