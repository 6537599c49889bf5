"""What a browser may put into an element of the viewer: a value of its type, in its range. viser checks neither."""

import math
from collections.abc import Sequence
from typing import Any

import viser

from morph_core.config import LARGEST

LONGEST_TEXT = 1000
"""Largest number of characters that an element for text takes."""


def element_of(server: viser.ViserServer, uuid: object) -> Any:
    """Return what viser keeps of an element, whichever browser it belongs to; None if there is none of that name.

    viser offers no way to ask; the version is pinned and tests/attack/test_viewer_values.py holds it to this.
    """
    for gui in (server.gui, *(client.gui for client in server.get_clients().values())):
        handle = gui._gui_input_handle_from_uuid.get(uuid) if isinstance(uuid, str) else None
        if handle is not None:
            return handle._impl
    return None


def is_there(server: viser.ViserServer, *names: object) -> bool:
    """Tell whether each of some names, where there is one, is that of an element, form or command of some browser.

    What names none is no business of viser's, which would keep some of it for every browser that comes.
    """
    tables = [
        table
        for gui in (server.gui, *(client.gui for client in server.get_clients().values()))
        for table in (gui._gui_input_handle_from_uuid, gui._container_handle_from_uuid, gui._command_handle_from_uuid)
    ]
    return all(name is None or any(name in table for table in tables) for name in names)


def settled(element: Any, value: object) -> object:
    """Return the value as the element may hold it; raise ValueError where it may not.

    What lies outside the range by no more than the browser rounds to is the end of the range.
    """
    present, props = element.value, element.props
    if not hasattr(props, "disabled"):  # a progress bar, which shows and takes nothing
        raise ValueError("this element is no input")
    if (options := getattr(props, "options", None)) is not None:
        return _checked(value, isinstance(value, str) and value in options, "is not offered")
    if isinstance(present, bool):
        return _checked(value, isinstance(value, bool), "is neither on nor off")
    if isinstance(present, str):
        return _checked(value, isinstance(value, str) and len(value) <= LONGEST_TEXT, "is no such text")
    lo, hi = getattr(props, "min", None), getattr(props, "max", None)
    slack = 10.0 ** -getattr(props, "precision", 0) / 2
    if isinstance(present, int | float):
        return _in_range(value, isinstance(present, int), lo, hi, slack)
    if isinstance(present, tuple) and isinstance(value, list | tuple) and len(value) == len(present):
        ends = zip(_each(lo, len(present)), _each(hi, len(present)), strict=True)
        return [
            _in_range(one, isinstance(now, int), low, high, slack)
            for one, now, (low, high) in zip(value, present, ends, strict=True)
        ]
    raise ValueError(f"{_short(value)} is nothing that this element holds")


def _in_range(value: object, whole: bool, lo: float | None, hi: float | None, slack: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{_short(value)} is no number")
    if whole and value != int(value):
        raise ValueError(f"{_short(value)} is no whole number")
    lo, hi = max(-LARGEST, -LARGEST if lo is None else lo), min(LARGEST, LARGEST if hi is None else hi)
    if not lo - slack <= value <= hi + slack:
        raise ValueError(f"{_short(value)} lies outside of {lo:g} to {hi:g}")
    return min(max(value, lo), hi)


def _each(end: float | Sequence[float] | None, count: int) -> Sequence[float | None]:
    return [end] * count if end is None or isinstance(end, int | float) else end


def _checked(value: object, allowed: bool, what: str) -> object:
    if not allowed:
        raise ValueError(f"{_short(value)} {what}")
    return value


def _short(value: object) -> str:
    return repr(value)[:80]
