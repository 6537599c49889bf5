"""The terms of the reward over an episode, stacked, as HTML under the time slider; and a cursor at the present time."""

from collections.abc import Mapping

import numpy as np

from studio.viewer import wording
from studio.viewer.parts import COLOURS

_WIDTH, _HEIGHT = 300.0, 58
_PLACE = "position:relative;margin:0 67px 0 119px"
"""Style that puts the chart below the track of the time slider, so that both have one scale."""
_AXIS = (
    "position:absolute;right:100%;top:0;bottom:0;padding-right:0.4em;font-size:0.65em;line-height:1;"
    "white-space:nowrap;display:flex;flex-direction:column;justify-content:space-between;text-align:right"
)
_GROUND = f"width:100%;height:{_HEIGHT}px;display:block;background:rgba(128,138,150,0.12);border-radius:3px"


def reward_chart(terms: Mapping[str, np.ndarray], share: float) -> str:
    """Return the chart as HTML: what each term pays at every control step, gains upward and costs downward from zero.

    `terms` are (T,) each; `share` in (0, 1] is the part of the time slider that the episode takes.
    """
    top, bottom = _range(terms)
    above = below = np.zeros(len(next(iter(terms.values()))))
    shapes = []
    for i, term in enumerate(terms.values()):
        for base, part in ((above, np.maximum(term, 0)), (below, np.minimum(term, 0))):
            if part.any():
                shapes.append(_area(base, base + part, (bottom, top), share, COLOURS[i % len(COLOURS)]))
        above, below = above + np.maximum(term, 0), below + np.minimum(term, 0)
    zero = _y(0.0, (bottom, top))
    shapes.append(
        f'<line x1="0" x2="{_WIDTH:g}" y1="{zero:.1f}" y2="{zero:.1f}" stroke="currentColor" opacity="0.5" '
        'vector-effect="non-scaling-stroke"/>'
    )
    axis = f"<span>{_number(top)}</span><span>reward<br>per step</span><span>{_number(bottom)}</span>"
    return wording.wide(
        f'<div style="{_PLACE}"><div style="{_AXIS}">{axis}</div>'
        '<svg role="img" aria-label="terms of the reward over the episode" preserveAspectRatio="none" '
        f'viewBox="0 0 {_WIDTH:g} {_HEIGHT}" style="{_GROUND}">{"".join(shapes)}</svg></div>'
    )


def reward_legend(terms: Mapping[str, np.ndarray]) -> str:
    """Return as HTML which colour is which term, and what each pays over the episode; rewards have no unit."""
    entries = [
        f'<span style="white-space:nowrap;margin-right:0.9em">{wording.swatch(COLOURS[i % len(COLOURS)])} '
        f"{wording.text(name.replace('_', ' '))} {_signed(float(term.sum()))}</span>"
        for i, (name, term) in enumerate(terms.items())
    ]
    total = _signed(float(sum(term.sum() for term in terms.values())))
    said = wording.dim(f'<span style="white-space:nowrap">return {total} in all</span>')
    return wording.paragraph(f"{' '.join(entries)} {said}")


def cursor(share: float) -> str:
    """Return a line as HTML over the chart that stands right above it, at a share in [0, 1] of the time slider."""
    return wording.wide(
        f'<div style="{_PLACE};height:0"><div style="position:absolute;bottom:0;left:{100 * share:.1f}%;width:2px;'
        f'margin-left:-1px;height:{_HEIGHT}px;background:currentColor"></div></div>'
    )


def _range(terms: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """Return the highest sum of gains and the lowest sum of costs of a step."""
    stacked = np.stack(list(terms.values()))
    top, bottom = np.maximum(stacked, 0).sum(0).max(initial=0.0), np.minimum(stacked, 0).sum(0).min(initial=0.0)
    return (float(top), float(bottom)) if top > bottom else (1.0, 0.0)


def _area(base: np.ndarray, edge: np.ndarray, span: tuple[float, float], share: float, colour: str) -> str:
    """Return the area between two stairs (T,), each step of which is a control step wide."""
    x = np.repeat(np.linspace(0, _WIDTH * share, len(base) + 1), 2)[1:-1]
    there = [f"{a:.1f},{_y(b, span):.1f}" for a, b in zip(x, np.repeat(edge, 2), strict=True)]
    back = [f"{a:.1f},{_y(b, span):.1f}" for a, b in zip(x[::-1], np.repeat(base, 2)[::-1], strict=True)]
    return f'<polygon points="{" ".join(there + back)}" fill="{colour}"/>'


def _y(value: float, span: tuple[float, float]) -> float:
    bottom, top = span
    return _HEIGHT * (top - value) / (top - bottom)


def _number(value: float) -> str:
    return f"{value:.2g}".replace("-", "−")


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−")
