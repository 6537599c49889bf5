"""The design panel: bounds and locks of every design parameter, edited together and sent together."""

from dataclasses import dataclass

import numpy as np
import viser

from morph_core.design import DesignSpace
from morph_core.history import History
from morph_core.protocol import AnyCommand, Lock, Parameter, SetBound, Status, Unlock
from studio.viewer import wording
from studio.viewer.change import change_table
from studio.viewer.parts import unit_of
from studio.viewer.run import NOT_LIVE, Send

_MOST_OPEN = 5
"""Largest number of rows that are all open at first; of more, each is folded, with its value in its heading."""


@dataclass
class _Row:
    """The inputs of one parameter."""

    folder: viser.GuiFolderHandle
    bounds: viser.GuiVector2Handle
    locked: viser.GuiCheckboxHandle
    value: viser.GuiNumberHandle[float]
    shown: Parameter


class DesignPanel:
    """A form with one row for each parameter of the run's design space; `send` is called with its commands."""

    def __init__(self, gui: viser.GuiApi, *, send: Send) -> None:
        self._gui = gui
        self._send = send
        self._names: tuple[str, ...] = ()
        self._space: DesignSpace | None = None
        self._phi = np.zeros(0)
        self._form: viser.GuiFormHandle | None = None
        self.rows: dict[str, _Row] = {}
        self.change = gui.add_html("", visible=False)
        self.note = gui.add_html(wording.paragraph(wording.dim("no data yet: press Start")))
        self.holder = gui.add_folder("Bounds and locks", visible=False)
        self._buttons: tuple[viser.GuiButtonHandle, ...] = ()

    def clear(self) -> None:
        """Hide the form, as there is no run to show."""
        self.note.content = wording.paragraph(wording.dim("no data yet: press Start"))
        self.holder.visible = self.change.visible = False

    def update(self, history: History, status: Status) -> None:
        """Show a run's present design; inputs that somebody is editing stay as they are."""
        space, phi = history.design_space, history.phi
        if tuple(space.names) != self._names:
            self._build(space)
        self._space, self._phi = space, phi
        self.holder.visible = self.change.visible = True
        self.change.content = wording.paragraph("<b>Present design φ, against the initial one</b>")
        self.change.content += change_table(history, phi)
        live = status not in NOT_LIVE
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
            row.folder.label = f"{p.name}: {_in_words(p, value)}{lock} (initially {_number(initial)})"
            if p != row.shown:
                self._fill(row, p)

    def commands(self) -> list[AnyCommand]:
        """Return the commands for what was edited. Raise ValueError with a sentence if a value is not allowed."""
        if self._space is None:
            return []
        space, commands = self._space, []
        for p in self._space.parameters:
            row = self.rows[p.name]
            lo, hi = row.bounds.value
            if p.locked_at is not None and not row.locked.value:
                commands.append(Unlock(p.name))
                space = space.without_lock(p.name)
            lo, hi = (_unrounded(p, value, (p.lo, p.hi, p.hard_lo, p.hard_hi)) for value in (lo, hi))
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
                expand = len(space) <= _MOST_OPEN
                self.rows = {p.name: self._row(p, expand) for p in space.parameters}
                apply = gui.add_button("Apply", icon=viser.Icon.CHECK, color="green")
                reset = gui.add_button("Discard edits", icon=viser.Icon.ARROW_BACK_UP)
        form = self._form
        self._buttons = (apply, reset)
        apply.on_click(lambda _: form.submit())
        form.on_submit(lambda event: self._send(self.commands, event.client))
        reset.on_click(lambda _: self._discard())
        self._names = tuple(space.names)

    def _row(self, p: Parameter, expand: bool) -> _Row:
        gui = self._gui
        unit = f" [{p.unit}]" if p.unit else ""
        step = _step(p)
        with gui.add_folder(p.name, expand_by_default=expand) as folder:
            bounds = gui.add_vector2(
                f"bounds{unit}", (p.lo, p.hi), min=(p.hard_lo, p.hard_lo), max=(p.hard_hi, p.hard_hi), step=step,
                hint=f"lowest and highest allowed value, inside {p.hard_lo:g} to {p.hard_hi:g} {p.unit}",
            )  # fmt: skip
            locked = gui.add_checkbox("locked", p.locked_at is not None, hint="hold it at the value below")
            value = gui.add_number(
                f"at{unit}", p.initial if p.locked_at is None else p.locked_at, min=p.hard_lo, max=p.hard_hi, step=step,
                visible=p.locked_at is not None,
            )  # fmt: skip
            row = _Row(folder, bounds, locked, value, p)
        locked.on_update(lambda event: self._propose(p.name, by_hand=event.client is not None))
        return row

    def _propose(self, name: str, *, by_hand: bool) -> None:
        """Show the input of the value beside a ticked lock; when somebody ticks it, fill in the present value."""
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


def _in_words(p: Parameter, value: float) -> str:
    """Return a value in words, such as "2.000 m" or "0.052 rad, 3.0°"."""
    words = f"{_number(value)} {p.unit}".rstrip()
    return f"{words}, {unit_of(p).words(value)}" if p.unit == "rad" else words


def _number(value: float) -> str:
    return f"{round(value, 3) + 0.0:.3f}".replace("-", "−")


def _step(p: Parameter) -> float:
    return 0.01 if p.scale >= 0.5 else 0.001


def _unrounded(p: Parameter, value: float, exact: tuple[float, ...]) -> float:
    """Return the one of the exact values that the browser shows rounded to the input's step, else `value`."""
    return next((e for e in exact if abs(value - e) <= _step(p) / 2), value)
