"""What the design parameters are of: which part of the robot, which of its quantities, and in which unit it is read."""

import functools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.protocol import Parameter

COLOURS = ("#0f7dc2", "#e07b00", "#17a673", "#c2459b", "#8a6be0", "#c9a400", "#5aa9e6", "#d0342c", "#7a828e")
"""Told apart on white and on black; the first ones also by most colour-blind people."""


@dataclass(frozen=True)
class Unit:
    """How a quantity is shown."""

    name: str
    factor: float
    """Times the parameter's own number."""
    digits: int

    def number(self, value: float) -> str:
        return f"{round(value * self.factor, self.digits) + 0.0:.{self.digits}f}".replace("-", "−")  # no "−0.0"

    def words(self, value: float) -> str:
        """Return "12.0 cm"."""
        return f"{self.number(value)}{self._unit}"

    def change(self, value: float) -> str:
        """Return "+6.3 cm" or "−0.4 cm", and "±0.0 cm" where nothing is to be seen of it."""
        number = self.number(abs(value))
        sign = "±" if float(number) == 0 else "+" if value > 0 else "−"
        return f"{sign}{number}{self._unit}"

    @property
    def _unit(self) -> str:
        return self.name if self.name == "°" else f" {self.name}".rstrip()


@dataclass(frozen=True)
class Entry:
    """One design parameter."""

    index: int
    """In phi."""
    part: str
    """"finger 1"; the parameter's name where no part of the robot goes with it."""
    colour: str
    """Of that part in the scene, as in CSS."""
    scale: float
    """A typical change."""


@dataclass(frozen=True)
class Quantity:
    """The parameters that mean the same of one part each, such as the fingers' lengths."""

    name: str
    unit: Unit
    entries: tuple[Entry, ...]


def unit_of(p: Parameter) -> Unit:
    """Return the unit in which people think of a parameter: degrees, and centimetres for what is below a metre."""
    if p.unit == "rad":
        return Unit("°", math.degrees(1), 1)
    if p.unit == "m":
        return Unit("cm", 100.0, 1) if p.hard_hi < 1 else Unit("m", 1.0, 2)
    return Unit(p.unit, 1.0, 2)


def shows_parts(parameters: Sequence[Parameter]) -> bool:
    """Tell whether printed parts are wide enough to be seen: on links of metres they are threads."""
    return all(p.hard_hi < 1 for p in parameters if p.unit == "m")


def quantities_of(history: History) -> list[Quantity]:
    """Return the design parameters of a run by quantity, in the order of phi.

    A parameter "length_2" is the length of the part whose geoms' names have the number 2.
    """
    options = json.dumps(history.record.task_options, sort_keys=True)
    parts = _parts(history.record.task, options, tuple(history.initial_phi.tolist()))
    found: dict[tuple[str, Unit], list[Entry]] = {}
    for i, p in enumerate(history.design_space.parameters):
        quantity, number = split_name(p.name)
        part, colour = parts.get(number, (p.name.replace("_", " "), COLOURS[i % len(COLOURS)]))
        found.setdefault((quantity, unit_of(p)), []).append(Entry(i, part, colour, p.scale))
    return [Quantity(name, unit, tuple(entries)) for (name, unit), entries in found.items()]


def split_name(name: str) -> tuple[str, str]:
    """Return ("length", "2") of "length_2", and the whole name with "" of others."""
    match = re.fullmatch(r"(.+)_(\d+)", name)
    return (match[1], match[2]) if match else (name, "")


@functools.lru_cache(maxsize=32)
def _parts(task: str, options: str, phi: tuple[float, ...]) -> Mapping[str, tuple[str, str]]:
    """Return number -> (part, colour) of the robot's numbered parts; the first geom of a number names its part."""
    try:
        model = make_task(task, json.loads(options)).spec(np.array(phi)).compile()
    except (ValueError, TypeError):  # a task of another version: its run is still worth seeing
        return {}
    parts: dict[str, tuple[str, str]] = {}
    for i in range(model.ngeom):
        match = re.match(r"(\D*?)_(\d+)(?!\d)", model.geom(i).name)
        if match:
            r, g, b = 255 * model.geom_rgba[i, :3]
            parts.setdefault(match[2], (f"{match[1]} {match[2]}", f"rgb({r:.0f}, {g:.0f}, {b:.0f})"))
    return parts
