"""Settings for all tests."""

import gc
import os
from collections.abc import Iterator

import hypothesis
import pytest

os.environ["OMP_NUM_THREADS"] = "1"  # before torch loads: idle threads that spin slow everything down on two cores

hypothesis.settings.register_profile("studio", deadline=None)  # the first example pays for imports and caches
hypothesis.settings.load_profile("studio")


def pytest_collection_finish() -> None:
    """Let the garbage collector leave alone what stays for all tests: to look through it takes a twentieth of their
    time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module")
def short_episodes() -> Iterator[None]:
    """Let episodes of the reacher end after an eighth of their steps, for runs of which nothing is to be learnt."""
    from morph_core.tasks.reacher import Reacher  # after what is set above

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Reacher, "horizon", Reacher.horizon // 8)
        yield
