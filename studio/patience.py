"""How long the server waits for a stranger's request, and for how many: uvicorn's protocol with an end to both."""

import asyncio
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from uvicorn.protocols.http.h11_impl import H11Protocol as HttpProtocol
else:
    from uvicorn.protocols.http.auto import AutoHTTPProtocol as HttpProtocol

SECONDS = 15.0
"""Seconds between two looks at a connection: one that waits for the same at both is closed, so that a request has 15 to
30 seconds for its header, and as many for its body."""
MOST_WAITING = 128
"""Largest number of connections without a request in progress; one more takes the place of the oldest of them."""


class PatientProtocol(HttpProtocol):
    """A connection that is closed where its request does not come, and gives way to others meanwhile."""

    _look_again: asyncio.TimerHandle | None = None
    _seen: object = None
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

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
        self._cancel()
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, *request: Any) -> None:
        """Hand the connection over: its request has come."""
        self._cancel()
        super().handle_websocket_upgrade(*request)

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
        """Return what is waited for, a header or the body of which request; None where uvicorn itself sees to it."""
        if self.timeout_keep_alive_task is not None:
            return None
        if self.is_idle:
            return "header", self.cycle
        return ("body", self.cycle) if self.cycle.more_body else None

    def _cancel(self) -> None:
        if self._look_again is not None:
            self._look_again.cancel()
