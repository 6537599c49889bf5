"""A small reverse proxy in front of a server: it cuts a prefix off, as jupyter-server-proxy does, and counts bytes."""

import asyncio
import contextlib
import threading
from collections.abc import Iterator


class Proxy:
    """A proxy of one server on this machine, under a path prefix; it hands on one request for each connection."""

    def __init__(self, server_port: int, prefix: str = "", says_so: bool = True) -> None:
        self.port = 0
        self.counted = 0
        """Number of bytes that went through, both ways."""
        self._server_port = server_port
        self._prefix = prefix.encode()
        self._says_so = says_so
        self._at_work: dict[asyncio.Task[None], asyncio.StreamWriter] = {}
        self._ended = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None

    @contextlib.contextmanager
    def running(self) -> Iterator["Proxy"]:
        """Proxy in a thread of its own for as long as the context lasts."""
        started = threading.Event()
        thread = threading.Thread(target=lambda: asyncio.run(self._listen(started)), daemon=True)
        thread.start()
        assert started.wait(30)
        assert self._loop is not None
        try:
            yield self
        finally:
            self._loop.call_soon_threadsafe(self._ended.set)
            thread.join(10)

    async def _listen(self, started: threading.Event) -> None:
        """Serve until the end is wished for, and hang up on who is still connected."""
        self._loop = asyncio.get_running_loop()
        server = await asyncio.start_server(self._begin, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        started.set()
        await self._ended.wait()
        server.close()
        for answers in self._at_work.values():
            answers.transport.abort()
        await asyncio.gather(*self._at_work)

    def _begin(self, browser: asyncio.StreamReader, answers: asyncio.StreamWriter) -> None:
        serving = asyncio.create_task(self._serve(browser, answers))
        self._at_work[serving] = answers
        serving.add_done_callback(self._at_work.pop)

    async def _serve(self, browser: asyncio.StreamReader, answers: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            head = await browser.readuntil(b"\r\n\r\n")
            self.counted += len(head)
            passed_on = self._passed_on(head)
            if passed_on is None:
                answers.write(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
                await answers.drain()
            else:
                server, requests = await asyncio.open_connection("127.0.0.1", self._server_port)
                requests.write(passed_on)
                ways = [(browser, requests), (server, answers)]
                copying = [asyncio.create_task(self._copy(*way)) for way in ways]
                await asyncio.wait(copying, return_when=asyncio.FIRST_COMPLETED)
                requests.close()
                answers.close()
                await asyncio.wait(copying)
        answers.close()

    def _passed_on(self, head: bytes) -> bytes | None:
        """Return a request's head as the server gets it; None where it is for something beside the prefix."""
        first, *lines = head.rstrip().split(b"\r\n")
        method, path, version = first.split(b" ")
        if not path.startswith(self._prefix + b"/"):
            return None
        if b"upgrade: websocket" not in head.lower():
            lines = [line for line in lines if not line.lower().startswith(b"connection:")] + [b"Connection: close"]
        if self._prefix and self._says_so:
            lines.append(b"X-Forwarded-Prefix: " + self._prefix)
        path = path.removeprefix(self._prefix)
        return b"\r\n".join([b" ".join([method, path, version]), *lines]) + b"\r\n\r\n"

    async def _copy(self, source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while content := await source.read(65536):
                self.counted += len(content)
                target.write(content)
                await target.drain()
