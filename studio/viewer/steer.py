"""The steering form: alpha and the projection rule of a running run."""

import typing

import viser

from morph_core.config import NotNegative, Projection, check_value
from morph_core.history import History
from morph_core.protocol import Acknowledged, AnyCommand, SetAlpha, SetProjection, Status
from studio.viewer.run import NOT_LIVE, Send


class SteerPanel:
    """A form for alpha and the projection rule. Edits wait for Apply; `send` is called with the commands."""

    def __init__(self, gui: viser.GuiApi, *, send: Send) -> None:
        self._in_force: tuple[float, str] | None = None
        self.form = gui.add_form("Algorithm", visible=False)
        with self.form:
            self.alpha = gui.add_number("α", 1.0, min=0.0, step=0.1, hint="Weight of the divergence in Eq. 2")
            self.projection = gui.add_dropdown("projection", list(typing.get_args(Projection)))
            self.apply = gui.add_button("Apply", icon=viser.Icon.CHECK, color="green")
        self.apply.on_click(lambda _: self.form.submit())
        self.form.on_submit(lambda event: send(self.commands, event.client))

    def clear(self) -> None:
        """Hide the form, as there is no run to steer."""
        self.form.visible = False

    def update(self, history: History, status: Status) -> None:
        """Show the values in force once they change; until then, what somebody is editing stays as it is."""
        self.form.visible = status not in NOT_LIVE
        in_force = _in_force(history)
        if in_force != self._in_force:
            self._in_force = in_force
            self.alpha.value = in_force[0]
            if in_force[1] in typing.get_args(Projection):
                self.projection.value = in_force[1]

    def commands(self) -> list[AnyCommand]:
        """Return the commands for what was edited. Raise ValueError with a sentence if a value is not allowed."""
        alpha, projection = self.alpha.value, self.projection.value
        check_value("alpha", NotNegative, alpha)
        check_value("projection", Projection, projection)
        in_force = self._in_force or (None, None)
        commands: list[AnyCommand] = [SetAlpha(alpha)] if alpha != in_force[0] else []
        return [*commands, SetProjection(projection)] if projection != in_force[1] else commands


def _in_force(history: History) -> tuple[float, str]:
    """Return alpha and the projection rule: what the last iteration used, or was accepted since."""
    alpha, projection = history.record.config.get("alpha"), history.record.config.get("projection")
    since = 0
    if history.progress:
        last = history.progress[-1]
        alpha = alpha if last.alpha is None else last.alpha
        projection, since = last.projection or projection, last.seq
    for event in history.acknowledged:
        match event:
            case Acknowledged(accepted=True, command=SetAlpha(alpha=value)) if event.seq > since:
                alpha = value
            case Acknowledged(accepted=True, command=SetProjection(projection=rule)) if event.seq > since:
                projection = rule
    return float(alpha) if isinstance(alpha, int | float) else 1.0, str(projection)
