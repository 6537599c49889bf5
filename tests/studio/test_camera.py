"""The camera of a browser: where it is pointed, and where its person has left it."""

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest
import viser
from conftest import eventually
from hypothesis import given
from hypothesis import strategies as st
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from studio.viewer.camera import Camera, Pose
from studio.viewer.scene import camera

BOX = np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0])
TWICE = np.array([-1.0, -1.0, 0.0]), np.array([4.0, 1.0, 1.0])
COORDINATES = st.floats(-1e3, 1e3)


@dataclass
class Eye:
    """A browser's side of its camera."""

    connection: Connection
    client: viser.ClientHandle
    camera: Camera

    def is_at(self, position: np.ndarray, target: np.ndarray, size: tuple[int, int] = (800, 600)) -> None:
        """Tell the server where the camera is, and wait until it knows."""
        told = {
            "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [float(x) for x in position], "fov": 1.0,
            "near": 0.1, "far": 100.0, "look_at": [float(x) for x in target], "up_direction": [0, 0, 1],
            "image_width": size[0], "image_height": size[1],
        }  # fmt: skip
        heard: list[object] = []
        self.client.camera.on_update(heard.append)
        self.connection.send(msgspec.msgpack.encode(told))
        assert eventually(lambda: heard)

    @property
    def pose(self) -> Pose:
        """Where the server believes the camera to be."""
        return Pose(self.client.camera.position, self.client.camera.look_at)


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def eye(server: viser.ViserServer) -> Iterator[Eye]:
    assert eventually(lambda: not server.get_clients())  # that of the test before would be told of as well
    came: list[viser.ClientHandle] = []
    server.on_client_connect(came.append)
    address = f"ws://127.0.0.1:{server.get_port()}"
    with connect(address, subprotocols=["viser-v1.1.1"], max_size=None) as connection:  # pyright: ignore
        begin = {
            "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [3, 3, 3], "fov": 1.0, "near": 0.1,
            "far": 100.0, "look_at": [0, 0, 0], "up_direction": [0, 0, 1], "image_width": 800, "image_height": 600,
        }  # fmt: skip
        connection.send(msgspec.msgpack.encode(begin))
        assert eventually(lambda: came)
        yield Eye(connection, came[0], Camera(came[0]))


def whole(box: tuple[np.ndarray, np.ndarray]) -> Pose:
    return Pose(*camera(*box))


def test_the_camera_stays_where_it_was_left_for_each_task(eye: Eye) -> None:
    assert eye.camera.frame("reacher", (), BOX, alone=True)
    assert not eye.camera.frame("reacher", (), BOX, alone=True)
    assert eye.pose.is_near(whole(BOX))
    eye.is_at(whole(BOX).position, whole(BOX).target)  # it has arrived
    assert eye.camera.ticks == {}
    eye.is_at(np.array([1.0, -2.0, 3.0]), np.zeros(3))  # and is moved by a person
    assert eventually(lambda: eye.camera.ticks == {"camera of reacher": "1 -2 3 0 0 0"})
    assert eye.camera.frame("pen_press", (), TWICE, alone=True)
    assert eye.pose.is_near(whole(TWICE))
    assert eye.camera.frame("reacher", (), BOX, alone=True)
    assert eye.pose.is_near(Pose(np.array([1.0, -2.0, 3.0]), np.zeros(3)))


def test_what_a_browser_tells_before_it_has_gone_where_it_was_pointed_is_no_wish(eye: Eye) -> None:
    eye.camera.frame("reacher", (), BOX, alone=True)
    eye.is_at(np.array([3.0, 3.0, 3.0]), np.zeros(3))  # sent before it heard
    assert eye.camera.ticks == {}


def test_the_whole_scene_is_seen_again_on_request(eye: Eye) -> None:
    eye.camera.frame("reacher", (), BOX, alone=True)
    eye.is_at(whole(BOX).position, whole(BOX).target)
    eye.is_at(np.array([1.0, -2.0, 3.0]), np.zeros(3))
    assert eventually(lambda: eye.camera.ticks)
    eye.camera.look_at_all()
    assert eye.pose.is_near(whole(BOX))
    assert eye.camera.ticks == {"camera of reacher": ""}
    eye.camera.put_back({"camera of reacher": "1 -2 3 0 0 0"})  # what the page has not heard of yet
    assert eye.pose.is_near(whole(BOX))


def test_a_reload_puts_the_camera_back(eye: Eye) -> None:
    eye.camera.frame("reacher", (), BOX, alone=True)
    eye.camera.put_back({"camera of reacher": "1 -2 3 0 0 0", "camera of pen_press": "0 0 9 0 0 0.5", "speed": 2.0})
    assert eye.pose.is_near(Pose(np.array([1.0, -2.0, 3.0]), np.zeros(3)))
    eye.camera.frame("pen_press", (), TWICE, alone=True)
    assert eye.pose.is_near(Pose(np.array([0.0, 0.0, 9.0]), np.array([0.0, 0.0, 0.5])))


def test_two_designs_side_by_side_are_seen_whole_and_nothing_of_that_is_kept(eye: Eye) -> None:
    eye.camera.put_back({"camera of reacher": "1 -2 3 0 0 0"})
    eye.camera.frame("reacher", (), TWICE, alone=False)
    assert eye.pose.is_near(whole(TWICE))
    eye.is_at(whole(TWICE).position, whole(TWICE).target)
    eye.is_at(np.array([5.0, 5.0, 5.0]), np.zeros(3))
    eye.camera.frame("reacher", (), BOX, alone=True)
    assert eye.pose.is_near(Pose(np.array([1.0, -2.0, 3.0]), np.zeros(3)))


def test_a_page_that_turns_out_to_be_narrow_is_pointed_anew(eye: Eye) -> None:
    eye.camera.frame("reacher", (), BOX, alone=True)
    eye.is_at(whole(BOX).position, whole(BOX).target, (390, 800))
    narrow = Pose(*camera(*BOX, 390 / 800))
    assert eventually(lambda: eye.pose.is_near(narrow))


def test_a_scene_without_panels_beside_it_is_seen_in_its_whole_width_whatever_shape_it_gets(eye: Eye) -> None:
    eye.camera.frame("reacher", (), BOX, alone=True)
    eye.is_at(whole(BOX).position, whole(BOX).target)
    eye.camera.uncover(True)
    for size in ((1600, 900), (390, 800)):
        eye.is_at(eye.pose.position, eye.pose.target, size)
        wide = Pose(*camera(*BOX, 0.72 * size[0] / size[1], is_covered=False))
        assert eventually(lambda wide=wide: eye.pose.is_near(wide))
    eye.is_at(eye.pose.position, eye.pose.target)
    eye.camera.uncover(False)
    assert eventually(lambda: eye.pose.is_near(whole(BOX)))


@pytest.mark.parametrize(
    "words", ["", "1 2 3", "a b c d e f", "1 2 3 4 5 nan", "1 2 3 4 5 inf", "1e9 0 0 0 0 0", "1 2 3 1 2 3", True, 0.5]
)
def test_words_that_are_no_place_are_left_out(words: object) -> None:
    assert Pose.from_words(words) is None


@given(st.tuples(*[COORDINATES] * 3), st.tuples(*[COORDINATES] * 3))
def test_a_place_comes_back_from_its_words(position: tuple[float, ...], target: tuple[float, ...]) -> None:
    pose = Pose(np.array(position), np.array(target))
    back = Pose.from_words(pose.in_words())
    if np.linalg.norm(pose.position - pose.target) > 0.1:
        assert back is not None
        np.testing.assert_allclose([back.position, back.target], [position, target], rtol=1e-4, atol=1e-9)
    assert len(pose.in_words()) <= 128
