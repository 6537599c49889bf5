"""The caption over the scene: which run is seen, how far it is, how often it succeeds, and what has changed."""

import msgspec
import numpy as np
import viser

from morph_core.catalogue import make_task
from morph_core.history import History
from studio.viewer.film import Clip
from studio.viewer.parts import Entry, Quantity, quantities_of
from studio.viewer.scene import Host
from studio.viewer.wording import percent

_CHANGES = 2
"""Largest number of design parameters of which it is said how they have changed."""
_NODE = "/caption"
"""Name of the scene's node that carries the caption to the page round the viewer."""


class Caption(msgspec.Struct, frozen=True, kw_only=True):
    """What the page writes over the scene. The page finds it as the text of an invisible node of the scene, so that it
    changes in the moment in which the body does."""

    label: str
    """Words on what is seen, such as that it was recorded."""
    presents: bool = False
    """Whether the page is in presenter's mode: large words, no panels."""
    title: str = ""
    iteration: str = ""
    success: str = ""
    detail: str = ""
    """Words on how the success was measured."""
    change: str = ""
    """Words on how the design differs from the initial one, in lines."""
    playing: str = ""
    """Words on the episode that is played; empty where none is."""
    enter: str = ""
    """Words on what the key Enter does; empty where it does nothing."""


class CaptionNode:
    """The node of the scene that carries the caption."""

    def __init__(self, host: Host) -> None:
        """Show no caption yet."""
        self._host = host
        self._node: viser.LabelHandle | None = None
        self._shown: Caption | None = None

    def show(self, caption: Caption | None) -> None:
        """Show a caption, or none."""
        if caption == self._shown:
            return
        self._shown = caption
        text = msgspec.json.encode(caption).decode() if caption else ""
        if self._node is None:
            self._node = self._host.scene.add_label(_NODE, text, visible=False)
        else:
            self._node.text = text


def caption_of(
    history: History, iteration: int, label: str, *, presents: bool, enter: str, clip: Clip | None = None
) -> Caption:
    """Return the caption over the design of an iteration of a run."""
    said = [e for e in history.evaluations if e.iteration <= iteration]
    success, detail = "not tried yet", ""
    if said:
        last, share = said[-1], said[-1].sampled_success
        success = f"success {percent(share)}"
        of = f"{round(share * last.episodes)} of {last.episodes} episodes" if last.episodes else "sampled episodes"
        detail = f"{of} on Hw-Phy, iteration {last.iteration}"
    return Caption(
        label=label,
        presents=presents,
        title=make_task(history.record.task, history.record.task_options).title,
        iteration=f"iteration {iteration} of {max(history.planned_iterations or 0, history.iteration)}",
        success=success,
        detail=detail,
        change=change_words(history, iteration),
        playing=clip.words if clip else "",
        enter=enter,
    )


def change_words(history: History, iteration: int) -> str:
    """Return in words what has changed most of the initial design, a line each, such as "finger 1: length 12.0 → 39.5
    cm"."""
    _, phi = history.design(str(iteration))
    change = phi - history.initial_phi
    entries = [(quantity, entry) for quantity in quantities_of(history) for entry in quantity.entries]
    entries.sort(key=lambda both: -abs(change[both[1].index] / both[1].scale))
    said = [_words(*both, history.initial_phi, phi) for both in entries[:_CHANGES] if change[both[1].index]]
    return "\n".join(said) or "the initial design"


def _words(quantity: Quantity, entry: Entry, initial: np.ndarray, phi: np.ndarray) -> str:
    before, now, unit = float(initial[entry.index]), float(phi[entry.index]), quantity.unit
    both = f"{unit.number(before)} → {unit.words(now)}" if before else unit.change(now)
    name = "" if entry.part.startswith(quantity.name) else f"{quantity.name} "
    return f"{entry.part}: {name}{both}"
