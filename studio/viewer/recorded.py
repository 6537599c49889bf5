"""The panel of a recorded run: where it comes from, and the buttons that play it, open it, and train one live."""

from collections.abc import Callable

import viser

from studio.recordings import Recording
from studio.viewer import wording
from studio.viewer.film import LENGTH

Ask = Callable[[viser.ClientHandle | None], None]
Film = Callable[[bool], None]


class RecordedPanel:
    """What is said of a recorded run, on the start page and where it is opened."""

    def __init__(self, gui: viser.GuiApi, *, on_film: Film, on_open: Ask, on_live: Ask, on_present: Ask) -> None:
        """Make the panel; `on_film(plays)` is called when the film is to be played or not, the others with the client
        that pressed their button."""
        self._ways = {
            "initial design": lambda _: on_film(False), "open it": on_open, "present it": on_present,
        }  # fmt: skip
        self.folder = gui.add_folder("Recorded run", visible=False)
        with self.folder:
            self.about = gui.add_html("")
            self.live = gui.add_button(
                "Start it live", icon=viser.Icon.PLAYER_PLAY, color="green",
                hint="Trains a run of your own; on the start page as the form says, else with the same seed",
            )  # fmt: skip
            self.play = gui.add_button(
                f"See it evolve in {LENGTH:.0f} seconds", icon=viser.Icon.MOVIE,
                hint="The body and its controller as they were trained, in short",
            )  # fmt: skip
            self.ways = gui.add_button_group(
                "instead", tuple(self._ways),
                hint="Open it: with its curves, timeline, episodes and designs. Present it: large words, no panels (F)",
            )  # fmt: skip
        self.live.on_click(lambda event: on_live(event.client))
        self.play.on_click(lambda _: on_film(True))
        self.ways.on_click(lambda event: self._ways[event.target.value](event.client))

    def show_on_start_page(self, recording: Recording, *, plays: bool) -> None:
        """Offer the recorded run of the task that is chosen, which `plays` or not."""
        seen = f"{recording.label}, shown in {LENGTH:.0f} s, again and again" if plays else recording.label
        self._show(recording, seen)
        self.play.visible, self.ways.visible, self.live.visible = not plays, plays, plays

    def show_opened(self, recording: Recording) -> None:
        """Say that the run on screen is a recorded one."""
        self._show(recording, f"{recording.label}. It comes with the studio, and can be watched, not changed")
        self.play.visible, self.ways.visible, self.live.visible = False, False, True

    def show_problem(self, sentence: str) -> None:
        """Say why the recorded run of the task that is chosen can't be played."""
        for handle in (self.live, self.play, self.ways):
            handle.visible = False
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
        self._tell(content)

    def _tell(self, content: str) -> None:
        if content != self.about.content:  # what is folded out stays so
            self.about.content = content
        self.folder.visible = True


def _versions(versions: dict[str, str]) -> str:
    return ", ".join(f"{name} {versions[name]}" for name in ("morph-studio", "mujoco", "torch") if name in versions)
