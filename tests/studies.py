"""Studies made up for the tests: run folders as trainers leave them, whose curves rise, stall or break off."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from morph_core.catalogue import make_method, make_task
from morph_core.config import recorded
from morph_core.protocol import FORMAT, Evaluation, Progress, RunRecord, StateChanged, Status
from morph_core.run_folder import EventLog, create_run, write_episode
from studio.study.plan import PlannedRun, PlannedTask, Study, Variant, plan_study

STEPS = 8000
"""Environment steps of an iteration."""
PACE = 12.0
"""How suddenly success rises, per budget."""


@dataclass(frozen=True)
class Made:
    """A variant, and how its runs shall come out."""

    label: str
    method: str
    settings: dict[str, object] = field(default_factory=dict)
    top: float = 1.0
    """Success that its runs come to."""
    rises_at: float = 0.5
    """Share of the budget after which half of `top` is reached."""
    negative: float = 0.6
    """Share of gradient steps with a negative cosine."""
    together: bool = True
    """Whether the proxy's loss and the search cost fall together."""


MADE = (
    Made("paper", "morph", {"exploration": "gaussian", "projection": "one_sided"}, 0.99, 0.45, 0.64),
    Made("paper,projection=none", "morph", {"exploration": "gaussian"}, 0.97, 0.5, 0.42),
    Made("studio", "morph", {}, 1.0, 0.3, 0.93),
    Made("direct", "direct", {}, 0.99, 0.35),
    Made("cmaes_rl", "cmaes_rl", {}, 0.3, 0.7),
    Made("no_hw_opt", "no_hw_opt", {}, 0.0, 0.5),
)


def write_study(
    directory: Path,
    made: Sequence[Made] = MADE,
    seeds: Sequence[int] = (0, 1, 2),
    tasks: Sequence[str] = ("reacher",),
    iterations: int = 30,
    status: Status | dict[tuple[str, int], Status | None] = "finished",
    level: float = 0.95,
    episodes: bool = False,
) -> Study:
    """Write a study and its runs; `status` says by label and seed how a run ended, None for one without a folder."""
    variants = [Variant(m.label, m.method, m.settings) for m in made]
    study = plan_study(
        [PlannedTask(task) for task in tasks], variants, seeds, env_steps=iterations * STEPS, level=level
    )
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "study.json").write_bytes(msgspec.json.encode(study))
    by_label = {m.label: m for m in made}
    for planned in study.runs:
        ended = status.get((planned.variant, planned.seed), "finished") if isinstance(status, dict) else status
        if ended is not None:
            _write_run(directory, planned, by_label[planned.variant], iterations, ended, episodes)
    return study


def _write_run(
    directory: Path, planned: PlannedRun, made: Made, iterations: int, ended: Status, episodes: bool
) -> None:
    task = make_task(planned.task)
    method = make_method(made.method, task, made.settings)
    space = task.design_space
    record = RunRecord(
        format=FORMAT, id=planned.run, task=planned.task, method=made.method, seed=planned.seed, iterations=iterations,
        env_steps=iterations * STEPS, final_episodes=256, config=recorded(method), parameters=list(space.parameters),
        versions={"python": "3.11"}, created=time.time(),
    )  # fmt: skip
    folder = create_run(directory, record)
    log = EventLog(folder)
    log.append(StateChanged(status="starting", iteration=0))
    log.append(StateChanged(status="running", iteration=0))
    rng = np.random.default_rng([planned.seed, len(made.label)])
    goal = space.clip(space.initial + rng.normal(0, 1, len(space)) * space.scale)
    late = rng.normal(0, 0.05)
    learns = made.method != "no_hw_opt"
    proxy = made.method == "morph"
    whole = iterations if ended == "finished" else iterations // 2
    for i in range(1, whole + 1):
        share = i / iterations
        way = 1 / (1 + np.exp(-PACE * (min(share, 0.9) - made.rises_at - late)))  # phi stands still at last
        phi = (space.initial + learns * way * (goal - space.initial)).tolist()
        success = float(np.clip(made.top * way * 1.02 + rng.normal(0, 0.01), 0, 1))
        steps, cpu = i * STEPS, 0.4 * i
        fall = float(np.exp(-3 * share) * np.exp(rng.normal(0, 0.1)))
        log.append(
            Progress(
                iteration=i, env_steps=steps, phi=phi, episode_return=-1 + success, success=success,
                policy_std=0.5 - 0.3 * share, cpu_seconds=cpu, relabelled_steps=200 * i * proxy,
                search_steps=900 * i * proxy,
                divergence=fall if proxy else None,
                search_cost=(2 * fall if made.together else 1.0 + share) if proxy else None,
                cosine=0.5 - made.negative + rng.normal(0, 0.05) if proxy else None,
                cosine_negative=float(np.clip(made.negative + rng.normal(0, 0.05), 0, 1)) if proxy else None,
            )
        )  # fmt: skip
        if i % 5 == 0:
            name = None
            if episodes and i == whole:
                name = write_episode(folder, i, {"qpos": np.zeros((2, 5)), "phi": np.array(phi)})
            log.append(_evaluation(i, steps, phi, success, cpu, 64, False, name, planned.task))
    if ended == "finished":
        log.append(_evaluation(whole, whole * STEPS, phi, success, cpu + 1, 256, True, None, planned.task))
    if ended != "running":
        log.append(StateChanged(status=ended, iteration=whole, message="disk full" if ended == "failed" else ""))
    log.close()


def _evaluation(
    i: int, steps: int, phi: list[float], success: float, cpu: float, count: int, final: bool, name: str | None,
    task: str,
) -> Evaluation:  # fmt: skip
    share = round(success * count) / count
    return Evaluation(
        iteration=i, env_steps=steps, phi=phi, sampled_success=share, sampled_return=-1 + 1.2 * success,
        deterministic_success=round(0.9 * success * count) / count, deterministic_return=-1 + success,
        episode=name, cpu_seconds=cpu, episodes=count, final=final,
        milestones={} if task == "reacher" else {"lifted": min(1.0, 1.1 * share), "pressed": share},
    )  # fmt: skip
