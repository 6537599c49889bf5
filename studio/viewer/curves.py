"""Small curves of a sweep: success and return along one design parameter, as HTML beside its slider."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from morph_core.what_if import Measured
from studio.viewer import wording
from studio.what_if import SweepPoint

SUCCESS, RETURN = wording.GREEN, wording.BLUE
_WIDTH, _HEIGHT, _EDGE = 300.0, 44.0, 3.0
_PLACE = "position:relative;margin:-0.1em 15.2% 0.7em 24.4%"
"""Style that puts the curves below the track of their slider, so that both have one scale."""
_AXIS = (
    "position:absolute;right:100%;top:0;bottom:0;padding-right:0.4em;font-size:0.65em;line-height:1.1;"
    "white-space:nowrap;display:flex;flex-direction:column;justify-content:space-between;text-align:right"
)
_GROUND = f"width:100%;height:{_HEIGHT:g}px;display:block;background:rgba(128,138,150,0.12);border-radius:3px"


@dataclass(frozen=True)
class Scale:
    """Range of the returns of a sweep, which all of its curves share, so that parameters can be compared."""

    lo: float
    hi: float

    def share(self, value: float) -> float:
        """Return the place of a return in the range, from 0 to 1; the middle if the range has no width."""
        return (value - self.lo) / (self.hi - self.lo) if self.hi > self.lo else 0.5


def scale_of(points: Iterable[SweepPoint]) -> Scale | None:
    """Return the range of the returns that were measured, or None if none was."""
    returns = [point.measured.episode_return for point in points if point.measured]
    return Scale(min(returns), max(returns)) if returns else None


def legend_of_curves(scale: Scale, episodes: int, policy: str) -> str:
    """Return as HTML what the curves mean, which were measured with the sampled or the deterministic policy."""
    colours = (
        f"{wording.swatch(SUCCESS)} success, 0 to 100 % &emsp; "
        f"{wording.swatch(RETURN)} return, {_number(scale.lo)} to {_number(scale.hi)}"
    )
    said = (
        f"{policy} policy, {episodes} episodes at each value; pale: 95 % interval; upright line: this body; "
        "hatched: can't be put together; faded: another slider was moved since"
    )
    return wording.paragraph(f"{colours}<br>{wording.dim(said)}")


def curves_of(points: Sequence[SweepPoint], scale: Scale, now: float, box: tuple[float, float], *, faded: bool) -> str:
    """Return the curves of one parameter as HTML; `now` is its value on screen, `box` its lowest and highest one.

    Where a design can't be built, the curves have a gap and the ground is hatched. They are `faded` where another
    parameter has been changed since.
    """
    lo, hi = box
    known = sorted(points, key=lambda point: point.value)

    def x(value: float) -> float:
        return _EDGE + (_WIDTH - 2 * _EDGE) * (value - lo) / (hi - lo)

    shapes = [_hatched(x, p.value, (hi - lo) / 16) for p in known if p.measured is None]
    for run in _stretches(known):
        shapes += _curve(run, x, RETURN, lambda m: scale.share(m.episode_return), lambda m: _shares(scale, m))
        shapes += _curve(run, x, SUCCESS, lambda m: m.success, lambda m: m.success_interval)
    here = x(min(max(now, lo), hi))
    shapes.append(f'<line x1="{here:.1f}" x2="{here:.1f}" y1="0" y2="{_HEIGHT:g}" stroke="currentColor"/>')
    axis = "".join(f"<span>{share}</span>" for share in ("100 %", "0 %"))
    return (
        f'<div style="{_PLACE}"><div style="{_AXIS};color:{SUCCESS}">{axis}</div>'
        '<svg role="img" aria-label="success and return along the parameter" preserveAspectRatio="none" '
        f'viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" style="{_GROUND}">'
        f'<g opacity="{0.35 if faded else 1}">{"".join(shapes)}</g></svg></div>'
    )


def _curve(
    run: Sequence[tuple[float, Measured]],
    x: Callable[[float], float],
    colour: str,
    middle: Callable[[Measured], float],
    ends: Callable[[Measured], tuple[float, float]],
) -> list[str]:
    """Return a line with its band; a single point is a dot, which is a line of no length with round ends."""
    width = 6 if len(run) == 1 else 2
    line = [f"{x(value):.1f},{_y(middle(m)):.1f}" for value, m in run]
    upper = [f"{x(value):.1f},{_y(ends(m)[1]):.1f}" for value, m in run]
    lower = [f"{x(value):.1f},{_y(ends(m)[0]):.1f}" for value, m in reversed(run)]
    return [
        f'<polygon points="{" ".join(upper + lower)}" fill="{colour}" opacity="0.18"/>',
        f'<polyline points="{" ".join(line * 2 if len(line) == 1 else line)}" fill="none" stroke="{colour}" '
        f'stroke-width="{width}" stroke-linecap="round" vector-effect="non-scaling-stroke"/>',
    ]


def _stretches(points: Sequence[SweepPoint]) -> list[list[tuple[float, Measured]]]:
    """Return the stretches of neighbouring points that were all measured."""
    found: list[list[tuple[float, Measured]]] = [[]]
    for point in points:
        if point.measured is None:
            found.append([])
        else:
            found[-1].append((point.value, point.measured))
    return [run for run in found if run]


def _hatched(x: Callable[[float], float], value: float, half: float) -> str:
    left, right = max(_EDGE, x(value - half)), min(_WIDTH - _EDGE, x(value + half))
    lines = "".join(
        f'<line x1="{left + i * (right - left) / 5:.1f}" x2="{left + (i + 1) * (right - left) / 5:.1f}" '
        f'y1="{_HEIGHT:g}" y2="0"/>'
        for i in range(5)
    )
    return f'<g stroke="{wording.GREY}" opacity="0.45">{lines}</g>'


def _shares(scale: Scale, m: Measured) -> tuple[float, float]:
    lo, hi = m.return_interval
    return scale.share(lo), scale.share(hi)


def _y(share: float) -> float:
    return _EDGE + (_HEIGHT - 2 * _EDGE) * (1 - min(max(share, 0.0), 1.0))


def _number(value: float) -> str:
    return f"{value:.3g}".replace("-", "−")
