"""What a browser may put into the elements of the viewer: nothing that the next browser could not be sent."""

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from morph_core.config import LARGEST
from morph_core.history import History
from studio.bridge import GuardedViser
from studio.desks import Desks
from studio.elements import element_of, settled
from studio.export.bundle import Bundle
from studio.recordings import Recordings
from studio.viewer.viewer import Viewer
from tests.studio.conftest import NAME, Cutter, Neighbours, Oracle, Stars, eventually, make_run

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1, 1, 1], "fov": 1.0, "near": 0.1, "far": 100.0,
    "look_at": [0, 0, 0], "up_direction": [0, 0, 1], "image_height": 100, "image_width": 100,
}  # fmt: skip
WRONG = (
    99999999999999999999.0, 1e20, -1e20, 1e308, -1e308, 2**53, -(2**53), 2**63, 2**64 - 1, 1e39, "1", "", [],
    "<script>", [1], [1e20, 1e20], [1, 2, 3], {}, {"x": 1}, None, b"1", [[1, 2], [3, 4]], [None, None], "x" * 5000,
)  # fmt: skip
"""Values that no element for a number holds."""


class Page:
    """A guarded viser with the whole viewer of one browser, which stays."""

    def __init__(self, runs: Path) -> None:
        self.guarded = GuardedViser()
        self.folder = make_run(runs, NAME, ended="finished")
        self.viewers: list[Viewer] = []
        self.desks = Desks(self.guarded.server, self.make)

    def make(self, client: viser.ClientHandle) -> Viewer:
        viewer = Viewer(
            client, on_command=lambda *_: 0, on_start=lambda _: NAME, on_resume=lambda _: None,
            on_branch=lambda *_: NAME, on_export=lambda *_: Bundle("design.zip", {}, [], b"zip"), answers=Oracle(),
            family=lambda _: None, album=Stars(), others=Neighbours({}), films=Cutter(), recordings=Recordings(),
        )  # fmt: skip
        self.viewers.append(viewer)
        return viewer

    def browser(self) -> Any:
        subprotocols = [Subprotocol("viser-v1.1.1")]
        return connect(self.guarded.address, subprotocols=subprotocols, max_size=None, proxy=None, close_timeout=0.3)

    def elements(self) -> dict[str, Any]:
        guis = [client.gui for client in self.guarded.server.get_clients().values()]
        return {uuid: handle._impl for gui in guis for uuid, handle in gui._gui_input_handle_from_uuid.items()}

    def newcomer_is_served(self) -> bool:
        """Tell whether a browser that comes now is sent what a viewer is made of."""
        seated = len(self.viewers)
        with self.browser() as browser:
            browser.send(msgspec.msgpack.encode(CAMERA))
            browser.recv(timeout=60)
            return bool(eventually(lambda: len(self.viewers) > seated, 60))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    page = Page(tmp_path_factory.mktemp("values") / "runs")
    with page.browser() as browser:
        browser.send(msgspec.msgpack.encode(CAMERA))
        assert eventually(lambda: page.viewers, 60)
        history = History(page.folder)
        page.desks.show({NAME: history}, {NAME: ("finished", "")}, NAME)
        assert eventually(lambda: len(page.elements()) > 40, 60)
        yield page
    page.desks.stop()
    page.guarded.stop()


def update(uuid: str, value: object) -> bytes:
    return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})


def is_number(element: Any) -> bool:
    value = element.value if hasattr(element.props, "disabled") else None
    numbers = value if isinstance(value, tuple) else (value,)
    return bool(numbers) and all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers)


def test_no_element_takes_what_it_can_not_hold_and_the_next_browser_comes(page: Page) -> None:
    numbers = {uuid: element for uuid, element in page.elements().items() if is_number(element)}
    assert len(numbers) > 20
    for uuid, element in page.elements().items():
        for value in WRONG:
            passed = page.guarded.passed_on(update(uuid, value), object())
            assert passed is None or not is_number(element), f"{element.props} took {value!r}"
    assert page.newcomer_is_served()


def test_what_is_passed_on_is_in_the_range_of_the_element_and_can_be_sent(page: Page) -> None:
    for uuid, element in page.elements().items():
        if not is_number(element):
            continue
        props, many = element.props, isinstance(element.value, tuple)
        lo, hi = (getattr(props, end, None) for end in ("min", "max"))
        assert lo is not None, f"{props.label} has no lower end"
        assert hi is not None, f"{props.label} has no upper end"
        for end in (lo, hi):
            ends = list(end) if many and isinstance(end, tuple) else [end] * len(element.value) if many else end
            passed = page.guarded.passed_on(update(uuid, ends), object())
            assert passed is not None or uuid not in page.elements(), props.label  # a panel that is drawn anew
        beyond = [h + 1 for h in hi] if many and isinstance(hi, tuple) else hi + 1
        assert page.guarded.passed_on(update(uuid, beyond), object()) is None


def test_a_value_that_rounding_has_moved_past_the_end_is_the_end(page: Page) -> None:
    gui = page.guarded.server.gui
    number = gui.add_number("gap", 0.5, min=0.123456, max=0.987654, step=0.001)
    element = element_of(page.guarded.server, number._impl.uuid)
    digits = element.props.precision
    assert settled(element, 0.123456 - 0.4 * 10.0**-digits) == 0.123456
    with pytest.raises(ValueError, match="lies outside"):
        settled(element, 0.123456 - 0.6 * 10.0**-digits)
    passed = page.guarded.passed_on(update(number._impl.uuid, 0.987654 + 0.4 * 10.0**-digits), object())
    assert passed is not None
    assert msgspec.msgpack.decode(passed)["updates"]["value"] == 0.987654
    number.remove()


@given(st.floats() | st.integers(), st.integers(-5, 5), st.integers(1, 10))
def test_a_whole_number_is_held_exactly_in_its_range(value: float, lo: int, width: int) -> None:
    class Element:
        value = lo

        class props:
            min, max, precision, disabled = lo, lo + width, 0, False

    fits = math.isfinite(value) and value == int(value) and lo <= value <= lo + width
    try:
        assert settled(Element, value) == value
        assert fits
    except ValueError:
        assert not fits


def test_an_element_without_ends_holds_no_more_than_a_browser_can(page: Page) -> None:
    number = page.guarded.server.gui.add_number("any", 0)
    for value in (LARGEST, -LARGEST):
        assert page.guarded.passed_on(update(number._impl.uuid, value), object()) is not None
    for value in (LARGEST + 1, -LARGEST - 1):
        assert page.guarded.passed_on(update(number._impl.uuid, value), object()) is None
    number.remove()


@pytest.mark.parametrize("odd", ["1", [1, 2], None, {}, 1e20, [1e300, 0, 0]])
@pytest.mark.parametrize("name", [name for name in CAMERA if name != "type"])
def test_a_camera_of_odd_numbers_is_dropped(page: Page, name: str, odd: object) -> None:
    assert page.guarded.passed_on(msgspec.msgpack.encode(CAMERA), object()) is not None
    assert page.guarded.passed_on(msgspec.msgpack.encode(CAMERA | {name: odd}), object()) is None


def test_however_often_it_is_tried_there_is_one_line(page: Page, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        for _ in range(100):
            page.guarded.dropped.warn("dropped")
    assert len(caplog.records) <= 1


# --- uploads ----------------------------------------------------------------------------------------------------------


def start(name: str, button: str, parts: int = 2, size: int = 4) -> bytes:
    fields = {"filename": "d.json", "mime_type": "application/json", "part_count": parts, "size_bytes": size}
    return msgspec.msgpack.encode(
        {"type": "FileTransferStartUpload", "source_component_uuid": button, "transfer_uuid": name, **fields}
    )


def part(name: str, button: str, index: int, content: bytes) -> bytes:
    where = {"source_component_uuid": button, "transfer_uuid": name, "part_index": index, "content": content}
    return msgspec.msgpack.encode({"type": "FileTransferPart", **where})


def test_uploads_that_are_never_finished_leave_nothing_behind(page: Page) -> None:
    gui = page.guarded.server.gui
    button = gui.add_upload_button("bring")
    uuid, browser, now = button._impl.uuid, object(), [0.0]
    page.guarded.uploads._clock = lambda: now[0]
    pending = gui._current_file_upload_states
    for number in range(30):
        begun = page.guarded.passed_on(start(f"t{number}", uuid), browser)
        assert (begun is not None) == (number < 2), "two of one browser"
        if begun is not None:
            pending[f"t{number}"] = {}  # pyright: ignore - as viser keeps it
    assert page.guarded.passed_on(part("t0", uuid, 0, b"more than was announced"), browser) is None
    assert list(pending) == ["t1"]
    now[0] = 121.0
    page.guarded.uploads.give_up_late()
    assert not pending
    for number, other in enumerate([object() for _ in range(6)]):
        assert (page.guarded.passed_on(start(f"o{number}", uuid), other) is not None) == (number < 4), "four of all"
        page.guarded.uploads.leave(object())
    page.guarded.uploads._open.clear()
    assert page.guarded.passed_on(start("mine", uuid), browser) is not None
    pending["mine"] = {}  # pyright: ignore
    assert page.guarded.passed_on(part("mine", uuid, 0, b"ab"), object()) is None, "another browser's"
    page.guarded.uploads.leave(browser)
    assert not pending
    button.remove()
