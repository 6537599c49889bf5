"""The playback panel: how the shown episode is played."""

from collections.abc import Callable

import viser

from studio.viewer.player import SPEEDS, Player
from studio.viewer.view import Remembered


class PlaybackPanel:
    """The panel that plays the shown episode, pauses it, goes to a time in it, and sets its speed."""

    def __init__(
        self,
        gui: viser.GuiApi,
        tab: viser.GuiTabHandle,
        player: Player,
        *,
        on_refusal: Callable[[str, viser.ClientHandle | None], None],
    ) -> None:
        """Make the panel; `on_refusal` is called with a sentence on what can't be done."""
        self._player = player
        self._on_refusal = on_refusal
        with tab:
            self.play = gui.add_button("Pause playback", icon=viser.Icon.PLAYER_PAUSE, hint="Space or K")
            self.time = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0)
            self.speed = gui.add_slider("speed [×]", *SPEEDS, 0.1, 1.0)
            self.loop = gui.add_checkbox("loop", True)
        self.play.on_click(lambda _: self.toggle_playback())
        self.time.on_update(lambda event: self._scrub(event.client) if event.client else None)
        self.speed.on_update(lambda event: self._set_speed(event.client))
        self.loop.on_update(lambda _: player.set_looping(self.loop.value))

    @property
    def remembered(self) -> dict[str, Remembered]:
        """The inputs that a browser finds again as it left them."""
        return {"speed": self.speed, "loop": self.loop}

    def show_time(self, seconds: float, duration: float) -> None:
        """Set the time slider to `seconds` of an episode of `duration` seconds; hide it where there is none."""
        for handle in (self.play, self.time, self.speed, self.loop):
            handle.visible = duration > 0
        self.time.max = max(round(duration, 2), 0.01)
        self.time.value = round(seconds, 2)

    def toggle_playback(self) -> None:
        """Pause the episode while it plays, else play it."""
        playing = not self._player.playing
        self._player.play(playing)
        self.play.label = "Pause playback" if playing else "Play"
        self.play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY

    def _scrub(self, client: viser.ClientHandle | None) -> None:
        value = self.time.value
        if not 0 <= value <= self.time.max:
            self._on_refusal(f"the time must lie inside [0, {self.time.max:g}] s, not {value:g}", client)
            return
        if self._player.playing:
            self.toggle_playback()
        self._player.seek(value)

    def _set_speed(self, client: viser.ClientHandle | None) -> None:
        value = self.speed.value
        if not SPEEDS[0] <= value <= SPEEDS[1]:
            self.speed.value = 1.0
            self._player.set_speed(1.0)
            self._on_refusal(f"the speed must lie inside [{SPEEDS[0]:g}, {SPEEDS[1]:g}] ×, not {value:g}", client)
            return
        self._player.set_speed(value)
