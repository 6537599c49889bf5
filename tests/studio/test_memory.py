"""Memory that the studio frees goes back to the system."""

import subprocess
import sys

import pytest

FREED = """
import psutil
from studio.memory import map_large_blocks
{call}
bytearray(31 << 20)  # freed at once: glibc keeps blocks of up to this size from now on
before = psutil.Process().memory_info().rss
blocks = [bytearray(b"x") * (1 << 19) for _ in range(200)]
last = bytearray(1 << 17)  # the heap's end stays in use
del blocks
print((psutil.Process().memory_info().rss - before) >> 20)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="an option of glibc")
@pytest.mark.parametrize(("call", "kept"), [("map_large_blocks()", range(-10, 10)), ("", range(50, 200))])
def test_freed_uploads_leave_the_process(call: str, kept: range) -> None:
    child = [sys.executable, "-c", FREED.format(call=call)]
    megabytes = int(subprocess.run(child, capture_output=True, text=True, check=True, timeout=60).stdout)
    assert megabytes in kept, "MB, with the option; and without it, which shows that this test can fail"
