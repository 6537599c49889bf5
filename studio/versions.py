"""The versions of Python and of packages, and the processor, for the record of a run and of an export."""

import contextlib
import importlib.metadata
import platform

from morph_core.processor import instruction_set, processor


def versions_of(*packages: str) -> dict[str, str]:
    """Return the versions of Python and of those packages that are installed, without importing them."""
    found = {"python": platform.python_version()}
    for name in packages:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def hardware() -> dict[str, str]:
    """Return what the last bits of results depend on beside the versions: the processor and its instruction set."""
    return {"processor": processor(), "instruction_set": instruction_set()}
