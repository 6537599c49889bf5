"""Numbers, words and arrays as one string of bytes: a header in JSON, and behind it the arrays that it names."""

import json

import numpy as np

_ALIGNED = 8
"""Bytes of which each array begins at a multiple: a browser reads numbers in place there alone."""
_KINDS = {"f4": "<f4", "f8": "<f8", "i4": "<i4", "i2": "<i2", "u1": "u1"}


class Pack:
    """A document that is being put together; `pack.js` reads it."""

    def __init__(self) -> None:
        self._arrays: list[bytes] = []
        self._size = 0

    def array(self, values: np.ndarray, kind: str) -> dict[str, object]:
        """Take in an array and return what stands for it in the document; `kind` is one of f4, f8, i4, i2 and u1."""
        content = _padded(np.ascontiguousarray(values, dtype=_KINDS[kind]).tobytes(), b"\0")
        place = {"at": self._size, "kind": kind, "shape": list(values.shape)}
        self._arrays.append(content)
        self._size += len(content)
        return place

    def content(self, document: object) -> bytes:
        """Return the document, in which nothing but arrays holds what is not finite, with its arrays."""
        header = _padded(json.dumps(document, allow_nan=False).encode(), b" ")
        return b"".join([len(header).to_bytes(_ALIGNED, "little"), header, *self._arrays])


def _padded(content: bytes, by: bytes) -> bytes:
    return content + by * (-len(content) % _ALIGNED)
