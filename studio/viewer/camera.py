"""Where the camera stands: so that the whole scene is seen, or where the person of a browser has left it."""

import threading
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import viser

from studio.viewer.scene import (
    FIELD_OF_VIEW,
    NARROW,
    USUAL_ASPECT,
    Host,
    camera,
    clients_of,
    initial_camera_of,
)
from studio.viewer.view import Tick

Corners = tuple[np.ndarray, np.ndarray]
_PREFIX = "camera of "
"""Beginning of the names under which places of the camera are remembered; the task's name follows."""
_NEAR = 0.01
"""Distance at which two places of the camera are the same, as a share of how far it is from what it looks at."""
_SAME_SHAPE = 0.02
"""Share by which a scene may get wider or narrower and still have the same shape."""
_ROOMY = 0.72
"""Share of its width that a scene fills where no panel covers the page: then what lies round it is seen, too."""
_FARTHEST = 1e4
"""Largest coordinate of a remembered place, in m."""


@dataclass(frozen=True)
class Pose:
    """Place of a camera and what it looks at."""

    position: np.ndarray  # (3,) m
    target: np.ndarray  # (3,) m

    def is_near(self, other: "Pose") -> bool:
        """Tell whether another pose is the same to the eye."""
        away = max(np.abs(self.position - other.position).max(), np.abs(self.target - other.target).max())
        return bool(away <= _NEAR * np.linalg.norm(self.position - self.target))

    def in_words(self) -> str:
        """Return the six coordinates as text."""
        return " ".join(f"{value:.5g}" for value in (*self.position, *self.target))

    @classmethod
    def from_words(cls, words: object) -> "Pose | None":
        """Return the pose of such a text; None of anything else, and of one from which nothing could be seen."""
        try:
            numbers = np.array(str(words).split(), float)
        except ValueError:
            return None
        if numbers.shape != (6,) or not (np.abs(numbers) <= _FARTHEST).all():
            return None
        pose = cls(numbers[:3], numbers[3:])
        return None if np.linalg.norm(pose.position - pose.target) < 1e-3 else pose


class Camera:
    """The camera of one browser, or those of all that a server has. Its methods may be called from any thread.

    That of one browser stays where its person has left it, for each task, until the whole scene is asked for.
    """

    def __init__(self, host: Host) -> None:
        """Leave the camera where it is, until there is something to be seen."""
        self._host = host
        self._initial = initial_camera_of(host)
        self._lock = threading.RLock()
        self._seen: tuple[object, ...] = ()
        self._box: Corners | None = None
        self._task: str | None = None
        """The task whose place is remembered; None while two designs stand side by side."""
        self._left: dict[str, Pose | None] = {}
        """Where a person has left the camera, by the task; None where the whole scene was asked for since."""
        self._pointed: Pose | None = None
        self._aspect = USUAL_ASPECT
        """Width / height of the browser's scene when the camera was pointed."""
        self._is_covered = True
        """Whether panels cover the sides of a usual page."""
        self._has_arrived = False
        """Whether the browser has told since that its camera is where it was pointed: what it tells before is old."""
        if isinstance(host, viser.ViserServer):
            host.on_client_connect(self._welcome)
        else:
            host.camera.on_update(lambda _: self._hear())

    def frame(self, task: str, options: object, box: Corners, *, alone: bool) -> bool:
        """Point the camera at a box, once for each task with its options, or two designs of it side by side.

        Return whether it is another box than before.
        """
        seen = task, options, tuple(box[0]), tuple(box[1])
        with self._lock:
            if seen == self._seen:
                return False
            self._seen, self._box, self._task = seen, box, task if alone else None
            self._point()
        return True

    def look_at_all(self) -> None:
        """Point the camera so that the whole scene is seen."""
        with self._lock:
            if self._task is not None:
                self._left[self._task] = None
            self._point()

    def uncover(self, uncovered: bool) -> None:
        """Use the whole width of a usual page, where no panels cover its sides, or what they leave free."""
        with self._lock:
            if uncovered == self._is_covered:
                self._is_covered = not uncovered
                self._point()

    @property
    def ticks(self) -> dict[str, Tick]:
        """Return where a person has left the camera, as it can be put back; empty where the whole scene is seen."""
        with self._lock:
            return {_PREFIX + task: pose.in_words() if pose else "" for task, pose in self._left.items()}

    def put_back(self, ticks: Mapping[str, Tick]) -> None:
        """Take on where the camera was left, for tasks of which this is not known."""
        with self._lock:
            found = {name.removeprefix(_PREFIX): words for name, words in ticks.items() if name.startswith(_PREFIX)}
            new = {task: Pose.from_words(words) for task, words in found.items() if task not in self._left}
            self._left |= new
            if self._task is not None and new.get(self._task) is not None:
                self._point()

    def _point(self) -> None:
        if self._box is None:
            return
        start, host, left = self._initial, self._host, self._left.get(self._task or "")
        if isinstance(host, viser.ViserServer):
            start.fov, (start.position, start.look_at) = FIELD_OF_VIEW, camera(*self._box)
            for client in clients_of(host):
                _aim(client, _whole(client, self._box, self._is_covered))
            return
        pose = left or _whole(host, self._box, self._is_covered)
        # viser's client goes to where it begins in its own time, so for one browser that is where it is pointed, too.
        start.fov, start.position, start.look_at = FIELD_OF_VIEW, pose.position, pose.target
        self._has_arrived = pose.is_near(Pose(host.camera.position, host.camera.look_at))
        self._pointed, self._aspect = pose, host.camera.aspect
        _aim(host, pose)

    def _hear(self) -> None:
        """Take in where a browser's camera is now."""
        assert isinstance(self._host, viser.ClientHandle)
        told = self._host.camera
        pose = Pose(told.position, told.look_at)
        with self._lock:
            if self._pointed is None or self._task is None:
                return
            if pose.is_near(self._pointed):
                self._has_arrived = True
            elif self._has_arrived:
                self._left[self._task] = pose
            if self._left.get(self._task) is None and self._has_another_shape(told.aspect):
                self._point()

    def _has_another_shape(self, aspect: float) -> bool:
        """Tell whether the page has got a shape in which the whole scene is seen from elsewhere."""
        if self._is_covered:
            return (aspect < NARROW) != (self._aspect < NARROW)
        return abs(aspect - self._aspect) > _SAME_SHAPE * self._aspect

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Point the camera of a client that has just come; that of a usual page begins where it should."""
        with self._lock:
            if self._box is not None and client.camera.aspect < NARROW:
                _aim(client, _whole(client, self._box, self._is_covered))


def _aim(client: viser.ClientHandle, pose: Pose) -> None:
    client.camera.fov, client.camera.position, client.camera.look_at = FIELD_OF_VIEW, pose.position, pose.target


def _whole(client: viser.ClientHandle, box: Corners, is_covered: bool) -> Pose:
    """Return the pose in which a client sees the whole box, whatever the shape of its page, and beside panels where it
    is covered by some."""
    aspect = client.camera.aspect
    free = _ROOMY * aspect if not is_covered else aspect if aspect < NARROW else USUAL_ASPECT
    return Pose(*camera(*box, free, is_covered=is_covered))
