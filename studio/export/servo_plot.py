"""What each joint needs as bars beside what a servo has, as SVG for report.html."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

WIDTH, NAMES, ROW, HEAD, FOOT = 460, 130, 22, 44, 26
"""Sizes in the picture's own pixels: its width, that of the joints' names, and the heights of a row, head and foot."""
_ROOM = 1.08
"""Factor by which the axis is longer than the largest number on it."""


@dataclass(frozen=True)
class Bar:
    """What one joint needs."""

    joint: str
    peak: float
    usual: float
    """What it needs in 95 % of the time at most."""
    is_enough: bool
    """Whether the servo suffices for it."""


def servo_plot(title: str, unit: str, bars: Sequence[Bar], limits: Sequence[tuple[str, float]]) -> str:
    """Return a picture of bars of which the pale part is the peak, and of `limits` as lines across them."""
    largest = max([bar.peak for bar in bars] + [value for _, value in limits])
    per_unit = (WIDTH - NAMES - 12) / (largest * _ROOM if largest > 0 else 1.0)
    bottom = HEAD + ROW * len(bars)
    drawn = [f"<text x=0 y=13 class=title>{escape(title)}, {escape(unit)}</text>"]
    for at in ticks(largest * _ROOM):
        x = NAMES + at * per_unit
        drawn.append(f'<path class=grid d="M{x:.1f} {HEAD}V{bottom}"/>')
        drawn.append(f'<text x="{x:.1f}" y={bottom + 16} text-anchor=middle class=dim>{at:g}</text>')
    for i, bar in enumerate(bars):
        top, kind = HEAD + ROW * i, "bar" if bar.is_enough else "bar bad"
        drawn.append(
            f"<text x={NAMES - 8} y={top + 15} text-anchor=end>{escape(bar.joint)}</text>"
            f'<rect class="{kind} peak" x={NAMES} y={top + 4} width="{bar.peak * per_unit:.1f}" height=14 />'
            f'<rect class="{kind}" x={NAMES} y={top + 4} width="{bar.usual * per_unit:.1f}" height=14 />'
        )
    for i, (name, value) in enumerate(limits):
        x = NAMES + value * per_unit
        anchor = "end" if x > (NAMES + WIDTH) / 2 else "start"
        said = f"{escape(name)} {value:.2f}"
        drawn.append(f'<path class=limit d="M{x:.1f} {HEAD - 4 - 12 * i}V{bottom}"/>')
        beside = x + (4 if anchor == "start" else -4)
        drawn.append(f'<text x="{beside:.1f}" y={HEAD - 6 - 12 * i} text-anchor={anchor}>{said}</text>')
    return (
        f'<svg class=plot viewBox="0 0 {WIDTH} {bottom + FOOT}" role=img aria-label="{escape(title, quote=True)}">'
        f"{''.join(drawn)}</svg>"
    )


def ticks(highest: float) -> list[float]:
    """Return from three to six round numbers from 0 to `highest`."""
    step = 10.0 ** np.floor(np.log10(max(highest, 1e-9)))
    step = next(share * step for share in (0.2, 0.5, 1.0, 2.0) if highest / (share * step) < 6)
    return [round(i * step, 9) for i in range(int(highest / step) + 1)]
