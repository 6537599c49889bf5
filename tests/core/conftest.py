"""Small settings and run folders for the core's tests."""

import dataclasses
import time
from pathlib import Path

import pytest

from morph_core.config import Config
from morph_core.protocol import RunRecord
from morph_core.run_folder import RunFolder, create_run
from morph_core.tasks import make_task

SMALL = Config(
    trajectories=8, epochs=2, minibatches=2, hidden=16, proxy_prefit=20, search_pairs=32, search_generations=3,
    evaluation_interval=2, evaluation_episodes=4, schedule_iterations=10,
)  # fmt: skip


@pytest.fixture
def small() -> Config:
    """A config whose iterations take milliseconds."""
    return SMALL


def make_run(
    runs: Path, name: str = "run", method: str = "morph", seed: int = 0, iterations: int = 6, config: Config = SMALL
) -> RunFolder:
    """Return a fresh run folder of the reacher."""
    record = RunRecord(
        id=name, task="reacher", method=method, seed=seed, iterations=iterations, config=dataclasses.asdict(config),
        parameters=list(make_task("reacher").design_space.parameters), versions={}, created=time.time(),
    )  # fmt: skip
    return create_run(runs, record)
