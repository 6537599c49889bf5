"""Run at every start of Python (by morph-studio.pth): the tasks are registered as soon as Gymnasium is imported.

Gymnasium has loaded no plug-ins since 1.0: without this, make("morph/Reacher-v0") would need an import of ours first.
All that happens at a start is that one object begins to watch for one import; it must stay cheap and harmless.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False  # as typing has it, whose import would take most of the time
if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec
    from types import ModuleType
    from typing import Any

_WATCHED = "gymnasium.envs"


class _Watch:
    """A finder that finds nothing itself, and lets the import that it watches for be followed by the registration."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if name != _WATCHED:
            return None
        sys.meta_path.remove(self)
        from importlib.util import find_spec

        spec = find_spec(name)
        if spec and spec.loader:
            _follow(spec.loader)
        return spec


def _follow(loader: Any) -> None:
    execute = loader.exec_module

    def exec_module(module: ModuleType) -> None:
        execute(module)
        _register()

    loader.exec_module = exec_module


def _register() -> None:
    try:
        import morph_core.registration  # noqa: F401 - it registers them
    except Exception as error:  # Gymnasium must be importable whatever is the matter here
        import warnings

        warnings.warn(f"the tasks of morph-studio are not registered in Gymnasium: {error!r}", stacklevel=2)


def watch() -> None:
    """Watch for the import of Gymnasium, unless it has been imported or is watched for already."""
    if _WATCHED not in sys.modules and not any(isinstance(finder, _Watch) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Watch())


watch()
