"""Can a fixed hand do its task at all? Search targets for its servos, without feedback, by CMA-ES.

`python tests/bench/reachable.py mouse_click --lengths 0.12 0.26` prints a row per link length and seed: the return, and
in what share of fresh episodes the best schedule found lifts and holds. A hand that can do it this way may still be
hard to learn; one that can't, can't be ruled out.
"""

import json
import time
from dataclasses import dataclass, field

import cma
import numpy as np
import tyro

from morph_core.catalogue import make_task
from morph_core.tasks.grasp import GraspTask


@dataclass(frozen=True)
class Reachable:
    """Which hands to try, and how hard."""

    task: tyro.conf.Positional[str]
    lengths: tuple[float, ...] = (0.12, 0.26)
    """m: both links of every finger."""
    option: dict[str, str] = field(default_factory=dict)
    """Task options, such as --option width 0.3."""
    waypoints: int = 5
    """Targets of every servo along the episode; straight lines between them."""
    population: int = 48
    generations: int = 80
    sigma: float = 0.35
    """sigma0, in radians and tenths of a metre."""
    seeds: tuple[int, ...] = (0, 1)
    episodes: int = 128
    """Fresh episodes of the best schedule."""


@dataclass(frozen=True)
class Outcome:
    """What episodes came to, (N,) each."""

    returns: np.ndarray
    lifted: np.ndarray  # in at least half of the last ten control steps
    held: np.ndarray  # the same, with the button pressed


def play(task: GraspTask, phi: np.ndarray, schedules: np.ndarray, rng: np.random.Generator) -> Outcome:
    """Run an episode of each schedule (N, waypoints, joints): targets in m and rad relative to the start posture."""
    hw_phy = task.hw_phy(phi)
    s = task.reset(hw_phy, len(schedules), rng)
    k, waypoints = task.hand.joints, schedules.shape[1]
    knots = s[:, None, :k] + np.pad(schedules, ((0, 0), (1, 0), (0, 0)))
    largest = np.array([task.palm_step, *[task.joint_step] * (k - 1)])
    transitions, diverged = [], np.zeros(len(s), dtype=bool)
    for t in range(1, task.horizon + 1):
        i, share = divmod(t / task.horizon * waypoints, 1)
        before, after = knots[:, int(i)], knots[:, min(int(i) + 1, waypoints)]
        transitions.append(task.step(hw_phy, s, (before + share * (after - before) - s[:, :k]) / largest))
        s, diverged = transitions[-1].s, diverged | transitions[-1].diverged
    returns = np.where(diverged, 0.0, sum(t.reward for t in transitions))
    lifted, held = np.array([(t.milestones["lifted"], t.success) for t in transitions]).transpose(1, 0, 2)
    return Outcome(returns, task.solved(lifted) & ~diverged, task.solved(held) & ~diverged)


def search(task: GraspTask, phi: np.ndarray, options: Reachable, seed: int) -> np.ndarray:
    """Return the mean schedule (waypoints, joints) at the end of the search; a candidate is one episode."""
    rng = np.random.default_rng(seed)
    unit = np.array([0.1, *[1.0] * (task.hand.joints - 1)])
    shape = (-1, options.waypoints, task.hand.joints)
    settings = {"popsize": options.population, "seed": seed + 1, "verbose": -9, "CMA_diagonal": True}
    es = cma.CMAEvolutionStrategy(np.zeros(options.waypoints * task.hand.joints), options.sigma, settings)
    for _ in range(options.generations):
        candidates = es.ask()
        schedules = unit * np.reshape(candidates, shape)
        es.tell(candidates, list(-play(task, phi, schedules, rng).returns))
    return unit * np.reshape(es.mean, shape)[0]


def main(options: Reachable) -> None:
    chosen = {name: json.loads(value) for name, value in options.option.items()}
    for length in options.lengths:
        task = make_task(options.task, {**chosen, "initial_length": length})
        if not isinstance(task, GraspTask):
            raise SystemExit(f"{options.task} is no task of a hand")
        phi = task.design_space.initial
        for seed in options.seeds:
            began = time.process_time()
            schedule = search(task, phi, options, seed)
            fresh = np.tile(schedule, (options.episodes, 1, 1))
            last = play(task, phi, fresh, np.random.default_rng([seed, 1]))
            print(
                f"length {length:.2f} seed {seed}: return {last.returns.mean():6.2f}, lifted {last.lifted.mean():.2f}, "
                f"held {last.held.mean():.2f}; {time.process_time() - began:.0f} CPU-s",
                flush=True,
            )


if __name__ == "__main__":
    main(tyro.cli(Reachable, description=__doc__))
