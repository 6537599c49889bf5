"""Whom the server lets in, on every route and websocket: the name it is called by, the page that asks, the token."""

import base64
import collections
import contextlib
import hashlib
import hmac
import html
import logging
import os
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Literal
from urllib.parse import parse_qs, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from studio.credentials import cookie_of, same
from studio.invitation import AUDIENCE, Invitation, may_ask
from studio.seldom import Seldom
from studio.settings import Settings
from studio.visits import is_visit

_log = logging.getLogger(__name__)
OPEN_PATHS = frozenset({"/healthz"})
"""Paths that need no token. Host and Origin are checked for them too."""
PAGES = ("/", "/runs", "/study", "/docs")
"""Pages for people: a browser that is not known yet is asked there for the token, and a link with one leads there."""

PAGE_CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "frame-src 'self'; frame-ancestors 'self'; base-uri 'none'; form-action 'self'"
)
MOST_GUESSES, MOST_GUESSES_OF_ALL, GUESSED_WITHIN = 20, 200, 60.0
"""Wrong tokens of one address, and of all together, in so many seconds, after which none is looked at. Who has the
cookie is let in all the same."""
_ONLY_LOOKS = "a spectator may only look: this belongs to whoever has the studio's token"
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": PAGE_CSP,
    "Cache-Control": "no-store",
}


class Guesses:
    """Wrong tokens of the last minute, by the address that they came from."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._wrong: collections.deque[tuple[float, str]] = collections.deque()

    def note(self, address: str) -> None:
        """Remember a wrong token."""
        with self._lock:
            self._wrong.append((self._clock(), address))

    def are_too_many(self, address: str) -> bool:
        """Tell whether no further token of this address is looked at for now."""
        with self._lock:
            while self._wrong and self._clock() - self._wrong[0][0] >= GUESSED_WITHIN:
                self._wrong.popleft()
            own = sum(other == address for _, other in self._wrong)
            return own >= MOST_GUESSES or len(self._wrong) >= MOST_GUESSES_OF_ALL


class Access:
    """The token, the cookie that stands for it, and the one-time ticket of the printed link."""

    def __init__(self, settings: Settings) -> None:
        self.hosts = _allowed_names(settings)
        # Cookies don't tell ports apart: two servers on one machine need two names.
        self.cookie_name = f"morph_studio_{settings.port}"
        self._token = settings.token
        self._ticket = settings.token or secrets.token_urlsafe(24)
        key = settings.token.encode() if settings.token else kept_key(settings.state)
        self._cookie = hmac.new(key, b"morph-studio cookie", hashlib.sha256).hexdigest()
        self._lock = threading.Lock()
        self.guesses = Guesses()
        self.invitation = Invitation(f"morph_audience_{settings.port}")
        self.refused_sockets = Seldom(_log)
        """Warning about websockets that were refused."""
        self.on_ticket_used: Callable[[], None] = lambda: None
        """Function to call after the one-time ticket was used; `ticket` is a new one by then."""

    @property
    def ticket(self) -> str:
        """Return the token that the link `/?token=...` carries: the given one, or one that works once."""
        return self._ticket

    @property
    def cookie(self) -> str:
        """Return the value of the cookie; the token can't be worked out from it."""
        return self._cookie

    def redeem(self, ticket: str) -> bool:
        """Tell whether `ticket` lets a browser in; a one-time ticket is void afterwards."""
        with self._lock:
            if not same(ticket, self._ticket):
                return False
            if self._token is not None:
                return True
            self._ticket = secrets.token_urlsafe(24)
        self.on_ticket_used()
        return True

    def has_cookie(self, headers: Headers) -> bool:
        """Tell whether the request carries the cookie."""
        return same(cookie_of(headers, self.cookie_name), self._cookie)

    def knows(self, headers: Headers, address: str = "") -> bool:
        """Tell whether the request carries the cookie, or the token where one was given; a wrong token is noted."""
        if self.has_cookie(headers):
            return True
        bearer = _bearer(headers)
        if bearer is None:
            return False
        if self._token is not None and same(bearer, self._token):
            return True
        self.guesses.note(address)
        return False

    def is_slowed(self, headers: Headers, ticket: str, address: str) -> bool:
        """Tell whether the request brings a token, or a link, that is not looked at: too many from there were wrong."""
        brings_token = bool(ticket) or _bearer(headers) is not None
        return brings_token and not self.has_cookie(headers) and self.guesses.are_too_many(address)

    def may_watch(self, headers: Headers) -> bool:
        """Tell whether whoever asks may see what the audience sees: a spectator, or who has the token."""
        return self.invitation.has_cookie(headers) or self.knows(headers)

    def refusal(self, headers: Headers) -> str | None:
        """Return why Host or Origin are wrong, or None. Whether Origin may be missing is left to the caller."""
        hosts = headers.getlist("host")
        if len(hosts) != 1 or _name_of(hosts[0]) not in self.hosts:
            return "wrong Host: call this server by the name in its link (more names: MORPH_HOSTS)"
        origins = headers.getlist("origin")
        if origins and (len(origins) != 1 or not _same_origin(origins[0], hosts[0])):
            return "wrong Origin: only this server's own pages may ask"
        return None


class Guard:
    """ASGI middleware around the whole application: each route and websocket is guarded, new ones included."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app = app
        self.access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            await self._http(scope, receive, send)
        elif scope["type"] == "websocket":
            await self._websocket(scope, receive, send)
        else:
            await self.app(scope, receive, send)

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        response = self._answer(scope)
        await (response or self.app)(scope, receive, send_with_headers)

    def _answer(self, scope: Scope) -> Response | None:
        """Return the refusal, the cookie for a good link, or None where the request may pass."""
        headers, path = Headers(scope=scope), scope["path"].removeprefix(scope.get("root_path", ""))
        why = self.access.refusal(headers)
        if why:
            return JSONResponse({"detail": why}, 403)
        if path in OPEN_PATHS:
            return None
        address = _address_of(scope)
        query, invitation = parse_qs(scope["query_string"].decode("latin-1")), self.access.invitation
        ticket = query.get("token", [""])[0] if path in PAGES else ""
        link = query.get("link", [""])[0] if path == AUDIENCE and not invitation.has_cookie(headers) else ""
        if self.access.is_slowed(headers, ticket or link, address):
            return JSONResponse(
                {"detail": "too many wrong tokens: wait a minute"}, 429, {"Retry-After": str(int(GUESSED_WITHIN))}
            )
        known = self.access.knows(headers, address)
        if path in PAGES and scope["method"] in ("GET", "HEAD"):
            visit = is_visit(scope["method"], headers)
            if ticket and (known or (visit and self.access.redeem(ticket))):
                return self._enter(scope, path, self.access.cookie_name, self.access.cookie, "strict")
            if not known:
                if ticket and visit:
                    self.access.guesses.note(address)
                from_elsewhere = headers.get("sec-fetch-site") == "cross-site"
                return _login_page(path, _place(scope), bool(ticket) and visit, from_elsewhere)
        if known:
            return None
        if path == AUDIENCE or invitation.has_cookie(headers):
            return self._look(scope, headers, path, link)
        return JSONResponse(
            {"detail": "no token: open the link that the server printed, or send Authorization: Bearer TOKEN"},
            401,
            {"WWW-Authenticate": "Bearer"},
        )

    def _look(self, scope: Scope, headers: Headers, path: str, link: str) -> Response | None:
        """Return the answer to a spectator, or to who becomes one by a link; None where the request may pass."""
        invitation = self.access.invitation
        if invitation.has_cookie(headers):
            return None if may_ask(scope["method"], path) else JSONResponse({"detail": _ONLY_LOOKS}, 403)
        if link and is_visit(scope["method"], headers):
            if invitation.admits(link):
                return self._enter(scope, path, invitation.cookie_name, invitation.cookie, "lax")
            self.access.guesses.note(_address_of(scope))
        return _uninvited_page()

    def _enter(
        self, scope: Scope, path: str, cookie_name: str, cookie: str, samesite: Literal["lax", "strict"]
    ) -> Response:
        """Return the cookie and the way to the page, relative: proxies cut off a prefix, or put one before it.

        Of a link's other words only those are kept that say what is to be seen.
        """
        words = urlencode(_place(scope))
        response = RedirectResponse(f".{path}{words and f'?{words}'}", 303)
        response.set_cookie(cookie_name, cookie, httponly=True, samesite=samesite, secure=scope["scheme"] == "https")
        return response

    async def _websocket(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        status, address = 0, _address_of(scope)
        if self.access.refusal(headers) or "origin" not in headers:
            status = 403
        elif self.access.is_slowed(headers, "", address):
            status = 429
        elif not self.access.knows(headers, address):
            path, invitation = scope["path"].removeprefix(scope.get("root_path", "")), self.access.invitation
            if not invitation.has_cookie(headers):
                status = 401
            elif not may_ask("WEBSOCKET", path):
                status = 403
        if not status:
            await self.app(scope, receive, send)
            return
        self.access.refused_sockets.warn(f"refused a websocket of {address or 'a stranger'}")
        await receive()  # websocket.connect
        if "websocket.http.response" in scope.get("extensions", {}):
            await send({"type": "websocket.http.response.start", "status": status, "headers": []})
            await send({"type": "websocket.http.response.body", "body": b""})
        else:
            await send({"type": "websocket.close", "code": 4000 + status})


def kept_key(folder: Path) -> bytes:
    """Return the key of this user's cookies, made on first use; where it can't be kept, one for this start only."""
    path, fresh = folder / "cookie-key", secrets.token_bytes(32)
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with contextlib.suppress(FileExistsError), open(path, "xb", opener=_private) as file:
            file.write(fresh)
        with path.open("rb") as file:
            status, key = os.fstat(file.fileno()), file.read(64)
    except OSError:
        return fresh
    private = status.st_uid == os.getuid() and not status.st_mode & 0o077
    return key if private and len(key) == len(fresh) else fresh


def _bearer(headers: Headers) -> str | None:
    """Return the token of an Authorization header, or None where there is no such header."""
    scheme, _, bearer = headers.get("authorization", "").partition(" ")
    return bearer.strip() if scheme.lower() == "bearer" else None


def _address_of(scope: Scope) -> str:
    client = scope.get("client")
    return client[0] if client else ""


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def _allowed_names(settings: Settings) -> frozenset[str]:
    names: Iterable[str] = ("localhost", "127.0.0.1", "::1", settings.host, *settings.hosts)
    unspecified = {"0.0.0.0", "::", ""}  # where a server listens, never what it is called
    return frozenset(name.lower().strip("[]") for name in names) - unspecified


def _name_of(host: str) -> str | None:
    """Return the name in a Host header without its port, or None if it is malformed."""
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port  # raises on what is no port
    except ValueError:
        return None
    if parts.netloc != host or parts.username is not None or not parts.hostname:
        return None
    return parts.hostname.lower()


def _same_origin(origin: str, host: str) -> bool:
    scheme, _, netloc = origin.partition("://")
    return scheme in ("http", "https") and netloc.lower() == host.lower()


_LOGIN_STYLE = (
    ":root{color-scheme:light dark}"
    "body{font:16px/1.5 system-ui,sans-serif;max-width:34rem;margin:18vh auto;padding:0 1.5rem;"
    "color:light-dark(#1c2733,#e9e9e9);background:light-dark(#fff,#242424)}"
    "h1{font-size:1.35rem;font-weight:650}"
    "input,button{font:inherit;padding:.5em .8em;border-radius:.5em;border:1px solid light-dark(#8a94a0,#7b8288)}"
    "button{color:#fff;background:#2467ad;border-color:#2467ad;cursor:pointer}"
    "input{width:16rem;max-width:60%}code{font-size:.95em}"
)


def _uninvited_page() -> Response:
    """Return the page for a browser that asks for the page of spectators without a link that is good."""
    return _plain_page(
        "",
        "<p>This link does not let anybody in: it was ended by the presenter, it belongs to an earlier start of the "
        "studio, or a part of it is missing.</p><p>Ask the presenter for a new one.</p>",
    )


def _place(scope: Scope) -> dict[str, str]:
    """Return the words of a link that say what is to be seen: which run, which iteration, whether it is presented."""
    words = parse_qs(scope["query_string"].decode("latin-1"), keep_blank_values=True)
    run, iteration = (words.get(name, [""])[0] for name in ("run", "iteration"))
    place = {"run": run} if run else {}
    place |= {"iteration": iteration} if iteration.isdecimal() else {}
    return place | ({"present": "1"} if "present" in words else {})


def _login_page(path: str, place: Mapping[str, str], tried: bool, from_elsewhere: bool) -> Response:
    """Return the page for a browser without a cookie that asks for one of the pages, at a place in it.

    A link followed from another site arrives without its SameSite=Strict cookie, even right after it was set: one
    reload from this page itself brings it along.
    """
    there = html.escape(path + (f"?{urlencode(place)}" if place else ""))
    again = f'<meta http-equiv="refresh" content="0;url=.{there}">' if from_elsewhere else ""
    kept = "".join(f'<input type="hidden" name="{name}" value="{html.escape(word)}">' for name, word in place.items())
    reason = (
        "That token does not fit, or its link was used already (each link works once; the newest is in the terminal)."
        if tried
        else "This studio is open to its owner only."
    )
    return _plain_page(
        again,
        f"<p>{html.escape(reason)} Open the link that <code>morph-studio serve</code> printed, or paste its token:</p>"
        f'<form method="get">{kept}<input name="token" type="password" autocomplete="off" aria-label="Token" autofocus '
        "required> <button>Enter</button></form>",
    )


def _plain_page(head: str, body: str) -> Response:
    """Return a page for somebody who is not let in; head and body are HTML."""
    digest = style_digest(_LOGIN_STYLE)
    return HTMLResponse(
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>MORPH Studio</title>{head}'
        f"<style>{_LOGIN_STYLE}</style></head><body><main><h1>MORPH Studio</h1>{body}</main></body></html>",
        401,
        {"Content-Security-Policy": PAGE_CSP.replace("style-src 'self'", f"style-src '{digest}'")},
    )


def style_digest(style: str) -> str:
    """Return a style sheet as a Content-Security-Policy names it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
