"""Does morph move phi as a direct design gradient would? `python tests/bench/agreement.py pen_press` prints a cosine.

While morph trains, the natural-evolution step of the very episodes between two searches (that of `direct`, E[A (phi_i -
phi)]) is set beside the step that the search takes from the proxy, both in units of each parameter's scale.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import tyro

from morph_core import morph as method
from morph_core.catalogue import make_task
from morph_core.exploration import episode_advantage
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


def watched(task: Task, state: State) -> list[Steps]:
    """Return the list that is filled while `state` trains."""
    config, scale, steps, asked = task.config, task.design_space.scale, [], np.zeros(len(task.design_space))
    collect: Callable[..., Rollout] = method.run_trajectories
    search: Callable[..., Search] = method.derive_design

    def run_trajectories(*arguments: Any) -> Rollout:
        rollout = collect(*arguments)
        if rollout.holds_enough and state.explored is not None:
            advantage = episode_advantage(rollout.returns, config)
            asked[:] += (advantage[:, None] * (state.explored[rollout.kept] - state.phi)).mean(0) / scale
        return rollout

    def derive_design(task: Task, space: object, dataset: object, phi: np.ndarray, *rest: Any) -> Search:
        found = search(task, space, dataset, phi, *rest)
        steps.append(Steps(state.iteration + 1, (found.phi - phi) / scale, asked.copy()))
        asked[:] = 0
        return found

    method.run_trajectories, method.derive_design = run_trajectories, derive_design
    return steps


def cosine(one: np.ndarray, other: np.ndarray) -> float:
    return float(one @ other / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-12))


def main(options: Agreement) -> None:
    torch.set_num_threads(1)
    task = make_task(options.task)
    originals = method.run_trajectories, method.derive_design
    for seed in options.seeds:
        state = start(task, task.config, seed)
        method.run_trajectories, method.derive_design = originals
        steps = watched(task, state)
        for progress in method.morph(task, task.config, state):
            if progress.iteration >= options.iterations:
                break
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
