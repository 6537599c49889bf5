"""The processor that a trainer runs on: with another kind of it, results can differ in their last bits."""

import platform
import re
from pathlib import Path

_CPUINFO = Path("/proc/cpuinfo")


def processor() -> str:
    """Return the model of this machine's processor, or its architecture where the system does not tell the model."""
    try:
        found = re.search(r"^model name\s*: *(\S.*)$", _CPUINFO.read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1].strip() if found else platform.machine()
