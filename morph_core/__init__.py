"""MORPH (He and Ciocarlie, ICRA 2024): a robot's body and its controller, co-optimised with reinforcement learning.

A run in three lines: `task = make_task("reacher")`, `method = make_method("morph", task)`, and a loop over
`method.iterations(task, start(task, method, seed=0))`, which yields one `Progress` per iteration.

Public names: `make_task`, `make_method` and `start`; the registries `TASKS`, `METHODS`, `EXPLORATIONS` and `SEARCHES`,
which list what there is by name; `RunFolder` and `History`, which read a recorded run.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from morph_core.catalogue import EXPLORATIONS as EXPLORATIONS
    from morph_core.catalogue import METHODS as METHODS
    from morph_core.catalogue import SEARCHES as SEARCHES
    from morph_core.catalogue import TASKS as TASKS
    from morph_core.catalogue import make_method as make_method
    from morph_core.catalogue import make_task as make_task
    from morph_core.history import History as History
    from morph_core.run_folder import RunFolder as RunFolder
    from morph_core.state import start as start

_HOMES = {
    **dict.fromkeys(("TASKS", "METHODS", "EXPLORATIONS", "SEARCHES", "make_method", "make_task"), "catalogue"),
    "History": "history",
    "RunFolder": "run_folder",
    "start": "state",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for: a reader of runs needs no torch."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"morph_core.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """Name what `__getattr__` gives, too, so that completion shows it."""
    return sorted({*globals(), *_HOMES})
