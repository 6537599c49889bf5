"""Gives memory back to the system: what the studio has freed is not kept by the C library."""

import ctypes
import sys

_M_MMAP_THRESHOLD = -3
"""Number of the option in malloc.h of glibc."""
LARGE_BLOCK = 1 << 18
"""Bytes from which a block of memory is mapped by itself; half of a part of an upload, the blocks that come by the
hundred."""


def map_large_blocks() -> None:
    """Let glibc map each large block by itself, so that freeing it gives it back to the system at once.

    Without this glibc raises the size from which it does so to that of the largest block freed yet, up to 32 MiB, and
    keeps smaller ones: after the first abandoned uploads some 200 MB stay with the process. Other C libraries, which
    have no such option, are left as they are.
    """
    if sys.platform != "linux":
        return
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_M_MMAP_THRESHOLD, LARGE_BLOCK)
