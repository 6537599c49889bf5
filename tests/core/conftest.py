"""Small settings, a fragile arm and run folders for the core's tests."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from morph_core.catalogue import make_task
from morph_core.config import Config
from morph_core.protocol import RunRecord
from morph_core.run_folder import RunFolder, create_run
from morph_core.task import Hardware, Transition
from morph_core.tasks.reacher import Reacher

SMALL = Config(
    trajectories=8, epochs=2, minibatches=2, hidden=16, proxy_prefit=20, search_pairs=32, search_generations=3,
    evaluation_interval=2, evaluation_episodes=4, schedule_iterations=10,
)  # fmt: skip


@dataclass(frozen=True)
class Fragile(Reacher):
    """A reacher whose simulation diverges where its first joint has turned by more than `limit` rad: z is NaN."""

    limit: float = 0.6

    def broken(self, s: np.ndarray) -> np.ndarray:
        return np.abs(s[:, 0] - self.start[0]) > self.limit

    def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
        step = super().step(hardware, s, action)
        broken = self.broken(step.s)
        z = np.where(broken[:, None], np.nan, step.z)
        return dataclasses.replace(step, z=z, diverged=broken, terminated=step.terminated & ~broken)


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
