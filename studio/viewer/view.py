"""What one browser has chosen to see: the run, the iteration, and what is ticked."""

from collections.abc import Mapping
from typing import Annotated

import msgspec
import viser

from studio.limits import MAX_ITERATIONS

Word = Annotated[str, msgspec.Meta(max_length=128)]
Tick = bool | Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)] | Word
"""The value of a checkbox, a slider or a dropdown."""
Remembered = viser.GuiCheckboxHandle | viser.GuiSliderHandle | viser.GuiDropdownHandle
"""An input whose value is a habit of a person, not a part of a run."""


class View(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What one browser shows. The page keeps it, so that it outlives a reload and a restart of the server."""

    run: Word | None = None
    """The run on screen; None while the start panel is, or before a browser has chosen."""
    iteration: Annotated[int, msgspec.Meta(ge=0, le=MAX_ITERATIONS)] | None = None
    """The iteration on screen; None while the latest one is followed."""
    ticks: Annotated[dict[Word, Tick], msgspec.Meta(max_length=64)] = {}
    """Values of the remembered inputs, by their names."""
    presents: bool = False
    """Whether the page is in presenter's mode: large words over the scene, and no panels."""


class Seen(View, frozen=True, kw_only=True):
    """What one browser shows, or showed last, and whether it is connected."""

    connected: bool = False


def ticks_of(handles: Mapping[str, Remembered]) -> dict[str, Tick]:
    """Return the values of inputs by their names."""
    return {name: handle.value for name, handle in handles.items()}


def put_back(handles: Mapping[str, Remembered], ticks: Mapping[str, Tick]) -> None:
    """Give inputs their remembered values; what an input does not offer, or no longer, is left out."""
    for name, value in ticks.items():
        match handles.get(name), value:
            case viser.GuiCheckboxHandle() as box, bool():
                box.value = value
            case viser.GuiDropdownHandle() as choice, str() if value in choice.options:
                choice.value = value
            case viser.GuiSliderHandle() as slider, float() if slider.min <= value <= slider.max:
                slider.value = value
