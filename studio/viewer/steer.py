"""The steering form: alpha and the projection rule of a running run."""

import typing

import viser

from morph_core.catalogue import METHODS
from morph_core.config import LARGEST_ALPHA, Alpha, Projection, check_value
from morph_core.edits import TAKES_LATER_EDITS
from morph_core.history import History
from morph_core.protocol import AnyCommand, SetAlpha, SetProjection, Status
from studio.fields import docs_of
from studio.viewer import explain, wording
from studio.viewer.run import NOT_LIVE, OBEYED_LATER, Send


class SteerPanel:
    """A form for alpha and the projection rule. Edits wait for Apply; `send` is called with the commands."""

    def __init__(self, gui: viser.GuiApi, *, send: Send) -> None:
        docs = docs_of(METHODS["morph"])
        self._shown: str | None = None
        self._in_force: tuple[float, Projection] | None = None
        self.note = gui.add_html("")
        self.form = gui.add_form(None, visible=False)
        with self.form:
            self.alpha = gui.add_number("α", 1.0, min=0.0, max=LARGEST_ALPHA, step=0.1, hint=docs["alpha"])
            gui.add_html(explain.alpha())
            self.projection = gui.add_dropdown("projection", list(typing.get_args(Projection)), hint=docs["projection"])
            gui.add_html(explain.projection())
            self.apply = gui.add_button("Apply", icon=viser.Icon.CHECK, color="green")
        self.apply.on_click(lambda _: self.form.submit())
        self.form.on_submit(lambda event: send(self.commands, event.client))

    def clear(self) -> None:
        """Hide the form, as there is no run to steer."""
        self.form.visible = False
        self.note.content = wording.paragraph(wording.dim("no data yet: press Start"))

    def update(self, history: History, status: Status) -> None:
        """Show each value in force once it changes; until then, what somebody is editing stays as it is. Edits of one
        run are not those of another."""
        later = status in TAKES_LATER_EDITS
        live = status not in NOT_LIVE
        self.form.visible = live or later
        self.note.visible = not live
        if not live:
            said = OBEYED_LATER if later else "To change how it learns, branch from it (Run tab)."
            self.note.content = wording.paragraph(wording.dim(f"This run is {status}. {said}"))
        in_force = history.in_force.alpha, history.in_force.projection
        before = self._in_force if self._shown == history.folder.id else None
        self._shown, self._in_force = history.folder.id, in_force
        if before is None or before[0] != in_force[0]:
            self.alpha.value = in_force[0]
        if before is None or before[1] != in_force[1]:
            self.projection.value = in_force[1]

    def commands(self) -> list[AnyCommand]:
        """Return the commands for what was edited. Raise ValueError with a sentence if a value is not allowed."""
        alpha, projection = self.alpha.value, self.projection.value
        check_value("alpha", Alpha, alpha)
        check_value("projection", Projection, projection)
        in_force = self._in_force or (None, None)
        commands: list[AnyCommand] = [SetAlpha(alpha)] if alpha != in_force[0] else []
        return [*commands, SetProjection(projection)] if projection != in_force[1] else commands
