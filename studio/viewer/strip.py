"""The strip above the iteration slider: the marks of a run, drawn to the scale of its iterations, with their legend."""

from collections.abc import Iterable, Sequence

from studio.moments import MEANINGS, Kind, Mark
from studio.viewer import wording

_SHAPES: dict[Kind, tuple[str, str, int]] = {
    "starred": ("★", "#c9a400", 0),
    "best": ("★", "#17a673", 0),
    "command": ("◆", "#2f7fd1", 1),
    "freeze": ("■", "#8a6be0", 1),
    "restart": ("▲", "#e07b00", 1),
    "resume": ("▶", "#7a828e", 1),
    "episode": ("|", "#7a828e", 2),
}
"""Sign and colour of each kind of mark, told apart by colour-blind people too, and the row it stands in."""
_BASELINES = (13, 27, 39)
"""Baseline of each row of the strip, in pixels."""
_HEIGHT, _MARGIN = 42, 10
_PLACES = 150
"""Number of places along the strip; marks of one kind at one place are drawn as one."""
_MOST_WORDS = 4
"""Largest number of marks that the tooltip of one place tells of."""


def strip(marks: Sequence[Mark], first: int, last: int) -> str:
    """Return the marks of the iterations `first` to `last` as HTML."""
    drawn = "".join(_signs(marks, kind, first, last) for kind in _SHAPES)
    axis = f'<line x1="0" x2="100%" y1="{_HEIGHT - 1}" y2="{_HEIGHT - 1}" stroke="currentColor" opacity="0.4"/>'
    return _framed(f'<svg width="100%" height="{_HEIGHT}" style="overflow:visible" role="img" '
                   f'aria-label="what happened in the run, by iteration">{axis}{drawn}</svg>')  # fmt: skip


def pointer(shown: int, first: int, last: int) -> str:
    """Return as HTML the triangle below the strip that points at the iteration that is shown."""
    return _framed(
        f'<svg width="100%" height="11" style="overflow:visible;display:block">'
        f'<text x="{_place(shown, first, last):.2f}%" y="9" text-anchor="middle" font-size="11" fill="{wording.BLUE}">▲'
        f"<title>iteration {shown}</title></text></svg>"
    )


def key_of(marks: Iterable[Mark]) -> str:
    """Return the legend of the kinds of marks that there are, as HTML."""
    kinds = {mark.kind for mark in marks}
    entries = (
        f'<span style="white-space:nowrap;margin-right:0.8em"><b style="color:{colour}">{sign}</b> '
        f"{wording.text(MEANINGS[kind])}</span>"
        for kind, (sign, colour, _) in _SHAPES.items()
        if kind in kinds
    )
    return wording.paragraph(" ".join(entries))


def _framed(content: str) -> str:
    return f'<div style="margin:0 {_MARGIN + 4}px;line-height:0">{content}</div>'


def _place(iteration: int, first: int, last: int) -> float:
    """Return where an iteration stands along the strip, in percent."""
    return 100 * (iteration - first) / max(1, last - first)


def _signs(marks: Sequence[Mark], kind: Kind, first: int, last: int) -> str:
    sign, colour, row = _SHAPES[kind]
    places: dict[int, list[Mark]] = {}
    for mark in marks:
        if mark.kind == kind and first <= mark.iteration <= last:
            places.setdefault(round(_place(mark.iteration, first, last) * _PLACES / 100), []).append(mark)
    size, opacity = (8, 0.75) if kind == "episode" else (13, 1)
    return "".join(
        f'<text x="{_place(together[-1].iteration, first, last):.2f}%" y="{_BASELINES[row]}" text-anchor="middle" '
        f'font-size="{size}" fill="{colour}" opacity="{opacity}" style="cursor:default">{sign}'
        f"<title>{_words(together)}</title></text>"
        for together in places.values()
    )


def _words(marks: Sequence[Mark]) -> str:
    told = [mark.words for mark in marks[:_MOST_WORDS]]
    rest = [f"and {len(marks) - _MOST_WORDS} more"] if len(marks) > _MOST_WORDS else []
    return wording.text("\n".join([*told, *rest]))
