"""The panel of a recorded run: where it comes from, and the buttons that play it, open it, and train one live."""

from collections.abc import Callable

import viser

from studio.recordings import Recording
from studio.viewer import wording
from studio.viewer.film import LENGTH

Ask = Callable[[viser.ClientHandle | None], None]


class RecordedPanel:
    """What is said of a recorded run, on the start page and where it is opened."""

    def __init__(self, gui: viser.GuiApi, *, on_play: Ask, on_open: Ask, on_live: Ask, on_present: Ask) -> None:
        """Make the panel; each function is called with the client that pressed the button."""
        self.folder = gui.add_folder("Recorded run", visible=False)
        with self.folder:
            self.about = gui.add_html("")
            self.play = gui.add_button(
                _play_words(), icon=viser.Icon.MOVIE, hint="The body and its controller as they were trained, in short"
            )
            self.live = gui.add_button(
                "Start it live", icon=viser.Icon.PLAYER_PLAY, color="green",
                hint="Trains a run of your own, with the same settings and the same seed",
            )  # fmt: skip
            self.open = gui.add_button(
                "Open it", icon=viser.Icon.FOLDER_OPEN, color="gray",
                hint="With its curves, timeline, episodes and designs; it can't be changed",
            )  # fmt: skip
            self.present = gui.add_button(
                "Presenter's mode", icon=viser.Icon.PRESENTATION, color="gray",
                hint="Large words over the scene, no panels (F; Esc leaves it)",
            )  # fmt: skip
        self._buttons = self.play, self.live, self.open, self.present
        for button, ask in zip(self._buttons, (on_play, on_live, on_open, on_present), strict=True):
            button.on_click(lambda event, ask=ask: ask(event.client))

    def show_on_start_page(self, recording: Recording, *, plays: bool) -> None:
        """Offer the recorded run of the task that is chosen, which `plays` or not."""
        seen = f"{recording.label} shown in {LENGTH:.0f} s, again and again" if plays else recording.label
        self._show(recording, seen)
        self.play.label = "Show the initial design" if plays else _play_words()
        self.play.visible, self.open.visible, self.live.visible = True, True, False

    def show_opened(self, recording: Recording) -> None:
        """Say that the run on screen is a recorded one."""
        self._show(recording, f"{recording.label}. It comes with the studio, and can be watched, not changed")
        self.play.visible, self.open.visible, self.live.visible = False, False, True

    def show_problem(self, sentence: str) -> None:
        """Say why the recorded run of the task that is chosen can't be played."""
        for button in self._buttons:
            button.visible = False
        self._tell(wording.alert(sentence, wording.AMBER))

    def hide(self) -> None:
        """Say nothing, as no recorded run is seen."""
        self.folder.visible = False

    def _show(self, recording: Recording, seen: str) -> None:
        origin = recording.origin
        trained = f"{origin.settings}; {origin.processor}; {_versions(origin.versions)}"
        more = "<br>".join(wording.text(line) for line in (origin.chosen, trained, origin.command))
        content = wording.paragraph(
            f"<b>{wording.text(seen)}</b><br>{wording.text(origin.outcome)}"
            f'<details style="opacity:0.8"><summary style="cursor:pointer">How it was made</summary>{more}</details>'
        )
        self.present.visible = True
        self._tell(content)

    def _tell(self, content: str) -> None:
        if content != self.about.content:  # what is folded out stays so
            self.about.content = content
        self.folder.visible = True


def _play_words() -> str:
    return f"See it evolve in {LENGTH:.0f} seconds"


def _versions(versions: dict[str, str]) -> str:
    return ", ".join(f"{name} {versions[name]}" for name in ("morph-studio", "mujoco", "torch") if name in versions)
