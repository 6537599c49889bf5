"""What report.html says of printing: the plates as pictures, what was measured of each piece, and the fit of joints."""

from html import escape

from studio.export.coupon import NAME as COUPON
from studio.export.coupon import STEPS
from studio.export.gauge import NEAR, STEEP, tightest
from studio.export.pieces import LAYER
from studio.export.plate_picture import plate_picture
from studio.export.plates import Prints, dowels_bought, plate_title


def prints_html(prints: Prints) -> str:
    """Return the section on printing, without its heading; it loads nothing."""
    return "\n".join([_intro(prints), _problems(prints), _plates(prints), _pieces(prints), _joints(prints)])


def _intro(prints: Prints) -> str:
    count, cut = len(prints.plates), [each for each in prints.parts.values() if len(each.pieces) > 1]
    said = f"<p>Laid out for a printer of {escape(str(prints.printer))}"
    said += f", on {count} plate{'s' * (count != 1)}: plates/*.3mf." if count else "."
    said += " Every body lies on that of its six sides which has the largest first layer."
    if cut:
        bought = ", ".join(f"{count} {item}" for item, count, *_ in dowels_bought(prints))
        said += f" Parts that are longer than the bed are in pieces, to be glued with dowels: {escape(bought)}."
    return said


def _problems(prints: Prints) -> str:
    if not prints.problems:
        return ""
    rows = "".join(f"<li>{escape(sentence)}" for sentence in prints.problems.values())
    return f"<p><strong>Not on the plates, as this printer can't print them:</strong><ul>{rows}</ul>"


def _plates(prints: Prints) -> str:
    pictures = [plate_picture(plate, plate_title(prints, i)) for i, plate in enumerate(prints.plates, start=1)]
    return f"<div class=plates>{''.join(f'<figure>{picture}</figure>' for picture in pictures)}</div>"


def _pieces(prints: Prints) -> str:
    rows = "".join(
        f"<tr><td>{escape(name)}<td class=n>{' &times; '.join(f'{s:.1f}' for s in found.size)}"
        f"<td class=n>{found.first_layer:,.0f}<td class=n>{found.thinnest_wall:.1f}<td class=n>{found.overhang:,.0f}"
        for name, found in prints.measured.items()
    )
    return f"""<table><thead><tr><th>body<th class=n>size as it lies, mm<th class=n>first layer, mm&sup2;
<th class=n>thinnest wall, mm<th class=n>overhang, mm&sup2;</tr></thead>{rows}</table>
<p class=dim>Measured on the meshes. First layer: {LAYER:g} mm above the bed. Overhang: undersides above it that lean
outward by more than {STEEP:g}&deg;, bores among them."""


def _joints(prints: Prints) -> str:
    if not (found := tightest(prints.fits)):
        return ""
    gap = f"at least {NEAR:g}" if found["gap"] >= NEAR else f"{found['gap']:.2f}"
    plays = ", ".join(f"{play:g}" for play in STEPS)
    return f"""<p>Joints, measured on the meshes: a pin of {found["pin"]:.2f} mm fills the bore of one part and has
{found["play"]:.2f} mm play in that of the other at least; neighbours are {gap} mm apart. Printers differ: print
<em>{COUPON}</em> first, whose bores have {plays} mm play, marked by one to {len(STEPS)} grooves. A pin should be
pressed into the first and turn in the one with the play above; otherwise correct the printer's hole compensation."""
