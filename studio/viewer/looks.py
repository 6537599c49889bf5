"""The looks of the scene: which designs stand beside the one in front, and what the colours of its parts mean."""

from collections.abc import Callable, Sequence

import numpy as np
import viser

from morph_core.history import History
from studio.viewer import wording
from studio.viewer.ghosts import Beside
from studio.viewer.parts import has_printed_parts, shows_parts
from studio.viewer.tint import Tint, agreement_tint, change_tint
from studio.viewer.view import Remembered

OWN, CHANGE, AGREEMENT = "those of the parts", "change since the start", "agreement of both gradients"
_TRAIL = 8
"""Largest number of earlier designs that are shown at once."""


class LooksPanel:
    """The tab that chooses what is shown beside the design in front, and its colours."""

    def __init__(self, gui: viser.GuiApi, tab: viser.GuiTabHandle, *, on_choice: Callable[[], None]) -> None:
        """Make the panel; `on_choice` is called when something else is to be shown."""
        self._shown = ""
        self._has_printed_parts = True
        with tab:
            self.printed = gui.add_checkbox(
                "printed parts", True, hint="What is exported to be printed; otherwise the simulated collision shapes"
            )
            self.colours = gui.add_dropdown(
                "colours", (OWN, CHANGE, AGREEMENT),
                hint="Of the robot's parts: by how far their parameters have come, or by whether the gradients of the "
                "task and of the hardware pull them the same way",
            )  # fmt: skip
            self.beside_it = gui.add_html(wording.paragraph(wording.dim("Beside the design, as ghosts:")))
            self.ghost = gui.add_checkbox("initial design", True, hint="As a ghost behind the shown one")
            self.trail = gui.add_checkbox("earlier designs", False, hint=f"Up to {_TRAIL} designs on the way here")
            self.explored = gui.add_checkbox(
                "explored designs", False,
                hint="Up to 64 of the designs that episodes were run with, at the last recorded episode up to here",
            )  # fmt: skip
            self.generation = gui.add_checkbox(
                "CMA-ES generation", False,
                hint="Designs of the last generation of the last search for φ, at the last recorded episode up to here",
            )  # fmt: skip
        self._choices = (self.printed, self.colours, self.ghost, self.trail, self.explored, self.generation)
        for handle in self._choices:
            handle.on_update(lambda _: on_choice())
        self._shown_of_a_run = (*self._choices, self.beside_it)
        self.clear()

    @property
    def remembered(self) -> dict[str, Remembered]:
        """The inputs that a browser finds again as it left them."""
        return {
            "colours": self.colours, "ghost": self.ghost, "trail": self.trail, "explored": self.explored,
            "generation": self.generation,
        }  # fmt: skip

    def clear(self) -> None:
        """Offer nothing, as no run is shown."""
        for handle in self._shown_of_a_run:
            handle.visible = False

    def update(self, history: History) -> None:
        """Offer what can be shown of a run."""
        if self._shown != history.record.id:
            self._shown = history.record.id
            self.printed.value = shows_parts(history.record.parameters)
            self._has_printed_parts = has_printed_parts(history)
        for handle in self._shown_of_a_run:
            handle.visible = handle is not self.printed or self._has_printed_parts

    def tint(self, history: History, iteration: int, phi: np.ndarray) -> Tint | None:
        """Return the colours of the parts of design `phi` (d,) at an iteration; None for those that they have."""
        if self.colours.value == CHANGE:
            return change_tint(history, phi)
        return agreement_tint(history, iteration) if self.colours.value == AGREEMENT else None

    def beside(self, history: History, iteration: int) -> Beside:
        """Return the designs that are to stand beside that of an iteration."""
        recorded = [e.iteration for e in history.evaluations if e.episode and e.iteration <= iteration]
        tried = recorded and (self.explored.value or self.generation.value)
        return Beside(
            trail=_way(history, iteration) if self.trail.value else (),
            tried_in=(history.folder, recorded[-1]) if tried else None,
            explored=self.explored.value,
            generation=self.generation.value,
        )


def _way(history: History, iteration: int) -> tuple[tuple[float, ...], ...]:
    """Return designs on the way to an iteration; they stay the same for many iterations, so that few are built anew."""
    before: Sequence[list[float]] = [p.phi for p in history.progress if p.iteration < iteration]
    stride = 1
    while len(before) > _TRAIL * stride:
        stride *= 2
    return tuple(tuple(phi) for phi in before[::stride])
