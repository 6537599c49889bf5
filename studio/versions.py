"""The versions of Python and of packages, for the record of a run and of an export."""

import contextlib
import importlib.metadata
import platform


def versions_of(*packages: str) -> dict[str, str]:
    """Return the versions of Python and of those packages that are installed, without importing them."""
    found = {"python": platform.python_version()}
    for name in packages:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found
