"""The tasks by name. One file = one task."""

import dataclasses
from collections.abc import Mapping

from morph_core.task import Task
from morph_core.tasks.mouse_click import MouseClick
from morph_core.tasks.pen_press import PenPress
from morph_core.tasks.reacher import Reacher

TASKS: dict[str, type] = {"reacher": Reacher, "pen_press": PenPress, "mouse_click": MouseClick}


def make_task(name: str, options: Mapping[str, object] | None = None) -> Task:
    """Return the task `name` with its dataclass fields set to `options`; ValueError lists the choices."""
    if name not in TASKS:
        raise ValueError(f'unknown task "{name}"; choose from: {", ".join(sorted(TASKS))}')
    allowed = [field.name for field in dataclasses.fields(TASKS[name]) if field.init]
    for option in options or {}:
        if option not in allowed:
            raise ValueError(f'{name} has no option "{option}"; choose from: {", ".join(allowed)}')
    return TASKS[name](**(options or {}))
