"""The part of the export panel that has films and stills made: what is wished for, how far it is, and the file."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import viser

from morph_core.history import History
from studio.filming import FilmState, FilmWish
from studio.viewer import wording
from studio.viewer.once import once

_FORMATS = {"evolution": ("mp4", "gif"), "episode": ("mp4", "gif"), "still": ("svg", "png")}
_HEIGHTS = {"1920 x 1080 px": 1080, "1280 x 720 px": 720, "960 x 540 px": 540}
_USUAL = {"mp4": "1920 x 1080 px", "gif": "960 x 540 px"}


class Makes(Protocol):
    """Where films are made, one at a time for all browsers."""

    @property
    def state(self) -> FilmState:
        """Return how far the film is."""
        ...

    def start(self, wish: FilmWish) -> FilmState:
        """Begin a film. Raise ValueError with a sentence if another one is being made, or this one can't be."""
        ...

    def cancel(self) -> FilmState:
        """Give up the film that is being made."""
        ...

    def file(self, number: int) -> Path | None:
        """Return the path of a film that is ready, by its number; None where there is no such one."""
        ...


class FilmPanel:
    """Form for a film or a still of the run on screen. What is made is the same for all browsers, and shown to all."""

    def __init__(
        self, gui: viser.GuiApi, ways: viser.GuiTabGroupHandle, films: Makes, *, which: Callable[[], str]
    ) -> None:
        """Make the form in a tab of `ways`; `which` returns the design that is chosen for an export, of which an
        episode or a still is made."""
        self._films = films
        self._which = which
        self._run: str | None = None
        self._shown = FilmState()
        with ways.add_tab("Film or still", viser.Icon.MOVIE):
            self.bar = gui.add_progress_bar(0.0, visible=False)
            self.note = gui.add_html("", visible=False)
            self.cancel = gui.add_button("Cancel", icon=viser.Icon.X, color="gray", visible=False)
            self.download = gui.add_button("Download", icon=viser.Icon.DOWNLOAD, color="green", visible=False)
            self.what = gui.add_dropdown(
                "of", tuple(_FORMATS),
                hint="evolution: all designs, then an episode; episode, still: of the design that is chosen above",
            )  # fmt: skip
            self.format = gui.add_dropdown("as", _FORMATS["evolution"], hint="mp4 and gif move; svg and png are stills")
            self.size = gui.add_dropdown("size", tuple(_HEIGHTS), hint="A smaller one is ready sooner")
            self.make = gui.add_button(
                "Make the film", icon=viser.Icon.MOVIE, color="blue",
                hint="In the background, with what processor time the trainings leave; the command line offers more",
            )  # fmt: skip
        self.what.on_update(lambda _: self._offer_formats())
        self.format.on_update(lambda _: self._offer_sizes())
        self.make.on_click(once(lambda _: self.submit()))
        self.cancel.on_click(lambda _: self._give_up())
        self.download.on_click(lambda event: self.send(event.client))

    def clear(self) -> None:
        """Show no run; what is being made goes on."""
        self._run = None

    def update(self, history: History) -> None:
        """Offer films of a run, and show how far the one is that is being made."""
        self._run = history.folder.id
        self._show(self._films.state)

    def wish(self) -> FilmWish:
        """Return what the form says. Raise ValueError with the choices where that is not to be had."""
        if self._run is None:
            raise ValueError("there is no run to be filmed: start or choose one")
        what, form = str(self.what.value), self.format.value
        if what not in _FORMATS or form not in _FORMATS[what] or self.size.value not in _HEIGHTS:
            raise ValueError(f"choose one of {', '.join(_FORMATS)}, as {' or '.join(_FORMATS.get(what, ()))}")
        return FilmWish(
            run=self._run,
            format=form,  # pyright: ignore[reportArgumentType] - one of the formats, as was just asked
            design=None if what == "evolution" else self._which(),
            height=None if what == "still" else _HEIGHTS[self.size.value],  # pyright: ignore[reportArgumentType]
        )

    def submit(self) -> None:
        """Have the film made, or show why it can't be."""
        self.make.disabled = True
        self._tell("being prepared…", wording.BLUE)
        try:
            self._show(self._films.start(self.wish()))
        except (ValueError, OSError) as error:
            self._show(self._films.state)
            self._tell(str(error))
        finally:
            self.make.disabled = False

    def send(self, client: viser.ClientHandle | None) -> None:
        """Hand the film to the browser that asked for it."""
        path = self._films.file(self._shown.number)
        if client is None:
            return
        if path is None:
            self._tell("this film is not there any more: make it anew")
            return
        try:
            client.send_file_download(path.name, path.read_bytes(), save_immediately=True)
        except OSError as error:
            self._tell(f"{path.name} can't be read: {error.strerror or error}")

    def _show(self, state: FilmState) -> None:
        if state == self._shown:
            return
        self._shown = state
        making, ready = state.state == "making", state.state == "ready"
        self.bar.visible = self.cancel.visible = making
        self.bar.value = 100.0 * state.done / max(1, state.frames)
        self.bar.animated = making
        self.what.visible = self.format.visible = self.make.visible = not making  # so that the bar is in sight
        self.size.visible = not making and self.what.value != "still"
        self.download.visible = ready
        if ready:
            self.download.label = f"Download {wording.size(state.size)}"
        match state.state:
            case "failed":
                self._tell(state.reason)
            case "none":
                self.note.visible = False
            case _:
                self.note.content = wording.paragraph(_words(state))
                self.note.visible = True

    def _tell(self, sentence: str, colour: str = wording.RED) -> None:
        self.note.content = wording.alert(sentence, colour)
        self.note.visible = True

    def _give_up(self) -> None:
        self._show(self._films.cancel())

    def _offer_formats(self) -> None:
        """Offer the formats of what is chosen."""
        still = self.what.value == "still"
        self.format.options = _FORMATS.get(str(self.what.value), _FORMATS["evolution"])
        self.size.visible = not still
        self.make.label = "Make the still" if still else "Make the film"
        self._offer_sizes()

    def _offer_sizes(self) -> None:
        if self.format.value in _USUAL:
            self.size.value = _USUAL[self.format.value]


def _words(state: FilmState) -> str:
    """Return as HTML what is made, and how far it is."""
    name = f'<span style="overflow-wrap:anywhere">{wording.text(state.name)}</span>'
    if state.state == "ready":
        return f'<span style="color:{wording.GREEN};font-weight:600">✓</span> {name}'
    if state.state == "cancelled":
        return f"{name}<br>{wording.dim('cancelled')}"
    if state.wish is not None and state.wish.is_still:
        return f"{name}<br>{wording.dim('is being drawn')}"
    left = "" if state.seconds_left is None else f", about {wording.duration(state.seconds_left)} left"
    far = f"{state.done} of {state.frames} frames{left}" if state.frames else "being prepared…"
    slowly = "; slowly, as the processors are busy" if state.resting else ""
    return f"{name}<br>{wording.dim(far + slowly)}"
