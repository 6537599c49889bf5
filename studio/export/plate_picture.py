"""A picture of a plate from above: outlines, names and sizes over a grid in millimetres."""

from collections.abc import Iterator
from html import escape

import numpy as np

from studio.export.layout import Item, Plate
from studio.export.printers import BORDER

_MARGIN = 14.0  # mm round the bed, for numbers and the title
_GRID = 50.0  # mm
_FONT, _SMALL = 9.0, 7.0  # mm: a plate is some 320 pixels wide in a report
_WIDE = 0.6
"""Width of a letter as a share of the font's size, a little more than most have."""
_FILLS = ("#9ecae1", "#fdd0a2", "#a1d99b", "#dadaeb", "#fcbba1", "#c7e9c0", "#d9d9d9", "#fde0dd")


def plate_picture(plate: Plate, title: str) -> str:
    """Return an SVG of the plate from above, with a title; it loads nothing and holds no style sheet."""
    width, depth, _ = plate.printer.size
    names = list(dict.fromkeys(item.piece.name for item in plate.items))
    shapes = [line for item in plate.items for line in _item(item, _FILLS[names.index(item.piece.name) % len(_FILLS)])]
    box = f"{-_MARGIN:g} {-depth - _MARGIN:g} {width + 2 * _MARGIN:g} {depth + 2 * _MARGIN:g}"
    size = min(_FONT, (width + _MARGIN) / (_WIDE * len(title)))
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" font-family="sans-serif" fill="#1c1e22">',
        f"<title>{escape(title)}</title>",
        f'<rect x="{-_MARGIN:g}" y="{-depth - _MARGIN:g}" width="100%" height="100%" fill="#fff"/>',
        f'<rect y="{-depth:g}" width="{width:g}" height="{depth:g}" fill="#f3f4f6" stroke="#5c6370"/>',
        *_grid(width, depth),
        f'<text x="0" y="{-depth - 5:g}" font-size="{size:.2f}">{escape(title)}</text>',
        *shapes,
        "</svg>",
    ])  # fmt: skip


def _grid(width: float, depth: float) -> Iterator[str]:
    """Yield the lines of the grid, their distances from the bed's corner, and the border on which nothing lies."""
    for i, (end, other) in enumerate(((width, depth), (depth, width))):
        for at in np.arange(0.0, end + 1e-9, _GRID):
            line = (at, 0.0, at, -other) if i == 0 else (0.0, -at, other, -at)
            x1, y1, x2, y2 = (f"{v:g}" for v in line)
            yield f'<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" stroke="#d5d8dd" stroke-width=".5"/>'
            unit = " mm" if at + _GRID > end else ""
            place = (
                f'x="{at:g}" y="9" text-anchor="middle"' if i == 0 else f'x="-2" y="{-at + 2.5:g}" text-anchor="end"'
            )
            yield f'<text {place} font-size="{_SMALL:g}" fill="#5c6370">{at:g}{unit if i == 0 else ""}</text>'
    yield (
        f'<rect x="{BORDER:g}" y="{BORDER - depth:g}" width="{width - 2 * BORDER:g}" height="{depth - 2 * BORDER:g}" '
        'fill="none" stroke="#9aa1ad" stroke-width=".5" stroke-dasharray="3 3"/>'
    )


def _item(item: Item, fill: str) -> Iterator[str]:
    """Yield the outline of a body, and its name and size along its length."""
    loops = item.solid.project().simplify(0.05).to_polygons()
    path = "".join("M" + " ".join(f"{x:.2f},{-y:.2f}" for x, y in loop) + "Z" for loop in loops)
    yield f'<path d="{path}" fill="{fill}" fill-rule="evenodd" stroke="#33373e" stroke-width=".5"/>'
    length, width, height = (float(s) for s in item.piece.size)
    said = (item.piece.name, f"{length:.0f} × {width:.0f} × {height:.0f} mm")
    size = min(_FONT, 0.8 * length / (_WIDE * max(map(len, said))), width / 3)
    low, high = np.array(item.solid.bounding_box()).reshape(2, 3)
    x, y, _ = (low + high) / 2
    cos, sin = (item.pose[:, :3] @ item.piece.turn.T)[:2, 0]
    angle = -np.degrees(np.arctan2(sin, cos))
    around = f'stroke="{fill}" stroke-width="{size / 3:.2f}" stroke-linejoin="round" paint-order="stroke"'
    yield (
        f'<g transform="translate({x:.2f} {-y:.2f}) rotate({angle:.2f})" text-anchor="middle" '
        f'font-size="{size:.2f}" {around}>'
    )
    for i, text in enumerate(said):
        yield f'<text y="{(1.2 * i - 0.25) * size:.2f}">{escape(text)}</text>'
    yield "</g>"
