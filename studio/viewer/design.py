"""The design panel: bounds and locks of every design parameter, edited together and sent together."""

from dataclasses import dataclass

import numpy as np
import viser

from morph_core.design import DesignSpace
from morph_core.history import History
from morph_core.protocol import AnyCommand, Lock, Parameter, SetBound, Status, Unlock
from studio.viewer import wording
from studio.viewer.run import ENDED, Send


@dataclass
class _Row:
    """The inputs of one parameter."""

    folder: viser.GuiFolderHandle
    bounds: viser.GuiVector2Handle
    locked: viser.GuiCheckboxHandle
    value: viser.GuiNumberHandle[float]
    shown: Parameter


class DesignPanel:
    """One row for each parameter of the run's design space; `send` takes the commands."""

    def __init__(self, gui: viser.GuiApi, *, send: Send) -> None:
        self._gui = gui
        self._send = send
        self._names: tuple[str, ...] = ()
        self._space: DesignSpace | None = None
        self._phi = np.zeros(0)
        self._form: viser.GuiFormHandle | None = None
        self.rows: dict[str, _Row] = {}
        self.note = gui.add_html(wording.paragraph(wording.dim("no data yet: press Start")))
        self.holder = gui.add_folder("Bounds and locks", visible=False)
        self._buttons: tuple[viser.GuiButtonHandle, ...] = ()

    def clear(self) -> None:
        """Show no run."""
        self.note.content = wording.paragraph(wording.dim("no data yet: press Start"))
        self.holder.visible = False

    def update(self, history: History, status: Status) -> None:
        """Show a run's present design; inputs that somebody is editing stay as they are."""
        space, phi = history.design_space, history.phi
        if tuple(space.names) != self._names:
            self._build(space)
        self._space, self._phi = space, phi
        self.holder.visible = True
        live = status not in ENDED
        self.note.content = wording.paragraph(
            wording.dim(
                "Edits are sent together by Apply and hold from the next iteration on."
                if live
                else f"This run is {status}: its design can't be changed now."
            )
        )
        for button in self._buttons:
            button.visible = live
        for p, value, initial in zip(space.parameters, phi, history.initial_phi, strict=True):
            row = self.rows[p.name]
            lock = ", locked" if p.locked_at is not None else ""
            row.folder.label = f"{p.name}: {value:.3f} {p.unit}{lock} (initially {initial:.3g} {p.unit})"
            if p != row.shown:
                self._fill(row, p)

    def commands(self) -> list[AnyCommand]:
        """Return what the form changes. Raise ValueError with a sentence if a value is not allowed."""
        if self._space is None:
            return []
        space, commands = self._space, []
        for p in self._space.parameters:
            row = self.rows[p.name]
            lo, hi = row.bounds.value
            if p.locked_at is not None and not row.locked.value:
                commands.append(Unlock(p.name))
                space = space.without_lock(p.name)
            if (lo, hi) != (p.lo, p.hi):
                commands.append(SetBound(p.name, lo, hi))
                space = space.with_bound(p.name, lo, hi)
            if row.locked.value and row.value.value != p.locked_at:
                commands.append(Lock(p.name, row.value.value))
                space = space.with_lock(p.name, row.value.value)
        return commands

    def _build(self, space: DesignSpace) -> None:
        """Make the rows: once for a task, again only when a run of another task is opened."""
        if self._form is not None:
            self._form.remove()
        gui = self._gui
        with self.holder:
            self._form = gui.add_form(None)
            with self._form:
                self.rows = {p.name: self._row(p) for p in space.parameters}
                apply = gui.add_button("Apply", icon=viser.Icon.CHECK, color="green")
                reset = gui.add_button("Discard edits", icon=viser.Icon.ARROW_BACK_UP)
        form = self._form
        self._buttons = (apply, reset)
        apply.on_click(lambda _: form.submit())
        form.on_submit(lambda event: self._send(self.commands, event.client))
        reset.on_click(lambda _: self._discard())
        self._names = tuple(space.names)

    def _row(self, p: Parameter) -> _Row:
        gui = self._gui
        unit = f" [{p.unit}]" if p.unit else ""
        with gui.add_folder(p.name, expand_by_default=True) as folder:
            bounds = gui.add_vector2(
                f"bounds{unit}", (p.lo, p.hi), min=(p.hard_lo, p.hard_lo), max=(p.hard_hi, p.hard_hi), step=0.01,
                hint=f"lowest and highest allowed value, inside {p.hard_lo:g} to {p.hard_hi:g} {p.unit}",
            )  # fmt: skip
            locked = gui.add_checkbox("locked", p.locked_at is not None, hint="hold it at the value below")
            value = gui.add_number(
                f"at{unit}", p.initial if p.locked_at is None else p.locked_at, min=p.hard_lo, max=p.hard_hi, step=0.01,
                visible=p.locked_at is not None,
            )  # fmt: skip
            row = _Row(folder, bounds, locked, value, p)
        locked.on_update(lambda event: self._propose(p.name, by_hand=event.client is not None))
        return row

    def _propose(self, name: str, *, by_hand: bool) -> None:
        """Ask for the value beside a ticked lock, and offer the present one to whoever ticks it."""
        row, space = self.rows[name], self._space
        row.value.visible = row.locked.value
        if by_hand and space is not None and row.locked.value and row.shown.locked_at is None:
            present = round(float(self._phi[space.index(name)]), 3)
            row.value.value = min(max(present, row.shown.lo), row.shown.hi)

    def _fill(self, row: _Row, p: Parameter) -> None:
        row.bounds.value = (p.lo, p.hi)
        row.locked.value = p.locked_at is not None
        if p.locked_at is not None:
            row.value.value = p.locked_at
        row.shown = p

    def _discard(self) -> None:
        for row in self.rows.values():
            self._fill(row, row.shown)
