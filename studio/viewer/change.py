"""How far a design has come from the initial one: a table with a row for each part of the robot, at a glance."""

import numpy as np

from morph_core.history import History
from studio.viewer import wording
from studio.viewer.parts import Entry, Quantity, Unit, quantities_of

_TRACK = "position:relative;height:6px;border-radius:3px;background:rgba(128,138,150,0.22);margin-top:2px"
_MIDDLE = "position:absolute;left:50%;top:-2px;width:1px;height:10px;background:currentColor;opacity:0.55"


def change_table(history: History, phi: np.ndarray) -> str:
    """Return as HTML how `phi` (d,) differs from the initial design: in numbers, and as bars, to the left where it is
    less and to the right where it is more."""
    quantities = quantities_of(history)
    parts = dict.fromkeys((e.part, e.colour) for q in quantities for e in q.entries)
    heading = "".join(
        f'<th style="{_cell(q is quantities[0])};font-weight:600">{wording.text(q.name)}</th>' for q in quantities
    )
    rows = []
    for part, colour in parts:
        cells = "".join(
            f'<td style="{_cell(q is quantities[0])}">{_entry(q, part, history.initial_phi, phi)}</td>'
            for q in quantities
        )
        rows.append(
            f'<tr><td style="white-space:nowrap">{wording.swatch(colour)} {wording.text(part)}</td>{cells}</tr>'
        )
    several = len(quantities) > 1
    return wording.paragraph(
        '<table style="width:97%;border-collapse:collapse;line-height:1.25;font-variant-numeric:tabular-nums">'
        f"{f'<tr><td></td>{heading}</tr>' if several else ''}{''.join(rows)}</table>"
    )


def _cell(first: bool) -> str:
    return f"text-align:left;padding:0.15em 0 0.3em {0.9 if first else 1.2}em"


def _entry(quantity: Quantity, part: str, initial: np.ndarray, phi: np.ndarray) -> str:
    """Return one part's numbers and bar. The longest bar of a quantity is its largest change, or half of its scale if
    that is more."""
    entry = next((e for e in quantity.entries if e.part == part), None)
    if entry is None:
        return ""
    change = phi - initial
    longest = max(max(abs(change[e.index]), e.scale / 2) for e in quantity.entries)
    numbers = _numbers(quantity.unit, entry, initial, phi)
    return f"{numbers}{_bar(float(change[entry.index] / longest), entry.colour)}"


def _numbers(unit: Unit, entry: Entry, initial: np.ndarray, phi: np.ndarray) -> str:
    """Return HTML such as "12.0 → 18.3 cm" and "+6.3 cm"; where the initial value is zero, the change alone."""
    before, now = float(initial[entry.index]), float(phi[entry.index])
    both = f"{unit.number(before)} → {unit.words(now)}" if before else ""
    return (
        '<div style="display:flex;justify-content:space-between;white-space:nowrap">'
        f"<span>{wording.dim(wording.text(both))}</span><b>{wording.text(unit.change(now - before))}</b></div>"
    )


def _bar(share: float, colour: str) -> str:
    """Return a bar as HTML, from the middle to the right for a `share` in (0, 1], to the left for one in [-1, 0)."""
    width = 50 * min(abs(share), 1.0)
    left = 50.0 if share > 0 else 50 - width
    fill = f"position:absolute;left:{left:.1f}%;width:{width:.1f}%;height:6px;border-radius:2px;background:{colour}"
    return f'<div style="{_TRACK}"><div style="{fill}"></div><div style="{_MIDDLE}"></div></div>'
