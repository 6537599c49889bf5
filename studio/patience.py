"""How long the server waits for a stranger, for how many, and how much of one it reads: an end to each."""

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Any

from studio.seldom import Seldom

if TYPE_CHECKING:
    from uvicorn.protocols.http.h11_impl import H11Protocol as HttpProtocol
else:
    from uvicorn.protocols.http.auto import AutoHTTPProtocol as HttpProtocol

SECONDS = 15.0
"""Seconds between two looks at a connection: one that waits for the same at both is closed, so that a request has 15 to
30 seconds for its header, as many for its body, and as many in which nothing of an answer is taken."""
MOST_WAITING = 128
"""Largest number of connections without a request in progress; one more takes the place of the oldest of them."""
LONGEST_HEADER = 64 << 10
"""Bytes of the longest header of a request that is read, its first line included; browsers send a few thousand."""
LONGEST_REQUEST = 8 << 20
"""Bytes that are read of the longest body, with whatever is sent between its pieces: of most bodies 1 MiB is taken."""
_unreadable = Seldom(logging.getLogger(__name__))
_TOO_LONG = b"HTTP/1.1 431 Request Header Fields Too Large\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


class PatientProtocol(HttpProtocol):
    """A connection that is closed where its request does not come, and gives way to others meanwhile."""

    _look_again: asyncio.TimerHandle | None = None
    _seen: object = None
    _at: object = (None, False)
    """The request that was read last, and whether more of its body is to come."""
    _is_handed_over = False
    """Whether it is that of a websocket by now."""
    _read = 0
    """Bytes that have come since that has changed."""
    since = 0.0
    """Time at which the connection was made, in seconds of the monotonic clock."""

    def connection_made(self, transport: Any) -> None:
        """Begin to wait for a request; the one that has waited longest gives way where too many do."""
        super().connection_made(transport)
        self.since = time.monotonic()
        self._look_again = self.loop.call_later(SECONDS, self._look)
        idle = [other for other in self.connections if isinstance(other, PatientProtocol) and other.is_idle]
        if len(idle) > MOST_WAITING:
            min(idle, key=lambda other: other.since).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Take in what has come; a header or a request that is longer than any of ours ends the connection."""
        super().data_received(data)
        if self._is_handed_over:
            return
        at = self.cycle, self.cycle is not None and self.cycle.more_body
        self._read, self._at = (self._read + len(data) if at == self._at else 0), at
        most = LONGEST_HEADER if self.is_idle and not at[1] else LONGEST_REQUEST
        if self._read > most and not self.transport.is_closing():
            self.transport.write(_TOO_LONG)
            self.transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
        self._cancel()
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, *request: Any) -> None:
        """Hand the connection over: its request has come; it ends where the header is one that nobody can read."""
        self._cancel()
        self._is_handed_over = True
        try:
            super().handle_websocket_upgrade(*request)
        except Exception:  # the library that reads the header raises whatever a stranger's comes to
            _unreadable.warn("closed a connection: the header of its websocket can't be read")
            # Of the protocol that was to take over nobody else knows: left there, it fails the end of the server.
            taking_over = [other for other in self.connections if getattr(other, "transport", None) is self.transport]
            self.connections.difference_update(taking_over)
            self.transport.abort()

    @property
    def is_idle(self) -> bool:
        """Tell whether no request is in progress."""
        return self.cycle is None or self.cycle.response_complete

    def _look(self) -> None:
        waits_for = self._waits_for()
        if waits_for is not None and waits_for == self._seen:
            self.transport.abort()
            return
        self._seen = waits_for
        self._look_again = self.loop.call_later(SECONDS, self._look)

    def _waits_for(self) -> object:
        """Return what is waited for: that an answer is taken, a header, or a body, and of which request; None where
        uvicorn itself sees to it."""
        if unsent := self.transport.get_write_buffer_size():
            return "answer", self.cycle, unsent
        if self.timeout_keep_alive_task is not None:
            return None
        if self.is_idle:
            return "header", self.cycle
        return ("body", self.cycle) if self.cycle.more_body else None

    def _cancel(self) -> None:
        if self._look_again is not None:
            self._look_again.cancel()
