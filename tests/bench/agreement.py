"""Does morph move phi as a direct design gradient would? `python tests/bench/agreement.py pen_press` prints a cosine.

While morph trains, the natural-evolution step of the very episodes between two searches (that of `direct`, E[A (phi_i -
phi)]) is set beside the step that the search takes from the proxy, both in units of each parameter's scale.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import tyro

from morph_core import morph as algorithm
from morph_core.catalogue import make_method, make_task
from morph_core.explorations.design import Design
from morph_core.methods.proxy import Morph
from morph_core.rollout import Rollout
from morph_core.state import State, start
from morph_core.task import Task


@dataclass(frozen=True)
class Agreement:
    """What to train, and how long."""

    task: tyro.conf.Positional[str] = "pen_press"
    seeds: tuple[int, ...] = (0, 1)
    iterations: int = 80
    every: int = 10
    """Iterations that a row sums up."""


@dataclass(frozen=True)
class Steps:
    """Of phi in one search, (d,) in units of scale."""

    iteration: int
    taken: np.ndarray
    direct: np.ndarray


def watched(task: Task, method: Morph, state: State, iterations: int) -> Iterator[Steps]:
    """Train, and yield both steps at every search for phi."""
    exploration, scale, asked = method.exploration, task.design_space.scale, np.zeros(len(task.design_space))
    assert isinstance(exploration, Design)
    collect = algorithm.run_trajectories

    def run_trajectories(*arguments: Any) -> Rollout:
        rollout = collect(*arguments)
        if rollout.holds_enough and state.explored is not None:
            advantage = exploration.advantage(rollout.returns)
            asked[:] += (advantage[:, None] * (state.explored[rollout.kept] - state.phi)).mean(0) / scale
        return rollout

    algorithm.run_trajectories = run_trajectories
    try:
        before = state.phi
        for progress in method.iterations(task, state):
            if progress.search_cost is not None:
                yield Steps(progress.iteration, (state.phi - before) / scale, asked.copy())
                before, asked[:] = state.phi, 0
            if progress.iteration >= iterations:
                return
    finally:
        algorithm.run_trajectories = collect


def cosine(one: np.ndarray, other: np.ndarray) -> float:
    return float(one @ other / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-12))


def main(options: Agreement) -> None:
    torch.set_num_threads(1)
    task = make_task(options.task)
    method = make_method("morph", task)
    if not isinstance(method, Morph) or not isinstance(method.exploration, Design):
        raise SystemExit(f"{options.task} is not explored by design")
    for seed in options.seeds:
        steps = list(watched(task, method, start(task, method, seed), options.iterations))
        for first in range(1, options.iterations + 1, options.every):
            some = [s for s in steps if first <= s.iteration < first + options.every]
            if not some:
                print(f"s{seed} iterations {first}-{first + options.every - 1}: no search, phi is frozen")
                continue
            each = np.mean([cosine(s.taken, s.direct) for s in some])
            taken, direct = sum(s.taken for s in some), sum(s.direct for s in some)
            print(
                f"s{seed} iterations {first}-{first + options.every - 1}: cosine of single steps {each:+.2f}, of their "
                f"sum {cosine(taken, direct):+.2f}; length of the sum {np.linalg.norm(taken):.2f} against "
                f"{np.linalg.norm(direct):.2f} scales",
                flush=True,
            )


if __name__ == "__main__":
    main(tyro.cli(Agreement, description=__doc__))
