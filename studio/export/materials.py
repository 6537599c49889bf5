"""The bill of materials: what is printed and what is bought, with masses and price classes, and the totals."""

import csv
import io
from collections.abc import Sequence
from html import escape

import msgspec
import numpy as np

from morph_core.tasks.servos import ServoName
from studio.export.plates import Prints, dowels_bought, note_of
from studio.robots.parts import Part
from studio.robots.robot import Robot


class Line(msgspec.Struct, frozen=True):
    """One kind of thing that the robot needs."""

    item: str
    quantity: int
    links: str = ""
    file: str = ""
    material: str = ""
    mass: float | None = None
    """Mass of each in kg; None where it is not known."""
    size: str = ""
    """Size in mm."""
    price: tuple[float, float] | None = None
    """Price class: USD each, from and to; None where it is not known."""
    note: str = ""


def bill_of_materials(
    robot: Robot, phi: np.ndarray, parts: Sequence[Part], servo: ServoName | None, prints: Prints | None = None
) -> list[Line]:
    """Return what a design (d,) needs, with the `servo` that drives its joints, if one was chosen, and the dowels of
    parts that are printed in pieces."""
    printed = [
        Line(
            item=part.name,
            quantity=part.quantity,
            links=" ".join(part.links),
            file=part.stl_path,
            material=f"PLA, infill {part.infill:.0%}",
            mass=part.inertial.mass,
            size=" x ".join(f"{side:.1f}" for side in part.size),
            note=note_of(prints, part.name) if prints else "",
        )
        for part in parts
    ]
    bought = [
        Line(
            item=thing.item, quantity=thing.quantity, links=thing.links, material=thing.material, mass=thing.mass,
            size=thing.size, price=thing.price, note=thing.note,
        )
        for thing in robot.bought(phi, parts, servo)
    ]  # fmt: skip
    dowels = [
        Line(item=str(item), quantity=count, links=str(links), material="steel", note=note)
        for item, count, links, note in (dowels_bought(prints) if prints else [])
    ]
    return [*printed, *bought, *dowels]


def total(lines: Sequence[Line]) -> Line:
    """Return the totals: pieces, kg and USD of all of them, with what has no mass or price named in the note."""
    weighed = [line for line in lines if line.mass is not None]
    priced = [line for line in lines if line.price is not None]
    unknown = {
        "mass": [line.item for line in lines if line.mass is None],
        "price": [line.item for line in lines if line.price is None and not line.file],
    }
    ends = tuple(sum(line.quantity * (line.price or (0.0, 0.0))[end] for line in priced) for end in (0, 1))
    return Line(
        item="total",
        quantity=sum(line.quantity for line in lines),
        mass=sum(line.quantity * (line.mass or 0.0) for line in weighed),
        price=(ends[0], ends[1]) if priced else None,
        note="; ".join(f"without the {word} of: {', '.join(items)}" for word, items in unknown.items() if items),
    )


def bill_csv(lines: Sequence[Line]) -> bytes:
    """Return BOM.csv: masses in g, sizes in mm, prices in USD, of each thing and of a line; the last is the total."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([
        "item", "quantity", "links", "file", "material", "mass_g_each", "size_mm", "price_usd_each", "mass_g",
        "price_usd", "note",
    ])  # fmt: skip
    for line in lines:
        writer.writerow([
            line.item, line.quantity, line.links, line.file, line.material, _grams(line.mass), line.size,
            _dollars(line.price), _grams(line.mass, line.quantity), _dollars(line.price, line.quantity), line.note,
        ])  # fmt: skip
    everything = total(lines)
    writer.writerow([
        everything.item, everything.quantity, "", "", "", "", "", "", _grams(everything.mass),
        _dollars(everything.price), everything.note,
    ])  # fmt: skip
    return out.getvalue().encode()


def bill_html(lines: Sequence[Line]) -> str:
    """Return the section of report.html: the same, as a table."""
    everything = total(lines)
    rows = "".join(
        f"<tr><td>{escape(line.item)}<td class=n>{line.quantity}<td class=n>{_grams(line.mass)}"
        f"<td class=n>{_grams(line.mass, line.quantity)}<td class=n>{_dollars(line.price)}"
        f"<td class=n>{_dollars(line.price, line.quantity)}<td>{escape(line.note)}"
        for line in lines
    )
    return f"""<table><thead><tr><th>item<th class=n>quantity<th class=n>g each<th class=n>g<th class=n>USD each
<th class=n>USD<th>note</tr></thead>{rows}
<tfoot><tr><th>{everything.item}<th class=n>{everything.quantity}<th><th class=n>{_grams(everything.mass)}<th>
<th class=n>{_dollars(everything.price)}<th>{escape(everything.note)}</tr></tfoot></table>
"""


def _grams(mass: float | None, quantity: int = 1) -> str:
    return "" if mass is None else f"{1000 * quantity * mass:.2f}"


def _dollars(price: tuple[float, float] | None, quantity: int = 1) -> str:
    return "" if price is None else f"{quantity * price[0]:g}-{quantity * price[1]:g}"
