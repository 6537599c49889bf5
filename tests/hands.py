"""A run of a hand whose design and policy were trained: they do their task."""

import json
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

from morph_core.catalogue import make_method, make_task
from morph_core.config import recorded
from morph_core.protocol import FORMAT, AnyEvent, Evaluation, Progress, RunRecord, StateChanged
from morph_core.run_folder import EventLog, RunFolder, create_run

_DATA = Path(__file__).parent / "data"


def trained_design(task: str) -> list[float]:
    """Return the design with which the policy in `tests/data` was trained."""
    return json.loads((_DATA / f"{task}_policy" / "phi.json").read_bytes())


def write_trained_run(runs: Path, task: str, name: str = "trained-hand") -> RunFolder:
    """Return a run folder with one iteration: a design of a hand, its evaluation and the policy that does the task."""
    folder = write_hand_run(runs, task, trained_design(task), name)
    checkpoint = folder.path / "checkpoints" / "000001"
    checkpoint.mkdir(parents=True)
    shutil.copy(_DATA / f"{task}_policy" / "weights.safetensors", checkpoint)
    return folder


def write_hand_run(
    runs: Path, task: str, phi: list[float], name: str = "hand", *, iterations: int = 1, events: Sequence[AnyEvent] = ()
) -> RunFolder:
    """Return a run folder of a hand without a checkpoint: what happened in it, by default one iteration with the design
    phi and its evaluation."""
    made = make_task(task)
    record = RunRecord(
        id=name, task=task, method="direct", seed=0, iterations=iterations, format=FORMAT,
        config=recorded(make_method("direct", made)), parameters=list(made.design_space.parameters),
        versions={"python": "3"}, created=time.time(),
    )  # fmt: skip
    folder = create_run(runs, record)
    log = EventLog(folder)
    log.append(StateChanged(status="starting", iteration=0))
    for event in events or _one_iteration(phi):
        log.append(event)
    log.append(StateChanged(status="finished", iteration=1, message="as asked"))
    log.close()
    return folder


def _one_iteration(phi: list[float]) -> list[AnyEvent]:
    return [
        Progress(
            iteration=1, env_steps=5120, phi=phi, episode_return=1.0, success=0.9, policy_std=0.5,
            relabelled_steps=0, diverged=0,
        ),
        Evaluation(
            iteration=1, env_steps=5120, phi=phi, sampled_success=0.96, sampled_return=1.0, deterministic_success=0.98,
            deterministic_return=1.0, milestones={"lifted": 1.0, "pressed": 1.0}, diverged=0,
        ),
    ]  # fmt: skip
