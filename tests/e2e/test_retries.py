"""A browser that waits for its connection opens no second one, however long the first takes."""

import asyncio
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn
from playwright.sync_api import Page
from served import wait_for
from starlette.websockets import WebSocket

from studio import bridge
from studio.app import create_app
from studio.bridge import GuardedViser
from studio.settings import Settings

TOKEN = "a-token-of-the-tests"
LONG = 3.0
"""Seconds that a connection takes: the client tries again each second."""


@pytest.fixture
def busy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, list[float]]]:
    """Serve the studio, slow to open connections; give its port and when connections were asked for."""
    asked: list[float] = []
    relay = bridge.relay

    async def slow(browser: WebSocket, guarded: GuardedViser, address: str) -> None:
        asked.append(asyncio.get_running_loop().time())
        await asyncio.sleep(LONG)
        await relay(browser, guarded, address)

    monkeypatch.setattr(bridge, "relay", slow)
    listener = socket.create_server(("127.0.0.1", 0))
    app = create_app(Settings(port=0, runs=tmp_path / "runs", token=TOKEN, hosts=(), state=tmp_path / "state"))
    server = uvicorn.Server(uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    wait_for("the server", lambda: server.started, 30)
    yield listener.getsockname()[1], asked
    server.should_exit = True
    thread.join(10)


@pytest.mark.browser
def test_a_connection_that_is_on_its_way_is_waited_for(busy: tuple[int, list[float]], page: Page) -> None:
    port, asked = busy
    page.context.set_extra_http_headers({"Authorization": f"Bearer {TOKEN}"})
    page.goto(f"http://127.0.0.1:{port}/viewer/")
    wait_for("the first try", lambda: page.wait_for_timeout(50) or asked, 30)
    page.evaluate("dispatchEvent(new Event('focus'))")
    page.get_by_role("button", name="Start", exact=True).wait_for()
    assert len(asked) == 1
