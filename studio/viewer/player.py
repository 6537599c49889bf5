"""The one thread that writes the scene: it builds what is asked for and plays it in a loop."""

import logging
import threading
import time
from collections.abc import Callable

import numpy as np

from studio.cancellation import Cancellation
from studio.seldom import Seldom
from studio.viewer.camera import Camera
from studio.viewer.figure import Figure
from studio.viewer.ghosts import Beside, Crowd, make_crowd
from studio.viewer.newest import Newest
from studio.viewer.scene import (
    FORCE_COLOUR,
    GHOST_COLOURS,
    Arrows,
    Host,
    Layer,
    Letters,
    Ruler,
    clients_of,
)
from studio.viewer.take import FRAMES_PER_SECOND, Second, Shot, Take, make_take

SPEEDS = (0.1, 4.0)
_HOLD = 1.0
"""Seconds for which the last frame stays before the loop begins again."""
_IDLE = 0.25
"""Seconds between two looks for a browser while nobody watches."""
_NO_ARROWS = np.zeros((0, 2, 3), np.float32)

log = logging.getLogger(__name__)


class Player:
    """The player of the scene. Its methods may be called from any thread; a thread of its own draws."""

    def __init__(self, host: Host, *, on_time: Callable[[float, float], None], on_error: Callable[[str], None]) -> None:
        """Start the thread that draws.

        `on_time(seconds, duration)` is called a few times a second with the time in the episode, `on_error` with a
        sentence on what can't be shown.
        """
        self._host = host
        self._trouble = Seldom(log)
        self._on_time = on_time
        self._on_error = on_error
        self._robot = Layer(host, "robot")
        self._objects = Layer(host, "objects")
        self._scenery = Layer(host, "scenery")
        self._ghost = Layer(host, "ghost", opacity=0.55)
        self._beside = {
            "trail": Layer(host, "trail", opacity=0.45),
            "explored": Layer(host, "explored", opacity=0.35),
            "generation": Layer(host, "generation", opacity=0.35),
        }
        self._crowding = Newest("viewer-ghosts")
        self._crowd: Crowd | None = None
        self._crowd_of: tuple[str, str, Beside] | None = None
        self._contact = Layer(host, "contact")
        self._forces = Arrows(host, "forces", FORCE_COLOUR)
        self._second_robot = Layer(host, "second_robot", opacity=0.75)
        self._second_objects = Layer(host, "second_objects", opacity=0.75)
        self._second_scenery = Layer(host, "second_scenery")
        self._letters = Letters(host, "letters", ("A", "B"))
        self._ruler = Ruler(host)
        self.camera = Camera(host)
        self._change = threading.Condition()
        self._shot: Shot | None = None
        self._take: Take | None = None
        self._built: Shot | None = None
        self._done: Shot | None = None
        self._painted: dict[Layer, np.ndarray] = {}
        self._time = 0.0
        self._drawn = -1
        self._sought = False
        self._playing = True
        self._looping = True
        self._speed = 1.0
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="viewer-player", daemon=True)
        self._thread.start()

    @property
    def take(self) -> Take | None:
        """Return what is in the scene now, or None before the first shot."""
        return self._take

    @property
    def time(self) -> float:
        """Return the time in the episode, in seconds; 0 without one."""
        return min(self._time, self._take.duration) if self._take else 0.0

    @property
    def node_names(self) -> list[str]:
        """Return the sorted names of the nodes that the scene has."""
        ghosts = (self._ghost, *self._beside.values())
        second = (self._second_robot, self._second_objects, self._second_scenery)
        layers = (self._robot, self._objects, self._scenery, *ghosts, self._contact, *second)
        return sorted(name for layer in layers for name in layer.node_names)

    @property
    def playing(self) -> bool:
        """Tell whether the episode plays; otherwise it is paused."""
        return self._playing

    def show(self, shot: Shot) -> None:
        """Ask for a shot to be shown; of several requests the newest one counts."""
        with self._change:
            if shot != self._shot:
                self._shot = shot
                self._change.notify_all()

    def wait(self, seconds: float) -> None:
        """Wait until what was asked for is shown, or can't be, for at most so many seconds."""
        with self._change:
            self._change.wait_for(lambda: self._done == self._shot, seconds)

    def play(self, playing: bool) -> None:
        """Play the episode, from its start if it has ended, or pause it."""
        with self._change:
            self._playing = playing
            if playing and self._take and not self._looping and self._time >= self._take.duration:
                self._time = 0.0
            self._change.notify_all()

    def seek(self, seconds: float) -> None:
        """Go to a time in the episode, in seconds."""
        with self._change:
            self._time, self._sought = max(0.0, seconds), True
            self._change.notify_all()

    def step(self, frames: int) -> None:
        """Go so many frames on, or back where negative, and stay there."""
        with self._change:
            if self._take:
                frame = min(max(self._instant() + frames, 0), self._take.last_frame)
                self._playing, self._time, self._sought = False, frame / FRAMES_PER_SECOND, True
                self._change.notify_all()

    def set_speed(self, speed: float) -> None:
        """Set the speed as a multiple of real time, kept within `SPEEDS`."""
        self._speed = min(max(speed, SPEEDS[0]), SPEEDS[1])

    def set_looping(self, looping: bool) -> None:
        """Set whether the episode begins again after its end."""
        self._looping = looping

    def stop(self) -> None:
        """End the threads that draw and build; wait for each for at most five seconds."""
        self._crowding.stop()
        with self._change:
            self._stopping = True
            self._change.notify_all()
        self._thread.join(timeout=5.0)

    def _run(self) -> None:
        before, reported = time.monotonic(), 0.0
        while not self._stopping:
            with self._change:
                changed = self._shot != self._built
                if not changed and not self._sought and self._crowd is None:
                    next_frame = before + 1 / FRAMES_PER_SECOND - time.monotonic()
                    self._change.wait(max(0.0, next_frame) if self._moving() else _IDLE)
                shot, sought, self._sought = self._shot, self._sought, False
            now = time.monotonic()
            elapsed, before = now - before, now
            try:
                if shot is not None and shot != self._built:
                    self._built = shot
                    try:
                        self._put_up(make_take(shot))
                        self._draw()
                    finally:
                        with self._change:
                            self._done = shot
                            self._change.notify_all()
                    self._gather(shot)
                    reported = 0.0
                elif self._moving() or sought:
                    if not sought:
                        self._advance(elapsed)
                    self._draw()
                self._show_crowd()
                if self._take and (now - reported > 0.2 or sought):
                    reported = now
                    self._on_time(min(self._time, self._take.duration), self._take.duration)
            except Exception as error:  # the thread must outlive a damaged episode or a task that fails to build
                self._trouble.warn("the scene could not be drawn", traceback=True)
                self._on_error(f"this design can't be shown: {error}")

    def _moving(self) -> bool:
        return bool(self._playing and self._take and self._take.duration > 0 and clients_of(self._host))

    def _advance(self, elapsed: float) -> None:
        if self._take is None:
            return
        end = self._take.duration + (_HOLD * self._speed if self._looping else 0.0)
        self._time += min(elapsed, 0.1) * self._speed
        if self._time > end:
            self._time = 0.0 if self._looping else self._take.duration

    def _put_up(self, take: Take) -> None:
        """Replace the scene's content; a design that follows another starts where that one was in its episode."""
        self._frame(take)
        self._take, self._drawn = take, -1
        if self._time > take.duration:
            self._time = 0.0
        with self._host.atomic():
            self._scenery.show(take.scenery)
            self._objects.show(take.objects, self._instant_of(take))
            self._robot.show(take.robot, self._instant_of(take))
            self._contact.show(take.markers, self._instant_of(take))
            self._put_up_second(take.second)
            self._ghost.show(take.ghost, 0, _plain(take.ghost, "ghost"))
        self._painted = {self._scenery: take.scenery.colours, self._objects: take.objects.colours}

    def _gather(self, shot: Shot) -> None:
        """Let the designs that stand beside the shown one be built, unless they stand there already."""
        wanted = shot.task, shot.options, shot.beside
        if wanted == self._crowd_of:
            return
        self._crowd_of = wanted

        def build(cancellation: Cancellation) -> None:
            try:
                crowd = make_crowd(*wanted, cancellation)
            except ValueError as error:
                crowd = Crowd()
                self._on_error(f"the designs beside this one can't be shown: {error}")
            with self._change:
                cancellation.check()
                self._crowd = crowd
                self._change.notify_all()

        if shot.beside == Beside():
            self._crowding.cancel()
            self._crowd = Crowd()
        else:
            self._crowding.put(build)

    def _show_crowd(self) -> None:
        """Put up the designs that have been built since the last look."""
        with self._change:
            crowd, self._crowd = self._crowd, None
        if crowd is not None:
            with self._host.atomic():
                for name, layer in self._beside.items():
                    figure = getattr(crowd, name)
                    layer.show(figure, 0, _plain(figure, name))

    def _put_up_second(self, second: Second | None) -> None:
        """Replace the second of two designs, and the letters above both where they stand side by side."""
        frame = self._instant_of(second) if second else 0
        self._second_robot.show(second.robot if second else None, frame)
        self._second_objects.show(second.objects if second else None, frame)
        self._second_scenery.show(second.scenery if second else None)
        self._letters.show(second.letters if second and second.scenery is not None else None)

    def _frame(self, take: Take) -> None:
        """Lay the ruler and point the camera, where they are not yet for what is to be seen."""
        if self.camera.frame(take.shot.task, take.shot.task_options, take.box, alone=take.second is None):
            self._ruler.show(take.floor, take.box)

    def _instant(self) -> int:
        return min(round(self._time * FRAMES_PER_SECOND), self._take.last_frame) if self._take else 0

    def _instant_of(self, episode: Take | Second) -> int:
        """Return the frame in which one of two episodes is now; the shorter one stays at its end."""
        return min(self._instant(), episode.frames - 1)

    def _draw(self) -> None:
        """Draw the frame that it is time for, unless it stands there already, and send it at once."""
        take, instant = self._take, self._instant()
        if take is None or instant == self._drawn:
            return
        self._drawn = instant
        frame = self._instant_of(take)
        with self._host.atomic():  # robot, lights and contact markers belong to one instant
            self._robot.pose(frame)
            self._objects.pose(frame)
            if take.second:
                self._second_robot.pose(self._instant_of(take.second))
                self._second_objects.pose(self._instant_of(take.second))
            self._paint(self._scenery, take.scenery_colours(frame))
            self._paint(self._objects, take.object_colours(frame))
            self._contact.pose(frame)
            self._forces.show(take.forces.at(frame) if take.forces else _NO_ARROWS, take.arrow_radius)
        self._host.flush()  # else viser waits for as long as a frame lasts, and every few frames two become one

    def _paint(self, layer: Layer, colours: np.ndarray) -> None:
        painted = self._painted.get(layer, colours)
        if colours is not painted and not np.array_equal(colours, painted):
            layer.paint(colours)
        self._painted[layer] = colours


def _plain(figure: Figure | None, layer: str) -> np.ndarray | None:
    return np.tile(np.array(GHOST_COLOURS[layer], np.uint8), (len(figure), 1)) if figure else None
