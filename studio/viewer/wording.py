"""How states, commands and numbers read on screen. Everything that reaches HTML passes `text`."""

import html
import math

from morph_core.protocol import Status

GREEN, AMBER, RED, GREY, BLUE = (
    "light-dark(#1f7a4a, #6fcf97)", "light-dark(#8a5a00, #e6c15c)", "light-dark(#b3261e, #ff8a80)",
    "light-dark(#5b6570, #a9b1ba)", "light-dark(#2467ad, #7db8f2)",
)  # fmt: skip
"""CSS colours of words, one for the light theme and one for the dark: each 4.5 times as bright as its ground, or as
dark."""

_GREEN, _AMBER, _RED, _GREY, _BLUE = "#1f7a4a", "#8a5a00", "#b3261e", "#5b6570", "#2467ad"
STATUS_COLOURS: dict[Status, str] = {
    "queued": _GREY,
    "starting": _BLUE,
    "running": _GREEN,
    "pausing": _AMBER,
    "paused": _AMBER,
    "stopped": _GREY,
    "finished": _BLUE,
    "failed": _RED,
    "lost": _RED,
    "unreadable": _RED,
}
"""CSS colours on which white can be read."""


def text(value: object) -> str:
    """Return a value as text that is safe in HTML: names and messages come from files that anyone may have written."""
    return html.escape(str(value))


def paragraph(content: str) -> str:
    """Return `content`, which is HTML already, as a paragraph in the type of the panels."""
    return (
        '<div style="font-size:0.8125em;line-height:1.45;margin:0.1em 0.75em 0.5em;overflow-wrap:anywhere">'
        f"{content}</div>"
    )


def wide(content: str) -> str:
    """Return `content`, which is HTML already, as a block without margins of its own, to stand right below another."""
    return f'<div style="margin:0">{content}</div>'


def dim(content: str) -> str:
    """Return `content`, which is HTML already, in a paler shade."""
    return f'<span style="opacity:0.65">{content}</span>'


def swatch(colour: str | tuple[int, int, int]) -> str:
    """Return a small square as HTML, in a CSS colour or in red, green and blue up to 255."""
    css = colour if isinstance(colour, str) else "rgb({}, {}, {})".format(*colour)
    return f'<i style="display:inline-block;width:0.7em;height:0.7em;border-radius:2px;background:{css}"></i>'


def badge(status: Status) -> str:
    """Return a status as HTML: white on its colour."""
    colour = STATUS_COLOURS[status]
    return (
        f'<span style="background:{colour};color:#fff;border-radius:0.6em;padding:0.1em 0.6em;font-weight:600">'
        f"{text(status)}</span>"
    )


def alert(sentence: str, colour: str = RED) -> str:
    """Return a sentence as HTML, in a frame that can't be overlooked."""
    return paragraph(
        f'<div role="alert" style="border-left:4px solid {colour};padding:0.45em 0.7em;border-radius:0.25em;'
        f'background:color-mix(in srgb, {colour} 13%, transparent)">{text(sentence)}</div>'
    )


def size(count: int) -> str:
    """Return a number of bytes in words, such as 12 kB or 1.2 MB."""
    return f"{count / 1000:.0f} kB" if count < 1e6 else f"{count / 1e6:.1f} MB"


def rows(cells: list[tuple[str, str]]) -> str:
    """Return a table as HTML, with names on the left and their values on the right."""
    lines = "".join(
        f'<tr><td style="opacity:0.75;padding-right:0.8em">{text(name)}</td>'
        f'<td style="text-align:right;white-space:nowrap;font-variant-numeric:tabular-nums">{text(value)}</td></tr>'
        for name, value in cells
    )
    return paragraph(f'<table style="width:97%;border-collapse:collapse">{lines}</table>')


def duration(seconds: float | None) -> str:
    """Return a time in words, such as 42 s, 3 min, 1 h 20 min or 3 days, as `page/words.js` has it for the pages."""
    if seconds is None or not math.isfinite(seconds) or seconds < 0:
        return "unknown"
    if seconds < 90:
        return f"{max(1, math.floor(seconds + 0.5))} s"
    minutes = math.floor(seconds / 60 + 0.5)
    if seconds < 5400:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min" if seconds < 172800 else f"{math.floor(seconds / 86400 + 0.5)} days"


def count(number: int) -> str:
    """Return a whole number in short, such as 950, 12.3 k or 1.25 M."""
    if number < 1000:
        return str(number)
    return f"{number / 1e3:.1f} k" if number < 1_000_000 else f"{number / 1e6:.2f} M"


def percent(share: float) -> str:
    """Return a share in percent, such as 42 %."""
    return f"{100 * share:.0f} %"
