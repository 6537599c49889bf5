"""What a client can use of an answer: packed or not, its header alone, nothing it has; and which methods it may."""

import re
from collections.abc import Iterable

import anyio
from starlette.datastructures import MutableHeaders
from starlette.routing import BaseRoute, Match, Mount
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_METHODS = ("GET", "PUT", "POST", "PATCH", "DELETE")
"""Methods that routes of the studio have; HEAD goes with GET."""
_QUALITY = re.compile(r"(0(\.[0-9]{0,3})?|1(\.0{0,3})?)")
"""Pattern of a weight in an Accept-Encoding header (RFC 9110, 12.4.2)."""
_TAG = re.compile(r'(?:W/)?("[^"]*")|(\*)')
"""Pattern of an entry of an If-None-Match header; a tag may hold commas."""


class Negotiated:
    """ASGI middleware that answers HEAD as GET without a body, and tells what is inside whether gzip is taken.

    What is inside looks for the word gzip alone, and would find it where it is refused, as in "gzip;q=0".
    """

    def __init__(self, app: ASGIApp) -> None:
        """Take the application whose answers are compressed where Accept-Encoding is exactly gzip."""
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = MutableHeaders(raw=list(scope["headers"]))
        given = headers.getlist("accept-encoding")
        del headers["accept-encoding"]
        headers["accept-encoding"] = "gzip" if takes_gzip(",".join(given)) else "identity"
        inner = {**scope, "headers": headers.raw}
        if scope["method"] == "HEAD":
            await self._answer_head({**inner, "method": "GET"}, receive, send)
        else:
            await self.app(inner, receive, send)

    async def _answer_head(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the header of what GET would be answered with; its body is given up, however long it would be."""
        with anyio.CancelScope() as work:

            async def send_header(message: Message) -> None:
                if message["type"] == "http.response.start":
                    await send(message)
                    await send({"type": "http.response.body", "body": b"", "more_body": False})
                    work.cancel()

            await self.app(scope, receive, send_header)


def takes_gzip(accepted: str) -> bool:
    """Tell whether an Accept-Encoding header takes gzip: by its name or by "*", with a weight above nought."""
    weights = dict[str, float]()
    for entry in accepted.lower().split(","):
        coding, *parameters = (part.strip() for part in entry.split(";"))
        weight = next((p.removeprefix("q=").strip() for p in parameters if p.startswith("q=")), "1")
        weights[coding] = float(weight) if _QUALITY.fullmatch(weight) else 0.0
    named = max((weights[name] for name in ("gzip", "x-gzip") if name in weights), default=None)
    return (weights.get("*", 0.0) if named is None else named) > 0


def is_known(version: str, known: Iterable[str]) -> bool:
    """Tell whether one of several If-None-Match headers names an ETag, or any; weak tags count as they are compared."""
    tags = {quoted or star for header in known for quoted, star in _TAG.findall(header)}
    return bool(tags & {version, "*"})


def allowed_methods(routes: Iterable[BaseRoute], scope: Scope) -> str:
    """Return the methods that a path takes, as the header Allow has them; a folder of files is only read."""
    whole = {**scope, "root_path": scope.get("app_root_path", scope.get("root_path", ""))}  # a mount has added its own

    def takes(route: BaseRoute, method: str) -> bool:
        read_only = isinstance(route, Mount) and method != "GET"
        return not read_only and route.matches({**whole, "method": method})[0] is Match.FULL

    found = [method for method in _METHODS if any(takes(route, method) for route in routes)]
    return ", ".join(["HEAD", *found] if "GET" in found else found)
