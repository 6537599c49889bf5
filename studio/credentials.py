"""What a browser is known by: its cookies, and the key that each of its pages has drawn."""

import hmac
import re

from starlette.datastructures import Headers

KEY = re.compile(r"[A-Za-z0-9_-]{16,64}")
"""Pattern of the key of a page, which the page draws at random."""


def cookie_of(headers: Headers, name: str) -> str:
    """Return the value of the cookie of that name, empty where a request carries none.

    The studio's own cookies are plain words; the library that also undoes quotes takes minutes over a long header.
    """
    pairs = (pair.partition("=") for pair in headers.get("cookie", "").split(";"))
    return next((value.strip() for given, _, value in pairs if given.strip() == name), "")


def same(given: str, secret: str) -> bool:
    """Tell whether what was given is the secret, in a time that does not tell how much of it is right."""
    return hmac.compare_digest(given.encode("utf-8", "replace"), secret.encode())
