"""Whether a request is a person's visit: what previews a link, or fetches it ahead, must not use it up."""

import re

from starlette.datastructures import Headers

_AHEAD = ("purpose", "sec-purpose", "x-purpose", "x-moz")
"""Headers in which browsers and proxies say that nobody has asked for the page yet."""
_LOOKS_AHEAD = re.compile(
    r"bot|crawl|spider|preview|external(hit|agent)|whatsapp|viber|skype|slack|discord|telegram|embedly|iframely"
    r"|vkshare|pagerenderer|ms-office|microsoft office|unfurl|scanner|safelinks|validator",
    re.IGNORECASE,
)
"""Pattern of the names under which chats, mail and search engines fetch a link before a person opens it."""


def is_visit(method: str, headers: Headers) -> bool:
    """Tell whether somebody opens the page, so that a link that works once may be used up for it."""
    if method != "GET" or any(re.search("prefetch|preview|prerender", headers.get(name, ""), re.I) for name in _AHEAD):
        return False
    if headers.get("sec-fetch-user") == "?1":  # only a browser in which a person has acted says so
        return True
    if _LOOKS_AHEAD.search(headers.get("user-agent", "")):
        return False
    return headers.get("sec-fetch-mode", "navigate") == "navigate"
