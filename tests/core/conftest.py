"""Small methods, a fragile arm and run folders for the core's tests."""

import dataclasses
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from morph_core.catalogue import configured, make_task
from morph_core.config import recorded
from morph_core.method import Method
from morph_core.methods.cmaes_rl import CmaesRl
from morph_core.methods.direct import Direct
from morph_core.methods.no_hw_opt import NoHwOpt
from morph_core.methods.proxy import Morph
from morph_core.methods.transform2act import Transform2Act
from morph_core.methods.value_gradient import ValueGradient
from morph_core.parts import Evaluation, Ppo, ProxyFit, Schedule
from morph_core.protocol import FORMAT, RunRecord
from morph_core.run_folder import RunFolder, create_run
from morph_core.searches.cma import Cma
from morph_core.searches.drift import Drift
from morph_core.searches.gradient import Gradient
from morph_core.task import Hardware, Transition
from morph_core.tasks.reacher import Reacher

_NO_HW_OPT = NoHwOpt(
    trajectories=8,
    hidden=16,
    schedule=Schedule(iterations=10),
    ppo=Ppo(epochs=2, minibatches=2),
    evaluation=Evaluation(interval=2, episodes=4),
)
SMALL = Morph(**vars(_NO_HW_OPT), proxy=ProxyFit(prefit=20), search=Cma(pairs=32, generations=3))
_SMALL: Mapping[str, Method] = {
    method.name: method
    for method in (
        SMALL,
        CmaesRl(**vars(_NO_HW_OPT), candidate_iterations=2),
        Direct(**vars(_NO_HW_OPT)),
        _NO_HW_OPT,
        Transform2Act(**vars(_NO_HW_OPT)),
        ValueGradient(**vars(_NO_HW_OPT)),
    )
}


def small_method(name: str = "morph", settings: Mapping[str, object] | None = None) -> Method:
    """Return a method whose iterations take milliseconds, with settings under dotted names on top."""
    return configured(_SMALL[name], settings or {}, (Drift(pairs=32), Gradient(pairs=32)))


def small_morph(settings: Mapping[str, object] | None = None) -> Morph:
    """Return the method of the paper with iterations of milliseconds, with settings under dotted names on top."""
    method = small_method("morph", settings)
    assert isinstance(method, Morph)
    return method


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


def rewrite(checkpoint: Path, **facts: object) -> None:
    """Change facts of a checkpoint, as versions wrote it that knew no checksums; what is None is left out."""
    path = checkpoint / "state.json"
    changed = json.loads(path.read_text()) | facts | {"sha256": None, "weights_sha256": None}
    path.write_text(json.dumps({name: value for name, value in changed.items() if value is not None}))


def make_run(
    runs: Path, name: str = "run", method: Method = SMALL, seed: int = 0, iterations: int = 6, **ends: int
) -> RunFolder:
    """Return a fresh run folder of the reacher."""
    record = RunRecord(
        format=FORMAT, id=name, task="reacher", method=method.name, seed=seed, iterations=iterations,
        config=recorded(method), parameters=list(make_task("reacher").design_space.parameters), versions={},
        created=time.time(), **ends,
    )  # fmt: skip
    return create_run(runs, record)
