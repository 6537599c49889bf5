"""Seeds of a method on a task, measured on Hw-Phy: `python tests/bench/study.py --help`. Prints rows as they come.

Each row says when the sampled and when the deterministic policy first succeeded in enough of the episodes with the
present phi, in environment steps and CPU seconds of one core, and where the run stood at the end of its budget. Where
Hw-Phy is a simulation, the steps that relabelling and the search for phi took are counted too.
"""

import json
import os
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from morph_core.catalogue import make_method, make_task
from morph_core.checkpoint import save_checkpoint
from morph_core.config import recorded
from morph_core.episodes import evaluate
from morph_core.method import Method
from morph_core.protocol import FORMAT, Progress, RunRecord
from morph_core.run_folder import RunFolder, create_run
from morph_core.state import start
from morph_core.task import Task

FINAL_EPISODES = 256


@dataclass(frozen=True)
class Study:
    """Which runs to make."""

    task: str = "reacher"
    method: str = "morph"
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    env_steps: float = 0.7e6
    """Budget per run."""
    cpu_seconds: float = float("inf")
    """A run ends too when it has taken so long."""
    level: float = 0.95
    """Success of the sampled policy that counts as solved."""
    deterministic_level: float = 0.80
    """The same of the deterministic one."""
    stop: bool = False
    """End a run after two evaluations in a row at `level`."""
    cores: tuple[int, ...] = ()
    """Run on these cores alone, so that several studies can share a machine."""
    set: dict[str, str] = field(default_factory=dict)
    """Settings of the method, such as --set projection one_sided search drift search.ridge 2.5."""
    option: dict[str, str] = field(default_factory=dict)
    """Task options, such as --option tunnel paper."""
    out: Path | None = None
    """Append each row to this file as a line of JSON."""
    checkpoints: Path | None = None
    """Keep each run with its last state as a checkpoint below this folder."""


@dataclass
class Row:
    """What one run came to."""

    method: str
    settings: dict[str, Any]
    seed: int
    env_steps: int = 0
    cpu_seconds: float = 0.0
    sampled_solved: tuple[int, float] | None = None
    """(environment steps, CPU seconds) at the first evaluation with sampled success >= `level`."""
    deterministic_solved: tuple[int, float] | None = None
    curve: list[tuple[int, float, float, float]] = field(default_factory=list)
    """(environment steps, CPU seconds, sampled, deterministic success) of every evaluation."""
    milestones: dict[str, float] = field(default_factory=dict)
    """Share of the final episodes that reached what comes before the goal."""
    diverged: int = 0
    """Episodes whose simulation diverged, in the whole run."""
    restarts: int = 0
    """How often policy and critic started afresh."""
    sampled: float = 0.0
    """Success over the final episodes."""
    deterministic: float = 0.0
    episode_return: float = 0.0
    explored: float = 0.0
    """The largest share of an iteration's trajectories that succeeded."""
    phi: list[float] = field(default_factory=list)
    negative: float | None = None
    """Mean share of gradient steps with a negative cosine."""
    first_divergence: float | None = None
    last_divergence: float | None = None


def run_one(study: Study, settings: dict[str, Any], options: dict[str, Any], seed: int) -> Row:
    """Train one seed within the budget."""
    task = make_task(study.task, options)
    method = make_method(study.method, task, settings)
    kept = keep(study, task, method, options, seed) if study.checkpoints else None
    row = Row(study.method, {**settings, **options}, seed)
    began = time.process_time()
    state = start(task, method, seed)
    history: list[Progress] = []
    simulated = not hasattr(task.hw_phy(state.phi), "jacobian")
    control_start = 0
    for progress in method.iterations(task, state):
        history.append(progress)
        taken = state.env_steps + simulated * (state.relabelled_steps + state.search_steps)
        row.restarts += state.control_start != control_start
        control_start = state.control_start
        if progress.iteration % method.evaluation.interval == 0:
            rng = np.random.default_rng([seed, progress.iteration])
            policy, episodes = state.control.policy, method.evaluation.episodes
            sampled, _ = evaluate(task, policy, state.phi, episodes, rng, sampled=True)
            mean, _ = evaluate(task, policy, state.phi, episodes, rng, sampled=False)
            reached = (taken, time.process_time() - began)
            row.curve.append((*reached, sampled.success, mean.success))
            if sampled.success >= study.level and row.sampled_solved is None:
                row.sampled_solved = reached
            if mean.success >= study.deterministic_level and row.deterministic_solved is None:
                row.deterministic_solved = reached
            if study.stop and len(row.curve) > 1 and min(success for _, _, success, _ in row.curve[-2:]) >= study.level:
                break
        if taken >= study.env_steps or time.process_time() - began >= study.cpu_seconds:
            break
    row.explored = max(p.success for p in history)
    row.env_steps, row.cpu_seconds, row.diverged = taken, time.process_time() - began, state.diverged
    rng = np.random.default_rng([seed, 10**6])
    last, _ = evaluate(task, state.control.policy, state.phi, FINAL_EPISODES, rng, sampled=True)
    row.sampled, row.episode_return, row.phi = last.success, last.episode_return, state.phi.tolist()
    row.milestones = last.milestones
    row.deterministic = evaluate(task, state.control.policy, state.phi, FINAL_EPISODES, rng, sampled=False)[0].success
    if history[-1].cosine_negative is not None:
        row.negative = float(np.mean([p.cosine_negative for p in history]))
        row.first_divergence, row.last_divergence = (
            float(np.mean([p.divergence for p in part])) for part in (history[:5], history[-5:])
        )
    if kept:
        save_checkpoint(kept, state, row.cpu_seconds)
    return row


def keep(study: Study, task: Task, method: Method, options: dict[str, Any], seed: int) -> RunFolder:
    """Write the folder of a run whose last state will be kept; RunFolderError where one of this name is there."""
    assert study.checkpoints
    record = RunRecord(
        format=FORMAT, id=f"{method.name}-s{seed}", task=task.name, task_options=options, method=method.name, seed=seed,
        iterations=1, config=recorded(method), parameters=list(task.design_space.parameters), versions={},
        created=time.time(),
    )  # fmt: skip
    return create_run(study.checkpoints, record)


def main(study: Study) -> None:
    torch.set_num_threads(1)
    if study.cores:
        os.sched_setaffinity(0, study.cores)
    settings = {name: _parse(value) for name, value in study.set.items()}
    options = {name: _parse(value) for name, value in study.option.items()}
    rows = []
    for seed in study.seeds:
        row = run_one(study, settings, options, seed)
        rows.append(row)
        print(_line(row, study), flush=True)
        if study.out:
            with study.out.open("a") as file:
                file.write(json.dumps(asdict(row)) + "\n")
    for label, name in (
        (f"sampled >= {study.level:g}", "sampled_solved"),
        (f"deterministic >= {study.deterministic_level:g}", "deterministic_solved"),
    ):
        reached = [getattr(row, name) for row in rows if getattr(row, name)]
        print(f"{label}: {len(reached)} of {len(rows)} seeds", end="")
        if reached:
            steps, cpu = np.median(reached, axis=0)
            print(f", median {steps / 1e6:.2f} M steps, {cpu:.1f} CPU-s", end="")
        print()


def _line(row: Row, study: Study) -> str:
    def when(reached: tuple[int, float] | None) -> str:
        return f"{reached[0] / 1e6:.2f} M ({reached[1]:.0f} s)" if reached else "never"

    milestones = "".join(f"{name} {share:.2f} " for name, share in row.milestones.items())
    extra = ""
    if row.negative is not None:
        extra = f" | negative {row.negative:.2f} D {row.first_divergence:.2f} -> {row.last_divergence:.2f}"
    return (
        f"{row.method} {row.settings} s{row.seed}: {row.env_steps / 1e6:.2f} M {row.cpu_seconds:.0f} CPU-s | "
        f"sampled {study.level:g} {when(row.sampled_solved)}, det {study.deterministic_level:g} "
        f"{when(row.deterministic_solved)} | end sampled {row.sampled:.2f} det {row.deterministic:.2f} "
        f"return {row.episode_return:.2f} {milestones}explored <= {row.explored:.3f} restarts {row.restarts} "
        f"diverged {row.diverged}{extra} | "
        f"phi {np.round(row.phi, 2).tolist()}"
    )


def _parse(value: str) -> Any:
    try:
        return json.loads(value)
    except json.JSONDecodeError:
        return value


if __name__ == "__main__":
    main(tyro.cli(Study, description=__doc__))
