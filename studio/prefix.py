"""The path under which a proxy serves the studio, such as /user/me/proxy/8000: told by a setting or by the proxy."""

import re
from typing import cast
from urllib.parse import unquote

from starlette.datastructures import Headers
from starlette.responses import RedirectResponse
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

_LONGEST = 512
_PREFIX = re.compile(r"(/([A-Za-z0-9._~!$&'()*+,;=:@-]|%[0-9A-Fa-f]{2})+)*")


def check_prefix(prefix: str) -> str:
    """Return a path prefix without its last slash, empty for none; ValueError says what is allowed."""
    bare = prefix.strip().rstrip("/")
    decoded = unquote(bare)
    odd = not decoded.isprintable() or any(part in (".", "..") for part in decoded.split("/")) or "\\" in decoded
    if len(bare) > _LONGEST or "%2f" in bare.lower() or odd or not _PREFIX.fullmatch(bare):
        raise ValueError(f'a path prefix is a path such as /studio or /user/me/proxy/8000, not "{prefix[:80]}"')
    return bare


class Prefixed:
    """ASGI middleware that tells an application its prefix, by `root_path`, and the address of whoever asks.

    A request may come with the prefix of the setting, or from a proxy that has cut it off. X-Forwarded-Prefix, which
    names what was cut off, X-Forwarded-Proto and X-Forwarded-For are believed from trusted proxies alone.
    """

    def __init__(self, app: ASGIApp, root_path: str, trusted: str) -> None:
        """Take the prefix of all requests, empty for none, and the addresses of trusted proxies between commas."""
        self.root_path = root_path
        forwarded = ProxyHeadersMiddleware(app, trusted)  # pyright: ignore[reportArgumentType] - two words for ASGI
        self._app = cast(ASGIApp, forwarded)
        self._trusted = forwarded.trusted_hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        path, own = scope["path"], unquote(self.root_path)
        if own and path == own and scope["type"] == "http":
            await RedirectResponse(f"{self.root_path}/")(scope, receive, send)
            return
        if not own or not path.startswith(f"{own}/"):  # else the proxy has left it there
            own = own or self._told(scope)
            path = own + path
        await self._app({**scope, "root_path": own, "path": path}, receive, send)

    def _told(self, scope: Scope) -> str:
        """Return the prefix that a trusted proxy tells, empty where there is none."""
        client, given = scope.get("client"), Headers(scope=scope).getlist("x-forwarded-prefix")
        if len(given) != 1 or not client or client[0] not in self._trusted:
            return ""
        try:
            return unquote(check_prefix(given[0]))
        except ValueError:
            return ""
