"""The processor that a trainer runs on: with another kind of it, results can differ in their last bits."""

import platform
import re
from pathlib import Path

_CPUINFO = Path("/proc/cpuinfo")


_WIDEST_FIRST = ("avx512f", "avx2", "avx", "sve2", "sve", "asimd")
"""What a processor can compute many numbers at once with; libraries take the widest that it has."""


def processor() -> str:
    """Return the model of this machine's processor, or its architecture where the system does not tell the model."""
    return _told("model name") or platform.machine()


def instruction_set() -> str:
    """Return the architecture and the widest vectors of this machine's processor, such as "x86_64 avx2".

    A seed gives the same phi, to the last bit, only on one kind of processor.
    """
    has = {*_told("flags").split(), *_told("Features").split()}
    return " ".join([platform.machine(), *[name for name in _WIDEST_FIRST if name in has][:1]])


def _told(name: str) -> str:
    """Return what the system tells of the first core under a name, or nothing."""
    try:
        found = re.search(rf"^{name}[\t ]*: *(\S.*)$", _CPUINFO.read_text(encoding="utf-8", errors="replace"), re.M)
    except OSError:
        return ""
    return found[1].strip() if found else ""
