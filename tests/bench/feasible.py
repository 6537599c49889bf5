"""What share of the reacher's box can pass the tunnel at all: a lower bound by a planner.

For every sampled design a rapidly exploring random tree grows through the task's own `step`, so that each edge is a
move the arm can execute. A design counts as feasible when a node touches the goal within the episode's horizon; one
that does not is only not shown to be. `--fixed` plans for the initial design alone, many trees at once.
"""

import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
import tyro

from morph_core.tasks.reacher import LINKS, Reacher


@dataclass(frozen=True)
class Feasible:
    """How hard to look."""

    designs: int = 256
    nodes: int = 3000
    """Nodes per tree."""
    tunnel: Literal["zigzag", "paper"] = "zigzag"
    fixed: bool = False
    """Plan for the initial design only: `designs` independent trees for it."""
    goal_bias: float = 0.5
    """Share of expansions from the node that is nearest to the goal along the centre line."""
    seed: int = 0


def progress_along(task: Reacher, tip: np.ndarray) -> np.ndarray:
    """Return (...) how far a tip (..., 2) is from the goal: the way along the centre line, plus what it is off it."""
    walls = task.walls
    line = np.array([*zip(walls.xs, walls.ys, strict=True), walls.goal])
    segments = np.linalg.norm(np.diff(line, axis=0), axis=1)
    ahead = np.append(np.cumsum(segments[::-1])[::-1], 0.0)
    return np.min(np.linalg.norm(tip[..., None, :] - line, axis=-1) + ahead, axis=-1)


def plan(task: Reacher, designs: np.ndarray, options: Feasible, rng: np.random.Generator) -> np.ndarray:
    """Return (N,) bool: for which designs (N, d) a way was found."""
    count, rows = len(designs), np.arange(len(designs))
    arm = task.hw_phy(designs)
    first = task.reset(arm, count, rng)
    nodes = np.zeros((options.nodes, count, task.state_size))
    depth = np.zeros((options.nodes, count), dtype=int)
    cost = np.full((options.nodes, count), np.inf)
    nodes[0], cost[0] = first, progress_along(task, first[:, LINKS : LINKS + 2])
    found = np.zeros(count, dtype=bool)
    for n in range(1, options.nodes):
        target = rng.uniform(-1, 1, (count, LINKS)) * np.array([np.pi, 2.8, 2.8, 2.8, 2.8])
        target[:, 0] += np.pi / 2
        distance = np.abs(nodes[:n, :, :LINKS] - target).sum(-1)
        # Greedy growth draws among the best few nodes: the very best is often at a dead end.
        jitter = cost[:n] + rng.exponential(0.3, (n, count))
        usable = depth[:n] < task.horizon
        chosen = np.where(usable, np.where(rng.random(count) < options.goal_bias, jitter, distance), np.inf).argmin(0)
        s = nodes[chosen, rows]
        towards = (target - s[:, :LINKS]) / task.action_scale
        action = np.where(rng.random((count, 1)) < 0.5, towards, rng.uniform(-1, 1, (count, LINKS)))
        step = task.step(arm, s, action)
        nodes[n], depth[n] = step.s, depth[chosen, rows] + 1
        cost[n] = progress_along(task, step.s[:, LINKS : LINKS + 2])
        found |= step.success
    return found


def main(options: Feasible) -> None:
    task = Reacher(tunnel=options.tunnel)
    rng = np.random.default_rng(options.seed)
    space = task.design_space
    designs = rng.uniform(space.lo, space.hi, (options.designs, LINKS))
    if options.fixed:
        designs = np.tile(space.initial, (options.designs, 1))
    began = time.process_time()
    found = plan(task, designs, options, rng)
    share = found.mean()
    error = np.sqrt(share * (1 - share) / len(found))
    what = "trees for the initial design" if options.fixed else "designs drawn from the box"
    print(f"{options.tunnel}: {found.sum()} of {len(found)} {what} pass: {share:.1%} +- {error:.1%}", end="")
    print(f" ({options.nodes} nodes each, {time.process_time() - began:.0f} CPU-s)")


if __name__ == "__main__":
    main(tyro.cli(Feasible, description=__doc__))
