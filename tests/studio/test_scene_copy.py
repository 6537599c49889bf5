"""What spectators see is what stands in the presenter's scene, however seldom they look."""

import struct
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import zstandard
from conftest import Served, eventually
from hypothesis import given
from hypothesis import strategies as st
from test_bridge import CAMERA, browse, say
from viser import _messages
from viser.infra import Message

from studio.viewer.scene_copy import SceneCopy, frame_of, removal_of


class Buffer(SimpleNamespace):
    """What viser keeps of a connection's messages."""

    def __init__(self, messages: dict[int, Message] | None = None) -> None:
        super().__init__(message_from_id=messages or {}, atomic_counter=0)


def copy_of(connection: Any) -> SceneCopy:
    of_all = SimpleNamespace(get_message_buffer=Buffer)
    client: Any = SimpleNamespace(_websock_connection=connection, _viser_server=SimpleNamespace(_websock_server=of_all))
    return SceneCopy(client)


def connection() -> Any:
    from threading import RLock

    buffer = Buffer()
    return SimpleNamespace(get_message_buffer=lambda: buffer, _record_lock=RLock(), _record_handles=[])


def decoded(frame: bytes) -> list[dict[str, Any]]:
    size, packed = struct.unpack("<QQ", frame[:16])
    inner = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + packed], size)
    return msgspec.msgpack.decode(inner)["messages"]


def made(name: str) -> Message:
    return _messages.FrameMessage(name, _messages.FrameProps(True, 0.5, 0.1, 0.1, (0, 0, 0), 1.0))


def placed(name: str, x: float) -> Message:
    return _messages.SetPositionMessage(name, (x, 0.0, 0.0))


def changed(name: str, x: float, y: float | None) -> Message:
    return _messages.SceneNodeUpdateMessage(name, {"x": x} if y is None else {"x": x, "y": y})


def removed(name: str) -> Message:
    return _messages.RemoveSceneNodeMessage(name)


def seen(nodes: dict[str, dict[str, Any]], messages: list[dict[str, Any]]) -> None:
    """Bring nodes up to date by messages, as viser's client does."""
    for message in messages:
        name = message.get("name", "")
        match message["type"]:
            case "FrameMessage":
                nodes[name] = {}
            case "RemoveSceneNodeMessage":
                nodes.pop(name, None)
            case "SetPositionMessage" if name in nodes:
                nodes[name]["position"] = message["position"]
            case "SceneNodeUpdateMessage" if name in nodes:
                nodes[name] |= message["updates"]


names = st.sampled_from("ab")
numbers = st.integers(0, 9).map(float)
steps = st.one_of(
    names.map(made),
    names.map(removed),
    st.builds(placed, names, numbers),
    st.builds(changed, names, numbers, st.none() | numbers),
)


@given(st.lists(st.tuples(steps, st.booleans()), max_size=30))
def test_who_looks_seldom_ends_with_what_stands_there(course: list[tuple[Message, bool]]) -> None:
    copy = copy_of(connection())
    there: dict[str, dict[str, Any]] = {}
    always: dict[str, dict[str, Any]] = {}
    seldom: dict[str, dict[str, Any]] = {}
    late: dict[str, dict[str, Any]] = {}
    known = {id(always): 0, id(seldom): 0, id(late): 0}

    def look(nodes: dict[str, dict[str, Any]]) -> None:
        taken = copy.taken()
        assert taken is not None
        seen(nodes, decoded(frame_of([message for count, message in taken if count > known[id(nodes)]])))
        known[id(nodes)] = copy.count

    for message, is_seen in course:
        copy._insert_message(message)
        seen(there, decoded(frame_of([message])))
        look(always)
        if is_seen:
            look(seldom)
    look(seldom)
    look(late)
    assert there == always == seldom == late


def test_half_a_frame_is_not_taken() -> None:
    link = connection()
    copy = copy_of(link)
    copy._insert_message(made("a"))
    link.get_message_buffer().atomic_counter = 1
    assert copy.taken() is None
    link.get_message_buffer().atomic_counter = 0
    assert copy.taken() is not None


def test_panels_cameras_and_what_can_be_dragged_are_left_out() -> None:
    copy = copy_of(connection())
    props: Any = None
    for message in (
        _messages.GuiHtmlMessage("u", "c", props), _messages.SetCameraFovMessage(1.0),
        _messages.Gui3DMessage("/g", props),
        _messages.TransformControlsMessage("/t", props), _messages.RunJavascriptMessage("alert(1)"),
        _messages.SetSceneNodeClickBindingsMessage("/a", ()), _messages.ShareUrlUpdated("https://x"),
        _messages.FileTransferPart(None, "u", 0, b""),
    ):  # fmt: skip
        copy._insert_message(message)
    assert copy.taken() == []
    copy._insert_message(_messages.EnableLightsMessage(False, False))
    assert len(copy.taken() or []) == 1


def test_what_is_taken_away_is_every_node_that_was_made() -> None:
    copy = copy_of(connection())
    node = made("a")
    node.owner = "7"  # pyright: ignore[reportAttributeAccessIssue]
    for message in (node, placed("a", 1.0), made("b"), removed("b")):
        copy._insert_message(message)
    (away,) = decoded(frame_of(removal_of(copy.taken() or [])))
    assert (away["type"], away["name"], away["owner"]) == ("RemoveSceneNodeMessage", "a", "7")


def test_arrays_travel_beside_the_words_and_the_first_frame_ends_the_replay() -> None:
    points = np.arange(6, dtype=np.float32).reshape(2, 3)
    frame = frame_of([_messages.SceneNodeUpdateMessage("a", {"points": points})], first=True)
    update, done = decoded(frame)
    assert update["updates"]["points"] == {"__binary_index": 0, "dtype": "<f4"}
    assert done["type"] == "ReplayDoneMessage"
    assert frame.endswith(points.tobytes())
    assert (len(frame) - points.nbytes) % 8 == 0


def test_it_hears_what_viser_sends_to_one_browser(served: Served) -> None:
    copies: list[tuple[Any, SceneCopy]] = []
    served.viewer.server.on_client_connect(lambda client: copies.append((client, SceneCopy(client))))
    with browse(served) as browser:
        say(browser, CAMERA)
        assert eventually(lambda: copies)
        client, copy = copies[0]
        client.scene.add_box("/there/box", color=(1, 2, 3))
        messages = decoded(frame_of([message for _, message in copy.taken() or []]))
        told = {(message["type"], message.get("name")) for message in messages}
        assert ("BoxMessage", "/there/box") in told
        assert ("SetOrientationMessage", "") in told, "which way is up"
