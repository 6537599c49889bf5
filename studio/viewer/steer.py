"""The steering form: alpha and the projection rule of a running run."""

import typing
from collections.abc import Sequence

import viser

from morph_core.config import Projection, check_field
from morph_core.history import History
from morph_core.protocol import AnyCommand, SetAlpha, SetProjection, Status
from studio.viewer.run import ENDED, Send, log_of


class SteerPanel:
    """Edits are staged until Apply; `send` takes the commands."""

    def __init__(self, gui: viser.GuiApi, *, send: Send) -> None:
        self._in_force: tuple[float, str] | None = None
        self.log = gui.add_html("", visible=False)
        self.form = gui.add_form("Algorithm", visible=False)
        with self.form:
            self.alpha = gui.add_number("α", 1.0, min=0.0, step=0.1, hint="Weight of the divergence in Eq. 2")
            self.projection = gui.add_dropdown("projection", list(typing.get_args(Projection)))
            self.apply = gui.add_button("Apply", icon=viser.Icon.CHECK, color="green")
        self.apply.on_click(lambda _: self.form.submit())
        self.form.on_submit(lambda event: send(self.commands, event.client))

    def clear(self) -> None:
        """Show no run."""
        self.form.visible = self.log.visible = False

    def update(self, history: History, status: Status, pending: Sequence[AnyCommand]) -> None:
        """Take over what is in force, once it changes: what somebody is editing stays as it is."""
        self.form.visible = status not in ENDED
        self.log.content = log_of(history, status, pending)
        self.log.visible = bool(self.log.content)
        progress = history.progress[-1] if history.progress else None
        config = history.record.config
        alpha = progress.alpha if progress and progress.alpha is not None else config.get("alpha")
        projection = progress.projection if progress and progress.projection else config.get("projection")
        in_force = (float(alpha) if isinstance(alpha, int | float) else 1.0, str(projection))
        if in_force != self._in_force:
            self._in_force = in_force
            self.alpha.value = in_force[0]
            if in_force[1] in typing.get_args(Projection):
                self.projection.value = in_force[1]

    def commands(self) -> list[AnyCommand]:
        """Return what the form changes. Raise ValueError with a sentence if a value is not allowed."""
        alpha, projection = self.alpha.value, self.projection.value
        check_field("alpha", alpha)
        check_field("projection", projection)
        in_force = self._in_force or (None, None)
        commands: list[AnyCommand] = [SetAlpha(alpha)] if alpha != in_force[0] else []
        return [*commands, SetProjection(projection)] if projection != in_force[1] else commands
