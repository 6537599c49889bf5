"""How two designs differ, as a table in HTML: success, return, what the reward is made of, phi and masses."""

from collections.abc import Callable

from morph_core.history import History
from studio.compare import Compared, Side
from studio.viewer import wording
from studio.viewer.parts import quantities_of

_CELL = (
    "text-align:right;white-space:nowrap;vertical-align:top;padding:0.05em 0 0.05em 0.7em;"
    "font-variant-numeric:tabular-nums"
)
_TABLE = "width:97%;border-collapse:collapse;line-height:1.3"
_RULE = "border-top:1px solid rgba(128,138,150,0.35)"
_UNKNOWN = wording.dim("unknown")


def comparison_table(
    found: Compared, history: History, looks: tuple[str, str], tint: tuple[int, int, int] | None
) -> str:
    """Return the table; `looks` say how A and B are told apart in the scene, where B may have a tint.

    `history` is of a run of the same task, and says in which unit each design parameter is read.
    """
    rows = [_row("", [_heading(found.a, "A", looks[0], None), _heading(found.b, "B", looks[1], tint), "<b>B − A</b>"])]
    rows += [*_outcome_rows(found), *_phi_rows(found, history), *_mass_rows(found)]
    notes = [side.note for side in (found.a, found.b) if side.note]
    said = "".join(f"{wording.text(note)}.<br>" for note in notes)
    said += "".join(f"{letter}: {wording.text(side.run)}<br>" for letter, side in (("A", found.a), ("B", found.b)))
    said += "sampled policy on Hw-Phy, [intervals] at 95 %; terms of the reward add up to the return"
    return wording.paragraph(f'<table style="{_TABLE}">{"".join(rows)}</table>{wording.dim(said)}')


def _heading(side: Side, letter: str, look: str, tint: tuple[int, int, int] | None) -> str:
    swatch = f"{wording.swatch(tint)} " if tint else ""
    return f"{swatch}<b>{letter}</b> {wording.dim(wording.text(look))}<br>iteration {side.iteration}"


def _outcome_rows(found: Compared) -> list[str]:
    a, b, more = found.a, found.b, found.differences
    rows = [
        _row("<b>success</b>", [_success(a), _success(b), _known(more.success, _points)], ruled=True),
        _row("return", [_return(a), _return(b), _known(more.episode_return, _signed)]),
    ]
    for term in dict.fromkeys((*a.reward_terms, *b.reward_terms)):
        values = [_known(side.reward_terms.get(term), _number) for side in (a, b)]
        rows.append(_row(f"&ensp;{_words(term)}", [*values, _known(more.reward_terms.get(term), _signed)]))
    return rows


def _phi_rows(found: Compared, history: History) -> list[str]:
    names, a, b = history.design_space.names, found.a.phi, found.b.phi
    rows = []
    for quantity in quantities_of(history):
        for entry in quantity.entries:
            name = names[entry.index]
            values = [_known(phi.get(name), quantity.unit.words) for phi in (a, b)]
            label = f"{wording.swatch(entry.colour)} {wording.text(f'{entry.part} {quantity.name}')}"
            change = _known(found.differences.phi.get(name), quantity.unit.change)
            rows.append(_row(label, [*values, change], ruled=not rows))
    return rows


def _mass_rows(found: Compared) -> list[str]:
    a, b, more = found.a, found.b, found.differences
    heaviest = max(a.mass or 0.0, b.mass or 0.0)
    factor, unit = (1.0, "kg") if heaviest >= 1 else (1000.0, "g")

    def mass(value: float) -> str:
        return f"{factor * value:.3g} {unit}"

    def change(value: float) -> str:
        return f"{factor * value:+.3g} {unit}".replace("-", "−")

    rows = [_row("<b>mass</b>", [_known(a.mass, mass), _known(b.mass, mass), _known(more.mass, change)], ruled=True)]
    for body in dict.fromkeys((*a.masses, *b.masses)):
        values = [_known(side.masses.get(body), mass) for side in (a, b)]
        rows.append(_row(f"&ensp;{_words(body)}", [*values, _known(more.masses.get(body), change)]))
    return rows


def _row(name: str, cells: list[str], *, ruled: bool = False) -> str:
    style = f' style="{_RULE}"' if ruled else ""
    return "".join(
        [f'<tr{style}><td style="opacity:0.85">{name}</td>', *(f'<td style="{_CELL}">{c}</td>' for c in cells), "</tr>"]
    )


def _known(value: float | None, words: Callable[[float], str]) -> str:
    return _UNKNOWN if value is None else words(value)


def _success(side: Side) -> str:
    if side.success is None:
        return _UNKNOWN
    ends = side.success_interval
    interval = wording.dim(f"<br>[{100 * ends[0]:.0f}, {100 * ends[1]:.0f}]") if ends else ""
    return f"<b>{wording.percent(side.success)}</b>{interval}"


def _return(side: Side) -> str:
    if side.episode_return is None:
        return _UNKNOWN
    ends = side.return_interval
    interval = wording.dim(f"<br>[{', '.join(map(_number, ends))}]") if ends else ""
    return f"{_number(side.episode_return)}{interval}"


def _words(name: str) -> str:
    return wording.text(name.replace("_", " "))


def _number(value: float) -> str:
    return f"{value:.2f}".replace("-", "−")


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−")


def _points(difference: float) -> str:
    """Return a difference of two shares in percentage points."""
    return f"{100 * difference:+.0f} points".replace("-", "−")
