"""MORPH (He and Ciocarlie, ICRA 2024): a robot's body and its controller, co-optimised with reinforcement learning.

A run in three lines: `task = make_task("reacher")`, `method = make_method("morph", task)`, and a loop over
`method.iterations(task, start(task, method, seed=0))`, which yields one `Progress` per iteration.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from morph_core.catalogue import EXPLORATIONS, METHODS, SEARCHES, TASKS, make_method, make_task
    from morph_core.history import History
    from morph_core.run_folder import RunFolder
    from morph_core.state import start

__all__ = [
    "EXPLORATIONS", "METHODS", "SEARCHES", "TASKS", "History", "RunFolder", "make_method", "make_task", "start",
]  # fmt: skip

_HOMES = {
    "History": "morph_core.history",
    "RunFolder": "morph_core.run_folder",
    "start": "morph_core.state",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for: a reader of runs needs no torch."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES.get(name, "morph_core.catalogue")), name)


def __dir__() -> list[str]:
    """Name what `__getattr__` gives, too, so that help() and completion show it."""
    return sorted({*globals(), *__all__})
