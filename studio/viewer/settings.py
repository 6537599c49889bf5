"""The settings of a new run as a form: what the chosen task, method, exploration and search leave to choose."""

import math
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import viser

from morph_core.catalogue import make_method
from morph_core.config import LARGEST_ALPHA
from morph_core.method import Method
from morph_core.task import Task
from studio.fields import Field, chosen_fields, told
from studio.new_run import resettled
from studio.viewer import explain

_PARTS = ("exploration", "search")
"""Fields of a method that are chosen by name in sight; other choices of a plug-in's method are folded away."""


class SettingsForm:
    """A number or a choice for every setting of one method; another task or method makes them anew."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._task: Task | None = None
        self._method: Method | None = None
        self._preset: str | None = None
        self._parent: Method | None = None
        self._more: dict[str, Any] = {}
        """The settings that are folded away, by dotted name."""
        self._folders: list[viser.GuiFolderHandle] = []
        self._filling = False
        self._folding = threading.Lock()
        self.alpha = gui.add_number("α", 1.0, min=0.0, max=LARGEST_ALPHA, step=0.1)
        self._explained = {"alpha": gui.add_html(explain.alpha())}
        self.projection = gui.add_dropdown("projection", [""])
        self._explained["projection"] = gui.add_html(explain.projection())
        self.exploration = gui.add_dropdown("exploration", [""])
        self._explained["exploration"] = gui.add_html(explain.exploration())
        self.search = gui.add_dropdown("search", [""])
        self._slot = gui.add_folder(None)
        for path in _PARTS:
            self._in_sight[path].on_update(lambda _: self._choose_part())

    @property
    def _in_sight(self) -> Mapping[str, Any]:
        """The handles of the settings that stand in sight, where the method has them."""
        return {
            "alpha": self.alpha, "projection": self.projection, "exploration": self.exploration, "search": self.search,
        }  # fmt: skip

    def show(self, task: Task, method: str, preset: str | None = None, parent: Method | None = None) -> None:
        """Show the settings of a method as the preset has them, or, without one, as they were found to work for the
        task; those of a branch that keeps the method of its `parent` as that has them."""
        self._task, self._preset = task, preset
        self._parent = parent if parent and parent.name == method else None
        self._method = self._parent or make_method(method, task, preset=preset)
        fields = {field.name: field for field in chosen_fields(self._method, task)}
        self._filling = True
        for path, handle in self._in_sight.items():
            handle.visible = path in fields
            if path in self._explained:
                self._explained[path].visible = path in fields
            if path in fields:
                field = fields[path]
                if field.choices:
                    handle.options = [str(choice) for choice in field.choices]
                handle.value, handle.hint = field.default, told(field)
        self._filling = False
        self._fold(list(fields.values()))

    def settings(self) -> dict[str, object]:
        """Return the settings that differ from the defaults, or from the parent's, under dotted names."""
        if self._task is None or self._method is None:
            return {}
        usual = {field.name: field.default for field in chosen_fields(self._method, self._task)}
        shown = {path: handle.value for path, handle in self._in_sight.items() if path in usual}
        chosen = {path: value for path, value in shown.items() if value != usual[path]}
        parts = {path: value for path, value in chosen.items() if path in _PARTS}
        made = self._made(self._method.name, self._task, parts)
        defaults = {field.name: field.default for field in chosen_fields(made, self._task)}
        more = {path: handle.value for path, handle in self._more.items() if path in defaults}
        return chosen | {path: value for path, value in more.items() if value != defaults[path]}

    def _choose_part(self) -> None:
        """Show the settings of another exploration or search."""
        if self._filling or self._task is None or self._method is None:
            return
        wanted = {path: self._in_sight[path].value for path in _PARTS if self._in_sight[path].visible}
        try:
            method = self._made(self._method.name, self._task, wanted)
        except ValueError:  # said when the run is started
            return
        self._fold(chosen_fields(method, self._task))

    def _made(self, name: str, task: Task, settings: Mapping[str, object]) -> Method:
        """Return the method with these settings on top of what it begins with; ValueError says what is allowed."""
        if self._parent:
            return resettled(self._parent, task, settings)
        return make_method(name, task, settings, self._preset)

    def _fold(self, fields: Sequence[Field]) -> None:
        """Make the settings that are folded away anew, one folder for each part."""
        with self._folding:  # two browsers' values, or a value and another task, may come at once
            for folder in self._folders:
                folder.remove()
            self._folders = []
            more: dict[str, Any] = {}
            parts: dict[str, list[Field]] = {}
            for field in fields:
                if field.name not in self._in_sight:
                    parts.setdefault(field.name.rpartition(".")[0] or "more settings", []).append(field)
            for part, inside in parts.items():
                with self._slot:
                    self._folders.append(self._gui.add_folder(part.replace("_", " "), expand_by_default=False))
                with self._folders[-1]:
                    more |= {field.name: self._add(field) for field in inside}
            self._more = more

    def _add(self, field: Field) -> Any:
        label = field.name.rpartition(".")[2].replace("_", " ").replace("minibatches", "mini-batches")  # may wrap there
        if field.choices:
            choices = [str(choice) for choice in field.choices]
            return self._gui.add_dropdown(label, choices, initial_value=str(field.default), hint=told(field))
        default: Any = field.default
        lo, hi = (None if limit is None else type(default)(limit) for limit in (field.lo, field.hi))
        return self._gui.add_number(label, default, min=lo, max=hi, step=_step(default), hint=told(field))


def _step(default: float) -> float:
    """Return by how much a click changes a number, which is also how finely it can be typed."""
    if isinstance(default, int):
        return 1
    return 10.0 ** (math.floor(math.log10(abs(default))) - 2) if default else 0.01
