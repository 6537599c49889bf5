"""Every route and websocket is closed to wrong names, foreign pages and the unknown; only /healthz is open."""

import re
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import anyio
import httpx
import pytest
from conftest import TOKEN, Served, serving
from fastapi import FastAPI
from starlette.datastructures import Headers
from starlette.routing import BaseRoute, Mount, WebSocketRoute
from starlette.types import Message, Receive, Scope, Send
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from studio.negotiation import Negotiated, takes_gzip
from studio.security import OPEN_PATHS, Access, Guesses, kept_key
from studio.settings import Settings

PLAIN = httpx.Client(verify=False)
"""One client for all: making one costs more than a request."""


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("served")
    with serving(Settings(port=0, runs=folder / "runs", token=TOKEN, hosts=(), state=folder)) as running:
        yield running


def addresses(app: FastAPI) -> list[tuple[str, str]]:
    """Return (method, path) of every route of the application, with something in place of each parameter."""
    found = [(method, path) for route in flat(app.routes) for method, path in calls(route)]
    assert len(found) > 15
    return found


def flat(routes: list[BaseRoute]) -> Iterator[BaseRoute]:
    for route in routes:
        inner = getattr(route, "routes", None) or getattr(getattr(route, "original_router", None), "routes", None)
        if inner and not isinstance(route, Mount):
            yield from flat(inner)
        else:
            yield route


def calls(route: BaseRoute) -> Iterator[tuple[str, str]]:
    path = re.sub(r"\{[^}]*\}", "x", getattr(route, "path", ""))
    if isinstance(route, WebSocketRoute):
        yield "WEBSOCKET", path
    elif isinstance(route, Mount):
        yield "GET", f"{path}/icon.svg"
    else:
        for method in sorted(getattr(route, "methods", None) or ()):
            yield method, path


def answer(served: Served, method: str, path: str, headers: dict[str, str]) -> int:
    """Return the status of one request on a fresh connection; 101 for a websocket that opened."""
    served.app.state.access.guesses = Guesses()  # tests/attack/test_strangers.py has what too many do
    headers = {"Host": f"127.0.0.1:{served.port}", **headers}
    if method == "WEBSOCKET":
        host = headers.pop("Host")
        origin = Origin(headers.pop("Origin")) if "Origin" in headers else None
        try:
            with connect(
                f"ws://{host}{path}", sock=socket.create_connection(("127.0.0.1", served.port)), origin=origin,
                additional_headers=headers, subprotocols=[Subprotocol("viser-v1.1.1")], proxy=None,
            ):  # fmt: skip
                return 101
        except InvalidStatus as error:
            return error.response.status_code
    return PLAIN.request(method, f"http://127.0.0.1:{served.port}{path}", headers=headers).status_code


def own_origin(served: Served) -> dict[str, str]:
    return {"Origin": f"http://127.0.0.1:{served.port}"}


def test_the_walk_over_routes_finds_the_public_ones(shared: Served) -> None:
    found = set(addresses(shared.app))
    assert {
        ("GET", "/"), ("GET", "/viewer/"), ("WEBSOCKET", "/viewer"), ("GET", "/healthz"), ("GET", "/docs"),
        ("GET", "/api/tasks"), ("GET", "/api/runs"), ("POST", "/api/runs"), ("GET", "/api/runs/x"),
        ("POST", "/api/runs/x/commands"), ("POST", "/api/runs/x/resume"), ("GET", "/api/runs/x/events"),
        ("GET", "/api/runs/x/metrics"), ("GET", "/api/runs/x/designs"), ("GET", "/api/runs/x/episodes/x"),
        ("GET", "/api/runs/x/designs/x/export"), ("GET", "/page/icon.svg"),
    } <= found  # fmt: skip


def test_without_a_token_everything_but_healthz_answers_401(shared: Served) -> None:
    for method, path in addresses(shared.app):
        for headers in ({}, {"Authorization": "Bearer wrong"}, {"Cookie": f"{shared.app.state.access.cookie_name}=x"}):
            status = answer(shared, method, path, headers | own_origin(shared))
            assert status == (200 if path in OPEN_PATHS else 401), (method, path, headers)


def test_a_path_that_no_route_has_answers_401_too(shared: Served) -> None:
    assert answer(shared, "GET", "/nowhere", {}) == 401


@pytest.mark.parametrize(
    "host",
    [
        "evil.example", "evil.example:80", "localhost.evil.example", "127.0.0.1.evil.example", "127.0.0.2", "0.0.0.0",
        "user@localhost", "localhost:port", "[::2]", "localhost/", "",
    ],
)  # fmt: skip
def test_a_wrong_host_answers_403_everywhere(shared: Served, host: str) -> None:
    for method, path in addresses(shared.app):
        if method == "WEBSOCKET" and ("@" in host or "/" in host or "port" in host or not host or "[" in host):
            continue  # no such address can be written down
        status = answer(shared, method, path, {"Host": host, "Authorization": f"Bearer {TOKEN}"})
        assert status in ((403, 400) if not host else (403,)), (method, path)


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:9000", "[::1]:8000", "LOCALHOST:1"])
def test_the_names_of_this_machine_are_right_hosts(shared: Served, host: str) -> None:
    assert answer(shared, "GET", "/healthz", {"Host": host}) == 200


def test_x_forwarded_host_is_not_believed(shared: Served) -> None:
    headers = {"Host": "evil.example", "X-Forwarded-Host": "localhost", "Authorization": f"Bearer {TOKEN}"}
    assert answer(shared, "GET", "/api/runs", headers) == 403


@pytest.mark.parametrize("cookie", [False, True])
@pytest.mark.parametrize(
    "origin",
    [
        "https://evil.example", "null", "http://127.0.0.1", "http://127.0.0.1:1", "http://127.0.0.1:{port}.evil.example",
        "http://localhost:{port}", "file://", "http://evil.example/127.0.0.1:{port}", "ftp://127.0.0.1:{port}",
    ],
)  # fmt: skip
def test_a_foreign_origin_answers_403_everywhere(shared: Served, origin: str, cookie: bool) -> None:
    access = shared.app.state.access
    known = {"Cookie": f"{access.cookie_name}={access.cookie}"} if cookie else {"Authorization": f"Bearer {TOKEN}"}
    for method, path in addresses(shared.app):
        headers = {"Origin": origin.format(port=shared.port), **known}
        assert answer(shared, method, path, headers) == 403, (method, path)


def test_a_websocket_without_an_origin_is_refused(shared: Served) -> None:
    assert answer(shared, "WEBSOCKET", "/viewer", {"Authorization": f"Bearer {TOKEN}"}) == 403


def test_a_websocket_of_our_own_page_with_the_cookie_opens(shared: Served) -> None:
    access = shared.app.state.access
    headers = {"Cookie": f"{access.cookie_name}={access.cookie}", **own_origin(shared)}
    assert answer(shared, "WEBSOCKET", "/viewer", headers) == 101


def test_the_token_lets_clients_in_by_header(shared: Served) -> None:
    assert answer(shared, "GET", "/api/runs", {"Authorization": f"Bearer {TOKEN}"}) == 200


def test_every_answer_carries_the_protective_headers(shared: Served) -> None:
    for path, headers in (("/", {}), ("/api/runs", {}), ("/healthz", {}), ("/healthz", {"Host": "evil.example"})):
        got = PLAIN.get(f"http://127.0.0.1:{shared.port}{path}", headers=headers).headers
        assert got["x-content-type-options"] == "nosniff"
        assert got["referrer-policy"] == "no-referrer"
        assert got["cross-origin-opener-policy"] == "same-origin"
        assert "frame-ancestors 'self'" in got["content-security-policy"]


def test_the_link_becomes_a_cookie_that_scripts_and_other_sites_never_see(shared: Served) -> None:
    with httpx.Client(base_url=f"http://127.0.0.1:{shared.port}") as browser:
        entered = browser.get("/", params={"token": TOKEN})
        assert (entered.status_code, entered.headers["location"]) == (303, "./")
        cookie = entered.headers["set-cookie"].lower()
        assert "httponly" in cookie
        assert "samesite=strict" in cookie
        assert TOKEN not in cookie
        assert browser.get("/").status_code == 200
        assert browser.get("/api/runs").status_code == 200


def test_a_link_with_a_token_leads_to_the_page_that_it_names(shared: Served) -> None:
    with httpx.Client(base_url=f"http://127.0.0.1:{shared.port}") as browser:
        entered = browser.get("/study", params={"token": TOKEN})
        assert (entered.status_code, entered.headers["location"]) == (303, "./study")
        place = {"run": '"><b>&x', "iteration": "7"}
        presented = browser.get("/", params={"token": TOKEN, "present": "//evil.example", "next": "//evil", **place})
        there = "?run=%22%3E%3Cb%3E%26x&iteration=7"
        assert (presented.status_code, presented.headers["location"]) == (303, f"./{there}&present=1")
        assert browser.get("/", params={"token": TOKEN, "iteration": "//evil"}).headers["location"] == "./"
        assert browser.get("/study").status_code == 200
    elsewhere = {"Sec-Fetch-Site": "cross-site"}
    assert "url=./study" in PLAIN.get(f"http://127.0.0.1:{shared.port}/study", headers=elsewhere).text
    asked = PLAIN.get(f"http://127.0.0.1:{shared.port}/", params=place, headers=elsewhere).text
    assert f'url=./{there.replace("&", "&amp;")}"' in asked
    assert '<input type="hidden" name="run" value="&quot;&gt;&lt;b&gt;&amp;x">' in asked
    assert "<b>" not in asked


@pytest.mark.parametrize("page", ["/", "/study"])
def test_the_page_without_a_token_asks_for_it_in_words(shared: Served, page: str) -> None:
    refused = PLAIN.get(f"http://127.0.0.1:{shared.port}{page}", params={"token": "<script>alert(1)</script>"})
    assert refused.status_code == 401
    assert "paste its token" in refused.text
    assert "alert(1)" not in refused.text
    assert "color-scheme:light dark" in refused.text
    assert 'name="viewport"' in refused.text


def test_a_browser_from_another_site_is_told_to_reload_once(shared: Served) -> None:
    there = PLAIN.get(f"http://127.0.0.1:{shared.port}/", headers={"Sec-Fetch-Site": "cross-site"})
    here = PLAIN.get(f"http://127.0.0.1:{shared.port}/", headers={"Sec-Fetch-Site": "same-origin"})
    assert "refresh" in there.text
    assert "refresh" not in here.text


def test_without_a_given_token_a_link_works_once(tmp_path: Path) -> None:
    access = Access(Settings(port=0, token=None, state=tmp_path))
    used = []
    access.on_ticket_used = lambda: used.append(access.ticket)
    first = access.ticket
    assert not access.redeem("wrong")
    assert access.redeem(first)
    assert not access.redeem(first)
    assert used == [access.ticket] != [first]
    assert access.redeem(access.ticket)


def test_without_a_given_token_no_header_opens(tmp_path: Path) -> None:
    access = Access(Settings(port=0, token=None, state=tmp_path))
    for bearer in ("", "None", access.ticket):
        assert not access.knows(Headers({"Authorization": f"Bearer {bearer}"}))


def test_a_cookie_outlives_a_restart_of_the_server(tmp_path: Path) -> None:
    settings = Settings(port=0, token=None, state=tmp_path / "new")
    assert Access(settings).cookie == Access(settings).cookie
    assert stat.S_IMODE((tmp_path / "new" / "cookie-key").stat().st_mode) == 0o600


def test_a_key_that_others_may_read_is_not_used(tmp_path: Path) -> None:
    kept = kept_key(tmp_path)
    assert kept_key(tmp_path) == kept
    (tmp_path / "cookie-key").chmod(0o644)
    assert kept_key(tmp_path) != kept


def test_another_token_makes_another_cookie(tmp_path: Path) -> None:
    one, other = (Access(Settings(port=0, token=token, state=tmp_path)) for token in ("one", "other"))
    assert one.cookie != other.cookie


def test_head_is_answered_as_get_without_a_body_and_allow_names_every_method(shared: Served) -> None:
    known, methods = {"Authorization": f"Bearer {TOKEN}"}, dict[str, set[str]]()
    for method, path in addresses(shared.app):
        methods.setdefault(path, set()).add(method)
    for path, own in methods.items():
        if own == {"WEBSOCKET"}:
            continue
        url, allowed = f"http://127.0.0.1:{shared.port}{path}", own | ({"HEAD"} if "GET" in own else set[str]())
        if "GET" in own and path != "/api/tasks":  # which takes a second
            head, whole = PLAIN.head(url, headers=known), PLAIN.get(url, headers=known)
            assert (head.status_code, head.content) == (whole.status_code, b""), path
            assert head.headers["content-type"] == whole.headers["content-type"], path
        refused = PLAIN.request("PROPFIND", url, headers=known)
        assert refused.status_code == 405
        assert set(refused.headers["allow"].split(", ")) == allowed - {"WEBSOCKET"}, path


def test_the_head_of_an_answer_without_end_has_an_end() -> None:
    async def endless(_: Scope, __: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        while True:
            await send({"type": "http.response.body", "body": b"more", "more_body": True})
            await anyio.sleep(0)

    sent: list[Message] = []

    async def send(message: Message) -> None:
        sent.append(message)

    async def receive() -> Message:
        return {"type": "http.request"}

    anyio.run(Negotiated(endless), {"type": "http", "method": "HEAD", "headers": []}, receive, send)
    assert [message.get("body") for message in sent] == [None, b""]


@pytest.mark.parametrize(
    ("accepted", "packed"),
    [
        ("gzip", True), ("GZIP", True), ("x-gzip", True), ("*", True), ("br, gzip;q=0.001", True),
        ("*;q=0, gzip", True),
        ("gzip;q=0", False), ("gzip; Q=0.000, *", False), ("*;q=0", False), ("identity", False), ("", False),
        ("gzipped", False), ("not-gzip", False), ("gzip;q=much", False), ("gzip;q=-1", False), (",;=,", False),
    ],
)  # fmt: skip
def test_an_answer_is_packed_only_for_who_takes_that(shared: Served, accepted: str, packed: bool) -> None:
    assert takes_gzip(accepted) is packed
    answer = PLAIN.get(
        f"http://127.0.0.1:{shared.port}/page/studio.css",
        headers={"Authorization": f"Bearer {TOKEN}", "Accept-Encoding": accepted},
    )
    assert ("content-encoding" in answer.headers) is packed
    assert answer.headers["vary"] == "Accept-Encoding"
