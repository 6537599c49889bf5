"""Colours that the parts of the robot take on: how far a design has come, or how both gradients agree about it."""

from dataclasses import dataclass

import numpy as np

from morph_core.history import History
from studio.viewer.figure import Figure
from studio.viewer.parts import belongs, quantities_of

Colour = tuple[int, int, int]

FAR = 0.25
"""Change of a parameter, as a share of its box, from which on the colour is the strongest."""
LOW, MIDDLE, HIGH = (224, 116, 0), (206, 209, 214), (22, 102, 190)
"""Orange, grey and blue, which nearly all colour-blind people tell apart."""


@dataclass(frozen=True)
class Tint:
    """Colours of the robot's parts, and what they mean."""

    colours: tuple[tuple[str, Colour], ...]
    """Name of a part and its colour; what belongs to none of them is grey."""
    meaning: str
    low: str
    """Words for the colour at the lower end of the scale."""
    high: str


def change_tint(history: History, phi: np.ndarray) -> Tint:
    """Return the colours that show how far `phi` (d,) has come since the initial design.

    A part with several parameters has the colour of the one that has changed most.
    """
    low, high = history.design_space.hard_box
    share = (phi - history.initial_phi) / (high - low) / FAR
    meaning, end = "change since the start, as a share of the parameter's range", f"{100 * FAR:.0f} %"
    return Tint(_colours(history, share), meaning, f"−{end}", f"+{end}")


def agreement_tint(history: History, iteration: int) -> Tint:
    """Return the colours that show how g_task and g_hw agree about each part, at an iteration or the last one before it
    in which that was measured.

    A part with several parameters has the colour of the one about which the gradients differ most.
    """
    count = len(history.design_space)
    before = (p for p in reversed(history.progress) if p.iteration <= iteration)
    measured = next((p for p in before if len(p.cosine_by_parameter or ()) == count), None)
    if measured is None:
        return Tint((), "agreement of g_task and g_hw: not measured so far", "", "")
    cosines = np.array([np.nan if c is None else c for c in measured.cosine_by_parameter or ()], float)
    meaning = f"agreement of g_task and g_hw in iteration {measured.iteration}, as their cosine"
    return Tint(_colours(history, cosines, least=True), meaning, "−1", "+1")


def painted(figure: Figure, tint: Tint) -> np.ndarray:
    """Return colours (n, 3) uint8 for the parts of a figure."""
    colours = np.tile(np.array(MIDDLE, np.uint8), (len(figure), 1))
    for part, colour in tint.colours:
        colours[[belongs(name, part) for name in figure.names]] = colour
    return colours


def shade(value: float) -> Colour:
    """Return the colour of a value in [-1, 1]; values beyond it have the strongest one."""
    share = min(abs(value), 1.0)
    end = LOW if value < 0 else HIGH
    red, green, blue = (round((1 - share) * m + share * e) for m, e in zip(MIDDLE, end, strict=True))
    return red, green, blue


def _colours(history: History, values: np.ndarray, *, least: bool = False) -> tuple[tuple[str, Colour], ...]:
    """Return the colour of each part, of its value of largest amount, or of its least one; NaN has no colour."""
    found: dict[str, float] = {}
    for entry in (entry for quantity in quantities_of(history) for entry in quantity.entries):
        value, part = float(values[entry.index]), entry.geoms
        if np.isnan(value):
            continue
        known = found.get(part)
        if known is None or (value < known if least else abs(value) > abs(known)):
            found[part] = value
    return tuple((part, shade(value)) for part, value in found.items())
