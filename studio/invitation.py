"""The link by which spectators come in, and the few things that they may ask the server for."""

import hashlib
import hmac
import re
import secrets

from starlette.datastructures import Headers

from morph_core.run_folder import RUN_ID
from studio.credentials import KEY, cookie_of, same

AUDIENCE = "/audience"
"""The page of spectators; their link leads there."""
ALLOWED = (
    ("GET", re.compile(AUDIENCE)),
    ("GET", re.compile(f"{AUDIENCE}/events")),
    ("PUT", re.compile(f"{AUDIENCE}/seats/{KEY.pattern}")),
    ("GET", re.compile(f"{AUDIENCE}/viewer/{KEY.pattern}/")),
    ("GET", re.compile(f"{AUDIENCE}/runs/{RUN_ID.pattern}/evolution\\.html")),
    ("WEBSOCKET", re.compile(f"{AUDIENCE}/viewer/{KEY.pattern}")),
    ("GET", re.compile(r"/page/(audience\.css|audience\.js|icon\.svg|theme\.js|words\.js|vendor/charts\.js)")),
)
"""All that a spectator may ask for, by method and path: whatever is not among it is refused, new routes too."""


class Invitation:
    """The link of the audience, at most one at a time, and the cookie that stands for it.

    Its cookie is of another kind than that of whoever has the token: each is worth nothing where the other is asked
    for.
    """

    def __init__(self, cookie_name: str) -> None:
        """Invite nobody yet; `cookie_name` is that of spectators' cookies."""
        self.cookie_name = cookie_name
        self._ticket: str | None = None

    @property
    def ticket(self) -> str | None:
        """Return what the link `/audience?link=...` carries, or None while nobody is invited."""
        return self._ticket

    @property
    def cookie(self) -> str:
        """Return the value of a spectator's cookie, empty while nobody is invited. It does not tell the link."""
        if self._ticket is None:
            return ""
        return hmac.new(self._ticket.encode(), b"morph-studio spectator", hashlib.sha256).hexdigest()

    def open(self) -> str:
        """Return the ticket of the link, a new one where there is none."""
        if self._ticket is None:
            self._ticket = secrets.token_urlsafe(24)
        return self._ticket

    def revoke(self) -> None:
        """Void the link and every cookie that was given for it."""
        self._ticket = None

    def admits(self, ticket: str) -> bool:
        """Tell whether a link with this ticket lets somebody in."""
        return self._ticket is not None and same(ticket, self._ticket)

    def has_cookie(self, headers: Headers) -> bool:
        """Tell whether a request comes from a spectator."""
        return self._ticket is not None and same(cookie_of(headers, self.cookie_name), self.cookie)


def may_ask(method: str, path: str) -> bool:
    """Tell whether a spectator may ask for this; the method of a websocket is WEBSOCKET."""
    return any(method == allowed and pattern.fullmatch(path) for allowed, pattern in ALLOWED)
