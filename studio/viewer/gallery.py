"""The gallery: small pictures of a run's designs over its iterations, the starred ones first; a click turns to one."""

import base64
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import viser

from morph_core.history import History
from studio.cancellation import Cancellation
from studio.viewer import wording
from studio.viewer.links import Links
from studio.viewer.newest import Newest

MOST_STARRED, MOST_OTHERS = 24, 12
"""Largest number of starred designs, and of others, that are shown."""
_COLUMNS = 3
_FRAME = "text-align:center;line-height:1.3;border:1px solid #8884;border-radius:4px;padding:2px"


class Album(Protocol):
    """Pictures and stars of designs."""

    def starred(self, history: History) -> Sequence[int]:
        """Return the iterations of a run whose designs are starred."""
        ...

    def star(self, run_id: str, iteration: int, starred: bool) -> object:
        """Star a design, or take its star away; raise ValueError that says what is allowed."""
        ...

    def picture(self, history: History, phi: Sequence[float]) -> bytes:
        """Return a PNG of a design. Raise ValueError if it can't be built."""
        ...


@dataclass(frozen=True)
class Piece:
    """One design of the gallery."""

    iteration: int
    phi: tuple[float, ...]
    starred: bool
    words: str
    """Words under its picture."""


def pieces_of(history: History, starred: Sequence[int]) -> list[Piece]:
    """Return the designs of a run that its gallery shows: the starred ones first, then the initial one, the best, the
    latest, and some in between at even distances."""
    known = {history.begins_at: history.initial_phi.tolist(), **{p.iteration: p.phi for p in history.progress}}
    success = {e.iteration: e.sampled_success for e in history.evaluations}
    best = history.best
    first = [i for i in sorted(starred) if i in known][:MOST_STARRED]
    shown = [i for i in success if i in known] or list(known)  # a design that was evaluated says more
    places = np.linspace(0, len(shown) - 1, MOST_OTHERS - 3).round().astype(int)
    others = {history.begins_at, history.iteration, *(shown[i] for i in places)} | ({best.iteration} if best else set())

    def piece(iteration: int) -> Piece:
        words = [f"{wording.percent(success[iteration])} success"] if iteration in success else []
        words += ["best"] if best and iteration == best.iteration else []
        words += ["initial"] if iteration == history.begins_at else []
        return Piece(iteration, tuple(known[iteration]), iteration in first, ", ".join(words))

    return [piece(i) for i in (*first, *sorted(others - set(first)))]


class GalleryPanel:
    """The tab with the pictures of one run. They are drawn on request, as each takes a moment of the processor."""

    def __init__(
        self,
        gui: viser.GuiApi,
        tab: viser.GuiTabHandle,
        album: Album,
        *,
        on_turn: Callable[[int], None],
    ) -> None:
        """Make the panel; `on_turn` is called with the iteration of the design that was clicked on."""
        self._gui = gui
        self._album = album
        self._on_turn = on_turn
        self._drawing = Newest("viewer-gallery")
        self._lock = threading.Lock()
        self._history: History | None = None
        self._pieces: list[Piece] = []
        with tab:
            self.note = gui.add_html("")
            self.draw = gui.add_button("Draw the gallery", icon=viser.Icon.PHOTO)
            self.pictures = gui.add_html("")
            self._links = Links(gui, self._turn)
        self.draw.on_click(lambda _: self.refresh())
        self.clear()

    def clear(self) -> None:
        """Show nothing, as no run is shown."""
        self._history = None
        self._empty("no data yet: press Start")
        self.draw.visible = False

    def update(self, history: History) -> None:
        """Offer the gallery of a run."""
        another = self._history is None or self._history.record.id != history.record.id
        self._history = history
        self.draw.visible = True
        if another:
            self._empty("Pictures of this run's designs over its iterations, the starred ones first.")

    def refresh(self) -> None:
        """Draw the pictures of the run as it is now."""
        history = self._history
        if history is None:
            return
        pieces = pieces_of(history, self._album.starred(history))

        def draw(cancellation: Cancellation) -> None:
            pictures: dict[Piece, str] = {}
            for number, piece in enumerate(pieces):
                cancellation.check()
                self._say(f"drawing {number + 1} of {len(pieces)}…")
                try:
                    png = self._album.picture(history, piece.phi)
                except ValueError as error:  # a task of another version
                    self._say(f"the designs of this run can't be drawn: {error}")
                    return
                pictures[piece] = base64.b64encode(png).decode()
            with self._lock:
                cancellation.check()
                self._put(pieces, pictures)
                self._say("A click on a picture turns to its design.")

        self._drawing.put(draw)

    def stop(self) -> None:
        """End the thread that draws."""
        self._drawing.stop()

    def _empty(self, sentence: str) -> None:
        with self._lock:
            self._drawing.cancel()
            self._put([], {})
            self._say(sentence)

    def _say(self, sentence: str) -> None:
        self.note.content = wording.paragraph(wording.dim(wording.text(sentence)))

    def _put(self, pieces: list[Piece], pictures: dict[Piece, str]) -> None:
        """Show pictures; a click on one turns to its design."""
        self._pieces = pieces
        self._links.offer([_title(piece) for piece in pieces])
        self.draw.label = "Draw it anew" if pieces else "Draw the gallery"
        shown = [self._links.link(i, _picture(p, pictures[p]), _hint(p), _FRAME) for i, p in enumerate(pieces)]
        grid = f"display:grid;grid-template-columns:repeat({_COLUMNS}, 1fr);gap:6px;margin-top:0.4em"
        self.pictures.content = wording.paragraph(f'<div style="{grid}">{"".join(shown)}</div>') if pieces else ""

    def _turn(self, place: int) -> None:
        if place < len(self._pieces):
            self._on_turn(self._pieces[place].iteration)


def _picture(piece: Piece, png: str) -> str:
    """Return a picture, which is a PNG in base64, with its words below as HTML."""
    return (
        f'<img alt="design of iteration {piece.iteration}" style="width:100%;display:block" '
        f'src="data:image/png;base64,{png}">{wording.text(_words(piece))}<br>'
        f"{wording.dim(wording.text(piece.words)) or '&nbsp;'}"
    )


def _hint(piece: Piece) -> str:
    return f"turn to the design of iteration {piece.iteration}"


def _words(piece: Piece) -> str:
    return f"{'★ ' * piece.starred}iteration {piece.iteration}"


def _title(piece: Piece) -> str:
    return f"{'★ ' * piece.starred}{piece.iteration}"
