"""A copy of what stands in a browser's scene, for others to see: kept from the messages that the browser is sent."""

import threading
import time
from collections.abc import Iterable, Sequence
from typing import Any

import msgspec
import viser
import zstandard
from viser._messages import (
    BackgroundImageMessage,
    EnableLightsMessage,
    EnvironmentMapMessage,
    FogMessage,
    Gui3DMessage,
    RemoveSceneNodeMessage,
    ReplayDoneMessage,
    TransformControlsMessage,
)
from viser.infra import Message
from viser.infra._infra import _append_aligned_buffers

_OF_NO_NODE = (BackgroundImageMessage, EnableLightsMessage, EnvironmentMapMessage, FogMessage)
_TO_TAKE_HOLD_OF = (Gui3DMessage, TransformControlsMessage)
"""Nodes that are there to be pressed and dragged, which only their owner may."""


class SceneCopy:
    """What stands in the scene of one browser: the newest message of each kind about each node, numbered as they came.

    viser offers no way to listen; the version is pinned and tests/studio/test_scene_copy.py holds it to this. The copy
    is thread-safe, and listens for as long as the browser's connection lasts.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        """Listen to all that the browser is sent from now on: nothing may stand in its own scene yet."""
        self._lock = threading.Lock()
        self._count = 0
        self._held: dict[str, tuple[int, Message]] = {}
        connection = client._websock_connection
        self._buffer = connection.get_message_buffer()
        of_all = client._viser_server._websock_server.get_message_buffer()
        for message in list(of_all.message_from_id.values()):
            self._insert_message(message)
        with connection._record_lock:
            connection._record_handles.append(self)  # pyright: ignore[reportArgumentType]

    def taken(self) -> list[tuple[int, Message]] | None:
        """Return all numbered messages, oldest first; None while a frame is being written, of which half is there."""
        with self._lock:
            return None if self._buffer.atomic_counter else list(self._held.values())

    @property
    def count(self) -> int:
        """Return the number of the newest message."""
        return self._count

    def _insert_message(self, message: Message) -> None:
        """Take in a message; viser calls this of whoever records."""
        if not _is_seen(message):
            return
        with self._lock:
            self._count += 1
            if message.lifecycle_phase in ("create", "remove"):  # what was said of an earlier node of that name
                name = getattr(message, "name", None)
                for key in [key for key, (_, held) in self._held.items() if getattr(held, "name", None) == name]:
                    del self._held[key]
            key = message.redundancy_key()
            self._held.pop(key, None)
            self._held[key] = self._count, message


def _is_seen(message: Message) -> bool:
    """Tell whether a message is about what is seen, and not about panels, the camera, or what can be pressed."""
    if isinstance(message, _TO_TAKE_HOLD_OF):
        return False
    return message.entity_type == "scene" or isinstance(message, _OF_NO_NODE)


def removal_of(messages: Iterable[tuple[int, Message]]) -> list[Message]:
    """Return the messages that take away every node that these ones make."""
    found: list[Message] = []
    for _, message in messages:
        if message.entity_type == "scene" and message.lifecycle_phase == "create":
            removal = RemoveSceneNodeMessage(getattr(message, "name"))  # noqa: B009 - known of scene messages alone
            removal.owner = getattr(message, "owner", "")
            found.append(removal)
    return found


def frame_of(messages: Sequence[Message], *, first: bool = False) -> bytes:
    """Return messages as viser's client takes them in, all at once; the first frame ends what it waits for."""
    arrays: list[memoryview] = []
    told: list[dict[str, Any]] = [m.as_serializable_dict(arrays) for m in messages]
    if first:
        told.append(ReplayDoneMessage().as_serializable_dict(arrays))
    sizes = tuple(array.nbytes for array in arrays)
    inner = msgspec.msgpack.encode(
        {"messages": told, "timestampSec": time.perf_counter(), "binaryBufferLengths": sizes}
    )
    packed = zstandard.compress(inner, 1)
    parts: list[bytes | memoryview] = [len(inner).to_bytes(8, "little"), len(packed).to_bytes(8, "little"), packed]
    _append_aligned_buffers(parts, arrays, 16 + len(packed))
    return b"".join(parts)
