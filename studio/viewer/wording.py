"""How states, commands and numbers read on screen. Everything that reaches HTML passes `text`."""

import html
import math

from morph_core.design import DesignSpace
from morph_core.protocol import (
    Acknowledged,
    AnyCommand,
    Checkpoint,
    InjectDesign,
    Lock,
    Pause,
    Resume,
    SetAlpha,
    SetBound,
    SetProjection,
    Status,
    StepIteration,
    Stop,
    Unlock,
)

GREEN, AMBER, RED, GREY, BLUE = "#2b9a5b", "#b97a00", "#d0342c", "#7a828e", "#2f7fd1"
"""CSS colours that can be read on the light and on the dark theme."""

STATUS_COLOURS: dict[Status, str] = {
    "queued": GREY,
    "starting": BLUE,
    "running": GREEN,
    "pausing": AMBER,
    "paused": AMBER,
    "stopped": GREY,
    "finished": BLUE,
    "failed": RED,
    "lost": RED,
    "unreadable": RED,
}


def text(value: object) -> str:
    """Return a value as text that is safe in HTML: names and messages come from files that anyone may have written."""
    return html.escape(str(value))


def paragraph(content: str) -> str:
    """Return `content`, which is HTML already, as a paragraph in the type of the panels."""
    return (
        '<div style="font-size:0.8125em;line-height:1.45;margin:0.1em 0.75em 0.5em;overflow-wrap:anywhere">'
        f"{content}</div>"
    )


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
        f'<div role="alert" style="border-left:4px solid {colour};background:{colour}22;padding:0.45em 0.7em;'
        f'border-radius:0.25em">{text(sentence)}</div>'
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
    """Return a time in words, such as 42 s, 3 min 05 s or 1 h 20 min."""
    if seconds is None or not math.isfinite(seconds) or seconds < 0:
        return "unknown"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def count(number: int) -> str:
    """Return a whole number in short, such as 950, 12.3 k or 1.25 M."""
    if number < 1000:
        return str(number)
    return f"{number / 1e3:.1f} k" if number < 1_000_000 else f"{number / 1e6:.2f} M"


def percent(share: float) -> str:
    """Return a share in percent, such as 42 %."""
    return f"{100 * share:.0f} %"


def phi_in_words(phi: list[float], space: DesignSpace) -> str:
    """Return the values of phi in words, such as "link_1 3 m, link_2 1.5 m"."""
    return ", ".join(f"{p.name} {value:.4g} {p.unit}" for p, value in zip(space.parameters, phi, strict=False))


def describe(command: AnyCommand, space: DesignSpace) -> str:
    """Return what a command does, as a clause in the past tense."""
    units = {p.name: p.unit for p in space.parameters}
    match command:
        case SetBound(name=name, lo=lo, hi=hi):
            return f"bound of {name} set to [{lo:.4g}, {hi:.4g}] {units.get(name, '')}".rstrip()
        case Lock(name=name, value=None):
            return f"{name} locked at its present value"
        case Lock(name=name, value=value):
            return f"{name} locked at {value:.4g} {units.get(name, '')}".rstrip()
        case Unlock(name=name):
            return f"{name} unlocked"
        case SetAlpha(alpha=alpha):
            return f"α set to {alpha:g}"
        case SetProjection(projection=projection):
            return f"projection set to {projection}"
        case InjectDesign(phi=phi):
            return f"design set to {phi_in_words(phi, space)}"
        case Pause():
            return "paused"
        case Resume():
            return "resumed"
        case StepIteration():
            return "one step"
        case Stop():
            return "stopped"
        case Checkpoint():
            return "checkpoint saved"


def acknowledgement(event: Acknowledged, space: DesignSpace) -> str:
    """Return the sentence that tells what became of a command."""
    what = describe(event.command, space)
    if not event.accepted:
        return f"refused: {event.message or 'no reason given'} ({what})"
    if isinstance(event.command, Pause | Stop | Checkpoint):
        return f"{what} after iteration {event.iteration}"
    if isinstance(event.command, Resume):
        return f"{what} at iteration {event.iteration}"
    return f"{what}, in force from iteration {event.iteration + 1}"
