"""Tables as HTML, in which runs and designs show themselves in a notebook; whatever they are told is escaped."""

from collections.abc import Iterable, Sequence
from html import escape

_CAPTION = "caption-side:top;text-align:left;font-weight:bold;padding:0.3em 0"


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> str:
    """Return a table as HTML: names in the first column, on the left, and numbers in the others, on the right."""
    above = f'<caption style="{_CAPTION}">{escape(caption)}</caption>' if caption else ""
    head = f"<thead>{_line('th', headings)}</thead>" if any(headings) else ""
    return f"<table>{above}{head}<tbody>{''.join(_line('td', row) for row in rows)}</tbody></table>"


def _line(tag: str, cells: Sequence[str]) -> str:
    sides = ("left", *["right"] * (len(cells) - 1))
    written = (
        f'<{tag} style="text-align:{side}">{escape(cell)}</{tag}>' for side, cell in zip(sides, cells, strict=True)
    )
    return f"<tr>{''.join(written)}</tr>"
