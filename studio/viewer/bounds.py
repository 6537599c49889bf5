"""Inputs for the bounds and the lock of every design parameter."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import viser

from morph_core.design import DesignSpace
from morph_core.protocol import AnyCommand, Lock, Parameter, SetBound, Unlock
from studio.units import Unit, unit_of
from studio.viewer.parts import split_name


@dataclass
class Row:
    """The inputs of one parameter."""

    bounds: viser.GuiVector2Handle
    """Lowest and highest value, in `unit`, as `value` is."""
    locked: viser.GuiCheckboxHandle
    value: viser.GuiNumberHandle[float]
    shown: Parameter
    unit: Unit
    step: float
    """Smallest difference that the inputs show, in `unit`."""

    def of(self, value: float) -> float:
        """Return a value of the parameter in the unit of the inputs."""
        return round(value * self.unit.factor, 9)

    def exact(self, typed: float, known: Sequence[float]) -> float:
        """Return the parameter's value for a typed one: the one of the known values that the browser shows as that."""
        near = (value for value in known if abs(typed - self.of(value)) <= self.step / 2)
        return next(near, typed / self.unit.factor)


@dataclass
class Group:
    """The rows of one part of the robot, in a folder of their own."""

    name: str
    folder: viser.GuiFolderHandle
    told: viser.GuiHtmlHandle
    """What is said above the rows; nothing at first."""
    words: Mapping[str, str]
    """Name of each of its design parameters -> what it is called here, beside the others."""


class BoundsForm:
    """A row of inputs for each parameter of a design space, made where the caller has opened a container."""

    def __init__(self, gui: viser.GuiApi, space: DesignSpace) -> None:
        """Make the rows, those of a part of the robot together; each part is folded, so that all are in sight."""
        self._gui = gui
        self._space, self._phi = space, space.initial
        self.rows: dict[str, Row] = {}
        self.groups: list[Group] = []
        parts: dict[str, list[Parameter]] = {}
        for p in space.parameters:
            parts.setdefault(p.part or p.name, []).append(p)
        for part, members in parts.items():
            self._add(part, members)

    def show(self, space: DesignSpace, phi: np.ndarray) -> None:
        """Show bounds and locks that have changed; inputs that somebody is editing stay as they are."""
        self._space, self._phi = space, phi
        for p in space.parameters:
            row = self.rows[p.name]
            if (p.lo, p.hi) != (row.shown.lo, row.shown.hi):
                row.bounds.value = (row.of(p.lo), row.of(p.hi))
            if p.locked_at != row.shown.locked_at:
                self._fill_lock(row, p)
            row.shown = p

    def discard(self) -> None:
        """Show the bounds and locks again, whatever was edited."""
        for row in self.rows.values():
            self._fill(row, row.shown)

    def edited(self) -> tuple[list[AnyCommand], Sequence[Parameter]]:
        """Return what was edited, as commands and as the parameters that differ.

        Raise ValueError with a sentence if a value is not allowed.
        """
        space, commands = self._space, []
        for p in self._space.parameters:
            row = self.rows[p.name]
            lo, hi = row.bounds.value
            if p.locked_at is not None and not row.locked.value:
                commands.append(Unlock(p.name))
                space = space.without_lock(p.name)
            lo, hi = (row.exact(value, (p.lo, p.hi, p.hard_lo, p.hard_hi)) for value in (lo, hi))
            if (lo, hi) != (p.lo, p.hi):
                commands.append(SetBound(p.name, lo, hi))
                space = space.with_bound(p.name, lo, hi)
            at = row.exact(row.value.value, () if p.locked_at is None else (p.locked_at,))
            if row.locked.value and at != p.locked_at:
                commands.append(Lock(p.name, at))
                space = space.with_lock(p.name, at)
        pairs = zip(space.parameters, self._space.parameters, strict=True)
        return commands, [now for now, before in pairs if now != before]

    def _add(self, part: str, members: Sequence[Parameter]) -> None:
        """Make the rows of a part; where it has several, each says in its labels which parameter it is of."""
        name = part.replace("_", " ") if len(members) > 1 else members[0].name
        words = _short_names(members)
        with self._gui.add_folder(name, expand_by_default=False) as folder:
            told = self._gui.add_html("", visible=False)
            for p in members:
                self.rows[p.name] = self._row(p, words[p.name] if len(members) > 1 else "")
        self.groups.append(Group(name, folder, told, words))

    def _row(self, p: Parameter, word: str) -> Row:
        gui, of = self._gui, unit_of(p)
        unit = f" [{of.name}]" if of.name else ""
        step = 10.0**-of.digits if of.factor != 1 else _step(p)
        lo, hi, low, high = (round(value * of.factor, 9) for value in (p.lo, p.hi, p.hard_lo, p.hard_hi))
        bounds = gui.add_vector2(
            f"{word or 'bounds'}{unit}", (lo, hi), min=(low, low), max=(high, high), step=step,
            hint=f"lowest and highest allowed value, inside {low:g} to {high:g} {of.name}",
        )  # fmt: skip
        locked = gui.add_checkbox(
            f"{word} locked".lstrip(), p.locked_at is not None, hint="hold it at the value below"
        )  # fmt: skip
        value = gui.add_number(
            f"{word} at{unit}".lstrip(), round((p.initial if p.locked_at is None else p.locked_at) * of.factor, 9),
            min=low, max=high, step=step, visible=p.locked_at is not None,
        )  # fmt: skip
        locked.on_update(lambda event: self._propose(p.name, by_hand=event.client is not None))
        return Row(bounds, locked, value, p, of, step)

    def _propose(self, name: str, *, by_hand: bool) -> None:
        """Show the input of the value beside a ticked lock; when somebody ticks it, fill in the present value."""
        row = self.rows[name]
        row.value.visible = row.locked.value
        if by_hand and row.locked.value and row.shown.locked_at is None:
            present = round(row.of(float(self._phi[self._space.index(name)])), 3)
            row.value.value = min(max(present, row.of(row.shown.lo)), row.of(row.shown.hi))

    def _fill(self, row: Row, p: Parameter) -> None:
        row.bounds.value = (row.of(p.lo), row.of(p.hi))
        self._fill_lock(row, p)
        row.shown = p

    @staticmethod
    def _fill_lock(row: Row, p: Parameter) -> None:
        row.locked.value = p.locked_at is not None
        if p.locked_at is not None:
            row.value.value = row.of(p.locked_at)


def _short_names(members: Sequence[Parameter]) -> dict[str, str]:
    """Return name -> "length" of "length_2" for the parameters of a part, or the whole names if two were alike."""
    short = {p.name: split_name(p.name)[0].replace("_", " ") for p in members}
    return short if len(set(short.values())) == len(members) else {p.name: p.name for p in members}


def _step(p: Parameter) -> float:
    return 0.01 if p.scale >= 0.5 else 0.001
