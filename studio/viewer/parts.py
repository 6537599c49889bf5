"""What the design parameters are of: which part of the robot, which of its quantities, and in which unit it is read."""

import functools
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.protocol import Parameter
from studio.robots.chooser import robot_of
from studio.units import Unit, unit_of

COLOURS = ("#0f7dc2", "#e07b00", "#17a673", "#c2459b", "#8a6be0", "#c9a400", "#5aa9e6", "#d0342c", "#7a828e")
"""Colours that are told apart on white and on black, the first ones also by most colour-blind people."""

_MEASURED = {"m": "length", "rad": "angle"}
"""A unit -> what is measured in it."""


@dataclass(frozen=True)
class Entry:
    """One design parameter."""

    index: int
    """Place of the parameter in phi."""
    part: str
    """Part of the robot, such as "finger 1"; the parameter's name where no part goes with it."""
    geoms: str
    """Word with which the names of the part's geoms begin."""
    colour: str
    """Colour of the part in the scene, as in CSS."""
    scale: float
    """Typical change of the parameter, in the parameter's own unit."""


@dataclass(frozen=True)
class Quantity:
    """The parameters that mean the same of one part each, such as the fingers' lengths."""

    name: str
    unit: Unit
    entries: tuple[Entry, ...]


def shows_parts(parameters: Sequence[Parameter]) -> bool:
    """Tell whether printed parts are wide enough to be seen: on links of metres they are threads."""
    return all(p.hard_hi < 1 for p in parameters if p.unit == "m")


def has_printed_parts(history: History) -> bool:
    """Tell whether the robot of a run has parts that are drawn for a printer; a task of another version may have."""
    try:
        return robot_of(make_task(history.record.task, history.record.task_options)).printed
    except (ValueError, TypeError):
        return True


def quantities_of(history: History) -> list[Quantity]:
    """Return the design parameters of a run by quantity, in the order of phi.

    A run that was recorded before parameters named their parts has them from its task.
    """
    options = json.dumps(history.record.task_options, sort_keys=True)
    known = _parts(history.record.task, options, tuple(history.initial_phi.tolist()))
    found: dict[tuple[str, Unit], list[Entry]] = {}
    for i, p in enumerate(history.design_space.parameters):
        part, colour = known.get(p.name, (p.part, COLOURS[i % len(COLOURS)]))
        name = part or p.name
        entry = Entry(i, name.replace("_", " "), name, colour, p.scale)
        found.setdefault((_quantity(p, part), unit_of(p)), []).append(entry)
    return [Quantity(name, unit, tuple(entries)) for (name, unit), entries in found.items()]


def _quantity(p: Parameter, part: str) -> str:
    """Return what a parameter measures: "length" of "length_2"; where it has the name of its part, what is
    measured in its unit."""
    name, number = split_name(p.name)
    return _MEASURED.get(p.unit, p.unit) if p.name == part and not number else name


def split_name(name: str) -> tuple[str, str]:
    """Return ("length", "2") of "length_2", and the whole name with "" of others."""
    match = re.fullmatch(r"(.+)_(\d+)", name)
    return (match[1], match[2]) if match else (name, "")


@functools.lru_cache(maxsize=32)
def _parts(task: str, options: str, phi: tuple[float, ...]) -> Mapping[str, tuple[str, str]]:
    """Return parameter -> (part, colour) of those whose part is to be seen; the part's first geom has its colour."""
    try:
        made = make_task(task, json.loads(options))
        model = made.spec(np.array(phi)).compile()
    except (ValueError, TypeError):  # a task of another version: its run is still worth seeing
        return {}
    names = [model.geom(i).name or model.body(int(model.geom_bodyid[i])).name for i in range(model.ngeom)]
    parts: dict[str, tuple[str, str]] = {}
    for p in made.design_space.parameters:
        geoms = [i for i, name in enumerate(names) if p.part and belongs(name, p.part)]
        if geoms:
            r, g, b = 255 * model.geom_rgba[geoms[0], :3]
            parts[p.name] = (p.part, f"rgb({r:.0f}, {g:.0f}, {b:.0f})")
    return parts


def belongs(name: str, part: str) -> bool:
    """Tell whether a geom is of a part: "finger_1_distal" is of "finger_1", "finger_12_distal" is not."""
    return name == part or name.startswith(f"{part}_")
