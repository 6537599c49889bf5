"""The contract with viser 1.1.1: its own port is shut, and through the bridge only what a viewer needs passes."""

import math
import socket
import struct
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import httpx
import msgspec
import pytest
import viser
import websockets.asyncio.server
import zstandard
from conftest import TOKEN, Served, eventually
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection
from websockets.typing import Origin, Subprotocol

from studio.bridge import ALLOWED, MAX_MESSAGE, UPLOADS, GuardedViser, admit, client_csp

VERSION = Subprotocol(f"viser-v{viser.__version__}")
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1, 1, 1], "fov": 1.0, "near": 0.1, "far": 100.0,
    "look_at": [0, 0, 0], "up_direction": [0, 0, 1], "image_height": 100, "image_width": 100,
}  # fmt: skip


@pytest.fixture
def guarded() -> Iterator[GuardedViser]:
    server = GuardedViser()
    yield server
    server.stop()


def browse(
    served: Served, origin: str | None = None, version: Subprotocol = VERSION, path: str = "/viewer"
) -> ClientConnection:
    """Open the viewer's websocket as a browser of our own page does."""
    return connect(
        f"ws://127.0.0.1:{served.port}{path}",
        origin=Origin(origin or f"http://127.0.0.1:{served.port}"),
        additional_headers={"Authorization": f"Bearer {TOKEN}"},
        subprotocols=[version],
        max_size=None,
        proxy=None,
    )


def say(connection: Connection, message: Mapping[str, object]) -> None:
    connection.send(msgspec.msgpack.encode(message))


def heard(connection: Connection, kind: str, seconds: float = 30.0) -> dict:
    """Return the next message of this kind that the viewer sends."""
    while True:
        frame = connection.recv(timeout=seconds)
        assert isinstance(frame, bytes)
        size = struct.unpack("<QQ", frame[:16])[1]
        batch = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size]))
        for message in batch["messages"]:
            if message["type"] == kind:
                return message


def closes(connection: Connection) -> int | None:
    """Return the code with which the server ends the connection."""
    with pytest.raises(ConnectionClosed) as end:
        _listen(connection)
    return end.value.rcvd.code if end.value.rcvd else None


def _listen(connection: Connection) -> None:
    while True:
        connection.recv(timeout=30)


# --- viser's own port -------------------------------------------------------------------------------------------------


def test_viser_is_the_version_this_was_tried_with() -> None:
    assert viser.__version__ == "1.1.1"


@pytest.mark.parametrize("path", ["/", "/index.html", "/viewer", "/../../../../etc/hostname"])
def test_the_inner_port_serves_no_page(guarded: GuardedViser, path: str) -> None:
    assert httpx.get(f"http://127.0.0.1:{guarded.port}{path}").status_code == 403
    with_upgrade = httpx.get(f"http://127.0.0.1:{guarded.port}{path}", headers={"Upgrade": "websocket"})
    assert with_upgrade.status_code == 403


def test_the_inner_port_wants_its_secret(guarded: GuardedViser) -> None:
    for path in ("/", "/wrong", guarded.address.rpartition("/")[2].join("//")):
        with pytest.raises(InvalidStatus) as refused:
            connect(f"ws://127.0.0.1:{guarded.port}{path}", subprotocols=[VERSION], proxy=None)
        assert refused.value.response.status_code == 403
    with connect(guarded.address, subprotocols=[VERSION], proxy=None) as connection:
        assert connection.subprotocol == VERSION


def test_the_inner_port_answers_on_this_machine_only(guarded: GuardedViser) -> None:
    addresses = {str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for address in addresses - {"127.0.0.1", "127.0.1.1"}:
        with pytest.raises(OSError, match=r"refused|unreachable"):
            socket.create_connection((address, guarded.port), timeout=2).close()


def test_a_viser_that_does_not_take_the_guard_is_not_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    real, stopped = viser.ViserServer, []

    class Elsewhere(real):
        """A later viser that keeps its own reference to `serve`."""

        def __init__(self, **options: Any) -> None:
            taken, websockets.asyncio.server.serve = websockets.asyncio.server.serve, serve
            super().__init__(**options)
            websockets.asyncio.server.serve = taken

        def stop(self) -> None:
            stopped.append(self.get_port())
            super().stop()

    serve = websockets.asyncio.server.serve
    monkeypatch.setattr(viser, "ViserServer", Elsewhere)
    with pytest.raises(RuntimeError, match="did not take the guard"):
        GuardedViser()
    assert len(stopped) == 1
    assert websockets.asyncio.server.serve is serve
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", stopped[0]), timeout=2)


def test_the_guard_is_taken_off_the_library_again(guarded: GuardedViser) -> None:
    assert guarded.port > 0
    assert websockets.asyncio.server.serve.__module__ == "websockets.asyncio.server"


# --- through the bridge -----------------------------------------------------------------------------------------------


def test_a_click_reaches_the_viewer_and_its_answer_comes_back(served: Served) -> None:
    clicked = threading.Event()
    button = served.viewer.server.gui.add_button("press")
    button.on_click(lambda _: clicked.set())
    uuid = button._impl.uuid
    with browse(served) as browser:
        assert browser.subprotocol == VERSION
        say(browser, CAMERA)
        assert heard(browser, "GuiButtonMessage")["uuid"] == uuid
        say(browser, {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": True}})
        assert clicked.wait(5)
        served.viewer.server.gui.add_text("said", "hello")
        assert heard(browser, "GuiTextMessage")["value"] == "hello"


def test_a_forged_page_can_not_press_a_button(served: Served) -> None:
    with pytest.raises(InvalidStatus) as refused:
        browse(served, origin="https://evil.example")
    assert refused.value.response.status_code == 403


def test_what_a_viewer_does_not_need_is_dropped_and_the_connection_lives(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared, values = [], []
    monkeypatch.setattr(served.viewer.server, "request_share_url", lambda: shared.append("tunnel"))
    slider = served.viewer.server.gui.add_slider("alpha", min=0, max=1, step=0.1, initial_value=0.5)
    slider.on_update(lambda event: values.append(event.target.value))
    uuid, impl = slider._impl.uuid, slider._impl
    kept = impl.update_cb
    with browse(served) as browser:
        say(browser, CAMERA)
        for message in (
            {"type": "ShareUrlRequest"},
            {"type": "ShareUrlDisconnect"},
            {"type": "FileTransferStartUpload", "source_component_uuid": uuid, "transfer_uuid": "t", "filename": "f",
             "mime_type": "text/plain", "part_count": 10**6, "size_bytes": 10**12},
            {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"update_cb": []}},
            {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": 0.5, "update_cb": []}},
            {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": math.nan}},
            {"type": "RunJavascriptMessage", "source": "alert(1)"},
        ):  # fmt: skip
            say(browser, message)
        browser.send(b"\xc1 this is no msgpack")
        browser.send("nor is this")
        say(browser, {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": 0.7}})
        assert eventually(lambda: slider.value == 0.7)
    assert eventually(lambda: values) == [0.7]
    assert shared == []
    assert impl.update_cb is kept


def test_a_design_is_uploaded_through_the_bridge(served: Served) -> None:
    taken: list[bytes] = []
    button = served.viewer.server.gui.add_upload_button("bring")
    button.on_upload(lambda event: taken.append(event.target.value.content))
    where = {"source_component_uuid": button._impl.uuid, "transfer_uuid": "t"}
    start = {"filename": "d.json", "mime_type": "application/json", "part_count": 2, "size_bytes": 4}
    with browse(served) as browser:
        say(browser, CAMERA)
        say(browser, {"type": "FileTransferStartUpload", **where, **start})
        for index, content in enumerate((b"ab", b"cd")):
            say(browser, {"type": "FileTransferPart", **where, "part_index": index, "content": content})
        assert eventually(lambda: taken == [b"abcd"])


def test_a_message_that_is_too_long_ends_its_connection_only(served: Served) -> None:
    with browse(served) as careless, browse(served) as careful:
        careless.send(bytes(MAX_MESSAGE + 1))
        assert closes(careless) == 1009
        say(careful, CAMERA)
        assert heard(careful, "ReplayDoneMessage")
    assert served.client.get("/healthz").status_code == 200


def test_another_version_of_the_client_is_turned_away(served: Served) -> None:
    with browse(served, version=Subprotocol("viser-v0.0.1")) as browser:
        assert closes(browser) == 1002


def test_the_page_of_the_client_may_talk_to_its_own_server_only(served: Served) -> None:
    page = served.client.get("/viewer/")
    policy = page.headers["content-security-policy"]
    assert "<div" in page.text
    assert policy == client_csp(f"127.0.0.1:{served.port}")
    assert "default-src 'none'" in policy
    assert "'unsafe-eval'" not in policy
    (connect_to,) = (part for part in policy.split("; ") if part.startswith("connect-src"))
    host = f"127.0.0.1:{served.port}"
    assert connect_to.split()[1:] == [f"ws://{host}", f"wss://{host}", "blob:", "data:"]
    assert served.client.get("/viewer").status_code == 307


# --- the sieve --------------------------------------------------------------------------------------------------------


def test_every_allowed_kind_exists_in_viser() -> None:
    from viser import _messages

    assert {kind for kind in ALLOWED if not hasattr(_messages, kind)} == set()


RAY = {"ray_origin": [0, 0, 0.5], "ray_direction": [0, 0, 1], "modifier": None}
UPLOAD = {"source_component_uuid": "u", "transfer_uuid": "t"}
DRAG = {
    "phase": "start", "instance_index": None, "start_position": [0, 0, 0], "start_screen_pos": [0.5, 0.5],
    "end_position": [0, 0, 0], "end_screen_pos": [0.5, 0.5], "button": "left", "modifier": None,
}  # fmt: skip
RIGHT: dict[str, dict[str, Any]] = {
    "ViewerCameraMessage": CAMERA,
    "GuiUpdateMessage": {"uuid": "u", "updates": {"value": 1}},
    "GuiButtonHoldMessage": {"uuid": "u", "frequency": 10},
    **{kind: {"uuid": "u"} for kind in ("GuiFormDirtyMessage", "GuiFormSubmitMessage", "CommandTriggerMessage")},
    "SceneNodeClickMessage": {"name": "/x", "instance_index": 3, "screen_pos": [0, 1], **RAY},
    "SceneNodeDragMessage": {"name": "/x", **DRAG},
    "ScenePointerMessage": {"event_type": "click", "screen_pos": [[0.5, 0.5]], **RAY},
    "TransformControlsUpdateMessage": {"name": "/x", "wxyz": [1, 0, 0, 0], "position": [0, 0, 0]},
    **{f"TransformControlsDrag{end}Message": {"name": "/x", "owner": ""} for end in ("Start", "End")},
    "FileTransferPartAck": {**UPLOAD, "transferred_bytes": 1, "total_bytes": 2},
    "FileTransferStartUpload": {
        **UPLOAD, "filename": "f", "mime_type": "text/plain", "part_count": 1, "size_bytes": 1,
    },
    "FileTransferPart": {**UPLOAD, "part_index": 0, "content": b"x"},
}  # fmt: skip
"""A message of every kind that a browser may send, as viser's own client sends it."""


def test_only_allowed_kinds_are_admitted() -> None:
    from viser import _messages

    assert RIGHT.keys() == ALLOWED | UPLOADS.keys()
    kinds = {kind.__name__ for kind in _messages.Message.get_subclasses()}
    assert len(kinds) > 100
    for kind in kinds:
        for fields in RIGHT.values():
            said = admit(msgspec.msgpack.encode({**fields, "type": kind}))
            assert said is None or kind in RIGHT
    for kind, fields in RIGHT.items():
        assert admit(msgspec.msgpack.encode({**fields, "type": kind})), kind


ODD = st.none() | st.booleans() | st.text() | st.binary() | st.lists(st.integers(-(2**63), 2**63))


@given(st.sampled_from(list(RIGHT)), st.data(), ODD)
def test_what_viser_is_handed_is_a_message_as_it_declares_it(kind: str, data: st.DataObject, odd: object) -> None:
    """Fields that are missing, of another type or too many make viser raise, or keep what it can't send."""
    from viser import _messages

    changed = {**RIGHT[kind], "type": kind, data.draw(st.sampled_from([*RIGHT[kind], "owner", "x"])): odd}
    changed.pop(data.draw(st.sampled_from(["none", *RIGHT[kind]])), None)
    content = msgspec.msgpack.encode(changed)
    if admit(content):
        assert type(_messages.Message.deserialize(content)).__name__ == kind


def test_an_element_form_or_command_that_is_not_there_is_told_nothing(guarded: GuardedViser) -> None:
    gui, browser = guarded.server.gui, object()
    with gui.add_form("form"):
        number = gui.add_number("number", 1)
    (form,) = (uuid for uuid in gui._container_handle_from_uuid if uuid != "root")
    there = {"GuiFormDirtyMessage": form, "GuiFormSubmitMessage": form, "GuiUpdateMessage": number._impl.uuid}
    for kind, uuid in there.items():
        for name, passes in ((uuid, True), ("another", False), ("", False)):
            message = msgspec.msgpack.encode({**RIGHT[kind], "type": kind, "uuid": name})
            assert (guarded.passed_on(message, browser) is not None) == passes
    for kind in UPLOADS:
        assert guarded.passed_on(msgspec.msgpack.encode({**RIGHT[kind], "type": kind}), browser) is None
    assert not guarded.uploads._open


@pytest.mark.parametrize("odd", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    "place",
    [
        lambda odd: {"type": "GuiUpdateMessage", "uuid": "u", "updates": {"value": odd}},
        lambda odd: {"type": "GuiUpdateMessage", "uuid": "u", "updates": {"value": [0.5, [odd]]}},
        lambda odd: {"type": "GuiUpdateMessage", "uuid": "u", "updates": {"value": {"x": (odd, 1.0)}}},
        lambda odd: {**CAMERA, "position": [1.0, odd, 1.0]},
        lambda odd: {**CAMERA, "fov": odd},
    ],
    ids=["value", "list", "dict", "vector", "field"],
)
def test_a_number_that_is_none_is_dropped_wherever_it_stands(place: Callable[[float], object], odd: float) -> None:
    assert admit(msgspec.msgpack.encode(place(1.0)))
    assert not admit(msgspec.msgpack.encode(place(odd)))


@given(st.binary(max_size=200))
def test_the_sieve_never_raises(noise: bytes) -> None:
    admit(noise)


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats() | st.text() | st.binary(),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8) | st.integers(0, 9), inner),
        max_leaves=8,
    )
)
def test_the_sieve_judges_any_message(content: object) -> None:
    message = {"type": "GuiUpdateMessage", "uuid": "u", "updates": {"value": content}}
    if admit(msgspec.msgpack.encode(message)):
        assert not _has_odd_number(content)
    else:
        assert _has_odd_number(content) or not isinstance(content, int | str | bool | float | type(None))


def _has_odd_number(value: object) -> bool:
    if isinstance(value, int | float):
        return not abs(value) < 2**53
    items = [*value, *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else ()
    return any(_has_odd_number(item) for item in items)
