"""What α, the projection and the exploration mean: a sentence and a small picture, shown where they are set."""

import math

from studio.viewer import wording

_TASK, _HARDWARE, _SUM = "#1f9d6b", "#d98200", "#4a8fdb"
"""CSS colours of g_task, of g_hw and of what is followed, to be told apart on the light and on the dark theme."""


def alpha() -> str:
    """Return what α weighs, as HTML."""
    picture = (
        _arrow(8, 50, 28, 12, _TASK) + _arrow(8, 50, 66, 40, _HARDWARE) + _arrow(8, 50, 86, 2, _SUM, 2.5)
        + _line(28, 12, 86, 2) + _line(66, 40, 86, 2)
    )  # fmt: skip
    return _figure(
        picture,
        f"The policy follows {_name('g_task', _TASK)} + α · {_name('g_hw', _HARDWARE)}, {_name('their sum', _SUM)}. "
        "With 0 it cares for its task alone; a larger α draws it to where the proxy is true to Hw-Phy.",
    )


def projection() -> str:
    """Return what the projection takes away, as HTML."""
    picture = (
        _arrow(52, 50, 92, 50, _HARDWARE) + _arrow(52, 50, 14, 12, _TASK, 1.5) + _arrow(52, 50, 52, 12, _SUM, 2.5)
        + _line(16, 12, 52, 12)
    )  # fmt: skip
    return _figure(
        picture,
        f"Where {_name('g_task', _TASK)} points against {_name('g_hw', _HARDWARE)}, its part against it is taken away "
        f"and {_name('the rest', _SUM)} is followed. none: never; as_printed: scaled as in the paper's print.",
    )


def exploration() -> str:
    """Return what is varied between the episodes, as HTML."""
    picture = (
        _arm(8, (24, 14), _TASK) + _arm(8, (38, 24), _SUM) + _arm(8, (32, 40), _HARDWARE)
        + _arm(60, (84, 22), _SUM)
        + f'<circle cx="84" cy="22" r="11" fill="{_HARDWARE}33" stroke="{_HARDWARE}" stroke-dasharray="2 2"/>'
    )  # fmt: skip
    return _figure(
        picture,
        "Left, design: episodes run on Hw-Phy with bodies drawn around φ. Right, gaussian: they run in the proxy's "
        "world, with noise on the hardware's output z; gaussian_iid draws it afresh at each step.",
    )


def _figure(picture: str, sentence: str) -> str:
    """Return a picture of 100 by 56 with a sentence beside it; both are HTML already."""
    return wording.paragraph(
        '<div style="display:flex;gap:0.7em;align-items:center;margin-bottom:0.3em">'
        '<svg viewBox="0 0 100 56" width="86" height="48" role="img" aria-hidden="true" style="flex:none">'
        f'{picture}</svg><span style="opacity:0.8">{sentence}</span></div>'
    )


def _name(words: str, colour: str) -> str:
    return f'<b style="color:{colour}">{wording.text(words)}</b>'


def _line(x: float, y: float, to_x: float, to_y: float) -> str:
    return (
        f'<line x1="{x}" y1="{y}" x2="{to_x}" y2="{to_y}" stroke="currentColor" stroke-opacity="0.5" '
        'stroke-dasharray="3 3"/>'
    )


def _arrow(x: float, y: float, to_x: float, to_y: float, colour: str, width: float = 2.0) -> str:
    angle = math.atan2(to_y - y, to_x - x)
    wings = [(to_x - 7 * math.cos(angle + turn), to_y - 7 * math.sin(angle + turn)) for turn in (-0.4, 0.4)]
    corners = " ".join(f"{a:.1f},{b:.1f}" for a, b in ((to_x, to_y), *wings))
    return (
        f'<line x1="{x}" y1="{y}" x2="{to_x}" y2="{to_y}" stroke="{colour}" stroke-width="{width}"/>'
        f'<polygon points="{corners}" fill="{colour}"/>'
    )


def _arm(x: float, tip: tuple[float, float], colour: str) -> str:
    """Return an arm of two links that stands at `x` on the ground."""
    elbow = (x + 4, 30)
    points = " ".join(f"{a},{b}" for a, b in ((x, 52), elbow, tip))
    return (
        f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2.5" stroke-linecap="round"/>'
        f'<circle cx="{tip[0]}" cy="{tip[1]}" r="3" fill="{colour}"/>'
    )
