"""The stage: films in place of the design that is chosen, the words over the scene, and presenter's mode."""

import threading
from collections.abc import Callable

from morph_core.history import History
from studio.viewer.caption import Caption, CaptionNode, caption_of
from studio.viewer.film import LENGTH, Clip
from studio.viewer.player import Player
from studio.viewer.projector import Projector
from studio.viewer.scene import Host


class Stage:
    """What is seen of a run in short, and what is said of it over the scene. Its methods may be called from any
    thread."""

    def __init__(self, host: Host, player: Player, *, usual_speed: Callable[[], float]) -> None:
        """Show nothing; after a film, episodes are played with the usual speed."""
        self._player = player
        self._usual_speed = usual_speed
        self._lock = threading.RLock()
        self._label = self._enter = ""
        self._frame: tuple[History, int, Clip | None] | None = None
        """What the film shows now."""
        self.presents = False
        """Whether the page is in presenter's mode: large words over the scene, and no panels."""
        self.caption = CaptionNode(host)
        self.projector = Projector(player, on_frame=self._show_frame)

    @property
    def plays_film(self) -> bool:
        """Tell whether a film is played, so that the scene is not to be touched."""
        return self.projector.history is not None

    @property
    def film(self) -> tuple[History, int] | None:
        """Return the run and the iteration that a film shows now, or None while none is played."""
        frame = self._frame
        return frame[:2] if frame and self.plays_film else None

    def present(self, presents: bool) -> None:
        """Begin presenter's mode, or leave it."""
        self.presents = presents
        self._player.camera.uncover(presents)

    def play(self, history: History, label: str, enter: str) -> None:
        """Play the film of a run under a label; `enter` are words on what the key Enter does."""
        with self._lock:
            self._label, self._enter = f"{label}, shown in {LENGTH:.0f} s", enter
            self.projector.play(history)
            if self._frame and self._frame[0] is history:
                self._show_frame(*self._frame)

    def show(self, history: History, iteration: int, label: str, enter: str) -> None:
        """Play no film; write over the design of an iteration of a run."""
        with self._lock:
            self.end_film()
            self.caption.show(caption_of(history, iteration, label, presents=self.presents, enter=enter))

    def clear(self, label: str = "", enter: str = "") -> None:
        """Play no film, and write nothing but what presenter's mode needs."""
        with self._lock:
            self.end_film()
            self.caption.show(Caption(label=label, presents=True, enter=enter) if self.presents else None)

    def end_film(self) -> None:
        """Play no film; the scene stays as it is."""
        with self._lock:
            if self.plays_film:
                self.projector.stop()
                self._frame = None
                self._player.set_speed(self._usual_speed())

    def _show_frame(self, history: History, iteration: int, clip: Clip | None) -> None:
        """Write the words over what a film shows, unless it has ended since."""
        with self._lock:
            if self.projector.history is not history:
                return
            self._frame = history, iteration, clip
            self.caption.show(
                caption_of(history, iteration, self._label, presents=self.presents, enter=self._enter, clip=clip)
            )

    def stop(self) -> None:
        """End what plays."""
        self.projector.stop()
