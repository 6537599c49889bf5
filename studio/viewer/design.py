"""The design panel: bounds and locks of every design parameter, edited together and sent together."""

from collections.abc import Sequence

import viser

from morph_core.design import DesignSpace
from morph_core.edits import TAKES_LATER_EDITS
from morph_core.history import History
from morph_core.protocol import AnyCommand, Parameter, Status
from studio.viewer import wording
from studio.viewer.bounds import BoundsForm, Group, Row
from studio.viewer.parts import unit_of
from studio.viewer.run import NOT_LIVE, OBEYED_LATER, Send


class DesignPanel:
    """A form with one row for each parameter of the run's design space; `send` is called with its commands."""

    def __init__(self, gui: viser.GuiApi, *, send: Send) -> None:
        self._gui = gui
        self._send = send
        self._names: tuple[str, ...] = ()
        self._shown: str | None = None
        self._form: viser.GuiFormHandle | None = None
        self._bounds: BoundsForm | None = None
        self.note = gui.add_html(wording.paragraph(wording.dim("no data yet: press Start")))
        self.holder = gui.add_folder(None, visible=False)
        self._buttons: tuple[viser.GuiButtonHandle, ...] = ()

    @property
    def rows(self) -> dict[str, Row]:
        """Return the inputs of each parameter, by its name."""
        return self._bounds.rows if self._bounds else {}

    @property
    def groups(self) -> Sequence[Group]:
        """Return the folders of the parts, in which the inputs stand."""
        return self._bounds.groups if self._bounds else ()

    def clear(self) -> None:
        """Hide the form, as there is no run to show."""
        self.note.content = wording.paragraph(wording.dim("no data yet: press Start"))
        self.holder.visible = False

    def update(self, history: History, status: Status) -> None:
        """Show a run's present design; inputs that somebody is editing stay as they are, but not for another run."""
        space, phi = history.design_space, history.phi
        if self._bounds is None or tuple(space.names) != self._names:
            self._bounds = self._build(space)
        self.holder.visible = True
        live, later = status not in NOT_LIVE, status in TAKES_LATER_EDITS
        said = "Edits are sent together by Apply and hold from the next iteration on."
        if not live:
            others = OBEYED_LATER if later else "To change its design, branch from it (Run tab)."
            said = f"This run is {status}. {others}"
        self.note.content = wording.paragraph(wording.dim(said))
        for button in self._buttons:
            button.visible = live or later
        words = {
            p.name: (p, float(value), float(initial))
            for p, value, initial in zip(space.parameters, phi, history.initial_phi, strict=True)
        }
        for group in self._bounds.groups:
            _tell(group, [words[name] for name in group.words])
        self._bounds.show(space, phi)
        if self._shown != history.folder.id:
            self._shown = history.folder.id
            self._bounds.discard()

    def commands(self) -> list[AnyCommand]:
        """Return the commands for what was edited. Raise ValueError with a sentence if a value is not allowed."""
        return self._bounds.edited()[0] if self._bounds else []

    def _build(self, space: DesignSpace) -> BoundsForm:
        """Make the rows: once for a task, again only when a run of another task is opened."""
        if self._form is not None:
            self._form.remove()
        gui = self._gui
        with self.holder:
            self._form = gui.add_form(None)
            with self._form:
                bounds = BoundsForm(gui, space)
                apply = gui.add_button("Apply", icon=viser.Icon.CHECK, color="green")
                reset = gui.add_button("Discard edits", icon=viser.Icon.ARROW_BACK_UP)
        form = self._form
        self._buttons = (apply, reset)
        apply.on_click(lambda _: form.submit())
        form.on_submit(lambda event: self._send(self.commands, event.client))
        reset.on_click(lambda _: bounds.discard())
        self._names = tuple(space.names)
        return bounds


def _tell(group: Group, present: Sequence[tuple[Parameter, float, float]]) -> None:
    """Say what the parameters of a part are at present, and were at first: in the folder's label, and where they are
    several, at length inside of it."""
    at_length = [
        f"{p.name}: {_in_words(p, now)}{_lock(p)} (initially {_in_words(p, first)})" for p, now, first in present
    ]
    if len(present) == 1:
        group.folder.label = at_length[0]
        return
    in_short = ", ".join(f"{group.words[p.name]} {unit_of(p).words(now)}{_lock(p)}" for p, now, _ in present)
    group.folder.label = f"{group.name}: {in_short}"
    group.told.content = wording.paragraph("<br>".join(map(wording.text, at_length)))
    group.told.visible = True


def _lock(p: Parameter) -> str:
    return ", locked" if p.locked_at is not None else ""


def _in_words(p: Parameter, value: float) -> str:
    """Return a value in words, such as "2.000 m" or "3.0°": as finely as its inputs take it."""
    unit = unit_of(p)
    if unit.factor != 1:
        return unit.words(value)
    return f"{round(value, 3) + 0.0:.3f} {p.unit}".rstrip().replace("-", "−")
