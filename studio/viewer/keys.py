"""The keyboard and the command palette: what can be done without a mouse, and by which key."""

import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import viser
from viser._messages import HotkeyKey

_BY_CHARACTER = (",", ".")
"""Keys that viser's type does not list, though its page takes any key by the character that it types."""
Do = Callable[[viser.ClientHandle | None], object]


@dataclass(frozen=True)
class Deed:
    """Something that can be done from the command palette, and by keys that are pressed alone."""

    label: str
    do: Do
    keys: Sequence[str] = ()
    icon: viser.IconName | None = None


def add_deeds(gui: viser.GuiApi, deeds: Sequence[Deed]) -> None:
    """Register deeds; a second key of a deed has a second line in the palette, as viser knows one key for each."""
    for deed in deeds:
        for key in deed.keys or (None,):
            assert key is None or key in (*typing.get_args(HotkeyKey), *_BY_CHARACTER), key
            command = gui.add_command(deed.label, hotkey=key, icon=deed.icon)  # pyright: ignore[reportArgumentType]
            command.on_trigger(_on_trigger(deed.do))


def _on_trigger(do: Do) -> Callable[[viser.CommandEvent], None]:
    return lambda event: typing.cast(None, do(event.client))
