"""What a hand's training spends beside MuJoCo: `python tests/bench/hands.py pen_press`.

Collecting episodes with the policy, and stepping the task through the same actions without one, against the same
control signals written into a bare `mujoco.batch.Batch`: the same models, start states and threads, so the same physics
to the last bit; the sides take turns. Then the parts of a short morph run, by the trainer's CPU seconds.
"""

import itertools
import os
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco.batch
import numpy as np
import torch
import tyro

from morph_core import morph as algorithm
from morph_core.catalogue import make_method, make_task
from morph_core.control import Control
from morph_core.exploration import run_trajectories
from morph_core.explorations.design import Design
from morph_core.hw_nn import HwNN
from morph_core.methods.proxy import Morph
from morph_core.rollout import Rollout
from morph_core.state import State, start
from morph_core.tasks.grasp import GraspTask
from morph_core.tasks.simulation import SUBSTEPS, HandPhysics

PARTS: tuple[tuple[Any, str, str], ...] = (
    (State, "fit_proxy", "first fit"),
    (Design, "world", "designs drawn and compiled"),
    (algorithm, "run_trajectories", "trajectories"),
    (algorithm, "relabel_on_hardware", "relabelling for Eq. 2"),
    (Control, "learn", "policy and critic"),
    (HwNN, "improve", "proxy"),
    (algorithm, "relabel", "search for phi"),
    (algorithm, "derive_design", "search for phi"),
)
"""What Algorithm 1 calls: where it is, its name, and what it is counted as."""


@dataclass(frozen=True)
class Hands:
    """What to measure."""

    task: tyro.conf.Positional[str] = "pen_press"
    rounds: int = 5
    """Collections per side."""
    iterations: int = 10
    """Of the morph run."""


@dataclass(frozen=True)
class Seconds:
    """Of one side, summed."""

    wall: float
    cpu: float


def timed(action: Callable[[], Any]) -> tuple[Any, Seconds]:
    wall, cpu = time.perf_counter(), time.process_time()
    result = action()
    return result, Seconds(time.perf_counter() - wall, time.process_time() - cpu)


def bare(task: GraspTask, designs: np.ndarray, s: np.ndarray, ctrl: np.ndarray) -> Callable[[], np.ndarray]:
    """Return what steps a bare batch through control signals (T, N, joints) and returns the last qpos."""
    models = [task.scene(phi).compile() for phi in designs]
    threads = min(len(os.sched_getaffinity(0)), len(s))
    batch = mujoco.batch.Batch(models[0], len(s), nthread=threads)
    batch.set_models(models)
    qpos, live_ctrl = batch.bind("qpos"), batch.bind("ctrl")
    for name, part in zip(("qpos", "qvel", "qacc_warmstart"), task.split(s), strict=True):
        batch.bind(name)[:] = part

    def run() -> np.ndarray:
        for signals in ctrl:
            live_ctrl[:] = signals
            batch.step(nstep=SUBSTEPS)
        return qpos

    return run


def stepped(task: GraspTask, physics: HandPhysics, rollout: Rollout) -> None:
    """Step the task through a rollout's actions."""
    s = rollout.s[0]
    for action in rollout.action:
        s = task.step(physics, s, action).s


def compare(task: GraspTask, method: Morph, rounds: int) -> None:
    """Print the steps per second of both sides and their ratio."""
    state = start(task, method, 0)
    spread = method.exploration.spread(method.schedule, 1, frozen=False)
    sides: dict[str, list[Seconds]] = defaultdict(list)
    steps, identical = 0, True
    for _ in range(rounds):
        world, compiled = timed(lambda: method.exploration.world(task, state, spread, method.trajectories))
        assert isinstance(world, HandPhysics)
        rollout, seconds = timed(lambda world=world: run_trajectories(task, state, world, method.trajectories))
        sides["compiling the designs"].append(compiled)
        sides["collecting"].append(seconds)
        s, a = rollout.s, rollout.a
        ctrl = np.clip(s[..., : task.hand.joints] + a, *task.hand.joint_range.T)
        # Episodes left out were stepped too: the others get the time of as many as were collected.
        share = rollout.episodes / max(1, rollout.kept.sum())
        physics = task.hw_phy(world.phi[rollout.kept])
        _, seconds = timed(lambda physics=physics, rollout=rollout: stepped(task, physics, rollout))
        sides["stepping"].append(Seconds(seconds.wall * share, seconds.cpu * share))
        last, seconds = timed(bare(task, world.phi[rollout.kept], s[0], ctrl))
        sides["bare"].append(Seconds(seconds.wall * share, seconds.cpu * share))
        identical &= np.array_equal(last, task.qpos(rollout.last_s))
        steps += rollout.episodes * task.horizon
    total = {side: Seconds(sum(x.wall for x in each), sum(x.cpu for x in each)) for side, each in sides.items()}
    print(f"{task.name}: {method.trajectories} designs at once, {len(os.sched_getaffinity(0))} threads")
    for side in ("collecting", "stepping", "bare"):
        wall, cpu = steps / total[side].wall, steps / total[side].cpu
        print(f"{side}: {wall:,.0f} environment steps/s, {cpu:,.0f} per CPU second")
    print(f"same last postures: {identical}")
    for side in ("collecting", "stepping"):
        extra = (100 * (getattr(total[side], unit) / getattr(total["bare"], unit) - 1) for unit in ("wall", "cpu"))
        print("{} takes {:+.1f} % wall, {:+.1f} % CPU of the bare batch".format(side, *extra))
    print(f"compiling, besides: {100 * total['compiling the designs'].cpu / total['bare'].cpu:.1f} % (cpu) of it")


def spend(task: GraspTask, method: Morph, iterations: int) -> None:
    """Print the share of each part of a morph run."""
    spent: dict[str, float] = defaultdict(float)

    def watched(function: Callable[..., Any], part: str) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            result, seconds = timed(lambda: function(*arguments, **named))
            spent[part] += seconds.cpu
            return result

        return call

    for owner, name, part in PARTS:
        setattr(owner, name, watched(getattr(owner, name), part))
    state = start(task, method, 0)
    _, whole = timed(lambda: list(itertools.islice(method.iterations(task, state), iterations)))
    spent["the rest"] = whole.cpu - sum(spent.values())
    print(
        f"{iterations} iterations of morph: {whole.cpu:.1f} CPU-s, {state.env_steps + state.relabelled_steps:,} steps"
    )
    for part, seconds in sorted(spent.items(), key=lambda item: -item[1]):
        print(f"  {100 * seconds / whole.cpu:5.1f} %  {part}")


def main(options: Hands) -> None:
    torch.set_num_threads(1)
    task = make_task(options.task)
    if not isinstance(task, GraspTask):
        raise SystemExit(f"{options.task} is no task of a hand")
    method = make_method("morph", task)
    assert isinstance(method, Morph)
    compare(task, method, options.rounds)
    spend(task, method, options.iterations)


if __name__ == "__main__":
    main(tyro.cli(Hands, description=__doc__))
