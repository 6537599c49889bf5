"""Settings for all tests."""

import gc
import os

import hypothesis

os.environ["OMP_NUM_THREADS"] = "1"  # before torch loads: idle threads that spin slow everything down on two cores

hypothesis.settings.register_profile("studio", deadline=None)  # the first example pays for imports and caches
hypothesis.settings.load_profile("studio")


def pytest_collection_finish() -> None:
    """Let the garbage collector leave alone what stays for all tests: to look through it takes a twentieth of their
    time."""
    gc.collect()
    gc.freeze()
