"""The export panel: a design of the run as files for other tools."""

from collections.abc import Callable

import viser

from morph_core.history import History
from studio.viewer import wording

CHOICES = ("best", "latest", "iteration")


class ExportPanel:
    """`on_download` is asked for "best", "latest" or an iteration's number."""

    def __init__(self, gui: viser.GuiApi, *, on_download: Callable[[str, viser.ClientHandle | None], None]) -> None:
        self._on_download = on_download
        self._history: History | None = None
        self.note = gui.add_html("")
        self.design = gui.add_dropdown("design", CHOICES, initial_value="best")
        self.iteration = gui.add_number("iteration", 0, min=0, step=1, visible=False, hint="0 is the initial design")
        self.download = gui.add_button("Download", icon=viser.Icon.DOWNLOAD, color="green")
        self.notice = gui.add_html("", visible=False)
        self.design.on_update(lambda _: self._choose())
        self.download.on_click(lambda event: self.submit(event.client))
        self.clear()

    def clear(self) -> None:
        """Show no run."""
        self._history = None
        self._show(False)
        self.note.content = wording.paragraph(wording.dim("no data yet: press Start"))

    def update(self, history: History) -> None:
        """Offer the designs of a run."""
        self._history = history
        self._show(True)
        best = history.best
        found = (
            f"best: iteration {best.iteration}, success {wording.percent(best.sampled_success)}"
            if best
            else "no evaluation yet: best is the latest"
        )
        self.note.content = wording.paragraph(f"{found}<br>latest: iteration {history.iteration}")

    def which(self) -> str:
        """Return what is chosen. Raise ValueError if there is no such design."""
        if self._history is None:
            raise ValueError("there is no run to export from: start or choose one")
        if self.design.value not in CHOICES:
            raise ValueError(f'no design "{self.design.value}"; choose from: {", ".join(CHOICES)}')
        which = str(self.iteration.value) if self.design.value == "iteration" else self.design.value
        self._history.design(which)
        return which

    def submit(self, client: viser.ClientHandle | None) -> None:
        try:
            which = self.which()
        except ValueError as error:
            self.tell(str(error))
            return
        self.tell("building the files…", wording.BLUE)
        self.download.disabled = True
        try:
            self._on_download(which, client)
        except (ValueError, OSError) as error:
            self.tell(str(error))
        else:
            self.tell(None)
        finally:
            self.download.disabled = False

    def tell(self, sentence: str | None, colour: str = wording.RED) -> None:
        self.notice.visible = sentence is not None
        self.notice.content = wording.alert(sentence, colour) if sentence else ""

    def _choose(self) -> None:
        self.iteration.visible = self.design.visible and self.design.value == "iteration"

    def _show(self, visible: bool) -> None:
        self.design.visible = self.download.visible = visible
        self._choose()
