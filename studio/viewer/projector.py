"""The projector: it plays the film of a run in the scene, again and again."""

import threading
from collections.abc import Callable

from morph_core.history import History
from studio.viewer.evolution import Evolution
from studio.viewer.film import LENGTH, Clip, Film
from studio.viewer.player import Player
from studio.viewer.take import Shot


class Projector:
    """What plays a film. Its methods may be called from any thread."""

    def __init__(self, player: Player, *, on_frame: Callable[[History, int, Clip | None], None]) -> None:
        """Play nothing yet; `on_frame(history, iteration, clip)` is called whenever something else is seen."""
        self._player = player
        self._on_frame = on_frame
        self._lock = threading.Lock()
        self._history: History | None = None
        self._film: Film | None = None
        self._place = 0.0
        self._seen: tuple[int, Clip | None] | None = None
        self._evolution = Evolution(self._go_on)
        self._evolution.set_pace(1.0)  # a second of the film in a second

    @property
    def history(self) -> History | None:
        """Return the run whose film is played; None where none is."""
        return self._history

    def play(self, history: History) -> None:
        """Play the film of a run from its beginning, unless it is the one that is played."""
        with self._lock:
            known = self._history
            if known and known.folder == history.folder and self._film and self._film.latest == history.iteration:
                return
            self._history, self._film, self._place, self._seen = history, Film(history), 0.0, None
        self._player.play(True)
        self._evolution.play()

    def stop(self) -> None:
        """Play no film; the scene stays as it is."""
        with self._lock:
            self._history = self._film = None
        self._evolution.pause()

    def _go_on(self, seconds: float) -> bool:
        with self._lock:
            history, film = self._history, self._film
            if history is None or film is None:
                return False
            self._place = (self._place + seconds) % LENGTH
            seen = film.iteration_at(self._place), film.clip_at(self._place)
            if seen == self._seen:
                return True
            self._seen = seen
            iteration, clip = seen
            self._player.show(_shot(history, iteration, clip))
            if clip:
                self._player.set_speed(clip.speed)
                self._player.seek(0.0)
        self._on_frame(history, iteration, clip)
        return True


def _shot(history: History, iteration: int, clip: Clip | None) -> Shot:
    """Return what is to be seen of a design in a film: it plays its episode, or it stands in its start posture.

    It shows the collision shapes: to draw printed parts takes so long that a body could not change smoothly.
    """
    record = history.record
    _, phi = history.design(str(iteration))
    return Shot(
        task=record.task,
        task_options=tuple(sorted(record.task_options.items())),
        phi=tuple(phi.tolist()),
        episode=(history.folder, clip.iteration) if clip else None,
        ghost=tuple(history.initial_phi.tolist()) if iteration > history.begins_at else None,
    )
