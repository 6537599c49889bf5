"""The playback panel: which of the recorded episodes is played, how, and what it is rewarded for."""

from collections.abc import Callable

import viser

from morph_core.history import History
from morph_core.protocol import Recorded, Which
from studio.viewer import wording
from studio.viewer.player import SPEEDS, Player
from studio.viewer.rewards import cursor, reward_chart, reward_legend
from studio.viewer.take import FRAMES_PER_SECOND, Take
from studio.viewer.view import Remembered

Refuse = Callable[[str, viser.ClientHandle | None], None]
_ONLY: str = "the only one recorded"


class PlaybackPanel:
    """The panel that plays an episode of the shown iteration, pauses it, and goes to a time in it."""

    def __init__(
        self,
        gui: viser.GuiApi,
        player: Player,
        *,
        on_choice: Callable[[], None],
        on_refusal: Refuse,
    ) -> None:
        """Make the panel.

        `on_choice` is called when another episode, or other things of it, are to be shown, and `on_refusal` with a
        sentence on what can't be done.
        """
        self._player = player
        self._on_choice = on_choice
        self._on_refusal = on_refusal
        self._recorded: dict[str, Recorded] = {}
        self._wanted: Which = "median"
        self._take: Take | None = None
        self._shown_time = 0.0
        self.panel = gui.add_panel()
        with self.panel.add_tab("Episode", viser.Icon.PLAYER_PLAY):
            self.none = gui.add_html("")
            self.episode = gui.add_dropdown(
                "episode", (_ONLY,), hint="By return among the episodes of this evaluation; failed: a typical failure"
            )
            self.play = gui.add_button("Pause playback", icon=viser.Icon.PLAYER_PAUSE, hint="Space or K")
            self.frame = gui.add_button_group(
                "frame", ("◂ back", "on ▸"), hint=f"One frame, 1/{FRAMES_PER_SECOND} s: , and . keys"
            )
            self.time = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0)
            self.rewards = gui.add_html("", visible=False)
            self.cursor = gui.add_html("", visible=False)
            self.terms = gui.add_html("", visible=False)
            self.speed = gui.add_slider("speed [×]", *SPEEDS, 0.1, 1.0)
            self.loop = gui.add_checkbox("loop", True)
            self.forces = gui.add_checkbox(
                "contact forces", False,
                hint="Arrows at the end of each control step: the force on the object, or by the table on the hand",
            )  # fmt: skip
        self._controls = self.play, self.frame, self.time, self.speed, self.loop
        for handle in (*self._controls, self.episode, self.forces):
            handle.visible = False
        self.episode.on_update(lambda event: self._choose(event.client) if event.client else None)
        self.play.on_click(lambda _: self.toggle_playback())
        self.frame.on_click(lambda event: self.step(-1 if event.target.value == "◂ back" else 1))
        self.time.on_update(lambda event: self._scrub(event.client) if event.client else None)
        self.speed.on_update(lambda event: self._set_speed(event.client))
        self.loop.on_update(lambda _: player.set_looping(self.loop.value))
        self.forces.on_update(lambda event: on_choice() if event.client else None)

    @property
    def remembered(self) -> dict[str, Remembered]:
        """The inputs that a browser finds again as it left them."""
        return {"speed": self.speed, "loop": self.loop, "forces": self.forces}

    def which(self, history: History, iteration: int) -> Which | None:
        """Return which of the episodes of an iteration is to be played: of the kind that was chosen, where it has one.

        None where a single one was recorded.
        """
        known: list[Which] = [recorded.which for recorded in _recorded(history, iteration)]
        return self._wanted if self._wanted in known else next(iter(known), None)

    def update(self, history: History, iteration: int) -> None:
        """Offer the episodes that an iteration of a run has recorded; the kind that was chosen before stays chosen."""
        self._recorded = {_words(recorded): recorded for recorded in _recorded(history, iteration)}
        options = tuple(self._recorded) or (_ONLY,)
        which = self.which(history, iteration)
        if tuple(self.episode.options) != options:
            self.episode.options = options
        self.episode.value = next((words for words, r in self._recorded.items() if r.which == which), options[0])

    def show_time(self, take: Take, seconds: float) -> None:
        """Show what is played and the time in it; of a body in its start posture there is nothing to play."""
        duration = take.duration
        there = duration > 0
        if take is not self._take:
            self._take = take
            self._show_rewards(take)
            self.none.content = "" if there else wording.paragraph("No episode: the body stands in its start posture.")
            self.none.visible = not there
            self.episode.visible = there and take.shot.episode is not None
            self.forces.visible = there and take.has_forces
            for handle in self._controls:
                handle.visible = there
            self.time.max = max(round(duration, 2), 0.01)
        self._shown_time = self.time.value = min(round(seconds, 2), self.time.max)
        if self.cursor.visible:
            self.cursor.content = cursor(seconds / duration if there else 0.0)

    def toggle_playback(self) -> None:
        """Pause the episode while it plays, else play it."""
        self._player.play(not self._player.playing)
        self._show_state()

    def step(self, frames: int) -> None:
        """Go so many frames on in the episode, or back where negative, and pause there."""
        self._player.step(frames)
        self._show_state()

    def _show_state(self) -> None:
        playing = self._player.playing
        self.play.label = "Pause playback" if playing else "Play"
        self.play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY

    def _show_rewards(self, take: Take) -> None:
        terms = take.reward_terms if any(len(term) for term in take.reward_terms.values()) else {}
        if terms:
            steps = len(next(iter(terms.values())))
            share = min(1.0, steps * take.control_dt / take.duration) if take.duration else 1.0
            self.rewards.content = reward_chart(terms, share)
            self.terms.content = reward_legend(terms)
        for handle in (self.rewards, self.cursor, self.terms):
            handle.visible = bool(terms)

    def _choose(self, client: viser.ClientHandle | None) -> None:
        recorded = self._recorded.get(self.episode.value)
        if recorded is None and self.episode.value != _ONLY:
            self.episode.value = next(iter(self._recorded), _ONLY)
            self._on_refusal(f"there is no such episode; choose from: {', '.join(self.episode.options)}", client)
            return
        if recorded:
            self._wanted = recorded.which
        self._on_choice()

    def _scrub(self, client: viser.ClientHandle | None) -> None:
        value = self.time.value
        if not 0 <= value <= self.time.max:
            self._on_refusal(f"the time must lie inside [0, {self.time.max:g}] s, not {value:g}", client)
            self.time.value = self._shown_time
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


def _recorded(history: History, iteration: int) -> list[Recorded]:
    """Return what the recorded episodes of an iteration came to; nothing where there is none, or a single one."""
    said = next((e for e in history.evaluations if e.iteration == iteration and e.episode), None)
    return said.recorded if said else []


def _words(recorded: Recorded) -> str:
    """Return words such as "best: return 3.20, success"."""
    outcome = "success" if recorded.success else "no success"
    return f"{recorded.which}: return {recorded.episode_return:.2f}, {outcome}".replace("-", "−")
