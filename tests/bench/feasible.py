"""What share of the reacher's box can pass the tunnel at all: a lower bound by searching with trained policies.

Designs are drawn uniformly from the box and each is tried by several policies, many sampled episodes each: those of
the newest checkpoints of the given runs, and one that is trained here on the box itself, a new
design every episode. A design that touches the goal once is feasible; one that never does is only not shown to be.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

from morph_core.catalogue import make_method, read_method
from morph_core.checkpoint import load_checkpoint
from morph_core.exploration import run_trajectories
from morph_core.networks import Policy
from morph_core.rollout import collect
from morph_core.run_folder import RunFolder
from morph_core.state import start
from morph_core.tasks.reacher import LINKS, Reacher


@dataclass(frozen=True)
class Feasible:
    """How hard to look."""

    checkpoints: tyro.conf.Positional[tuple[Path, ...]] = ()
    designs: int = 512
    episodes: int = 16
    """Episodes per design and policy."""
    iterations: int = 150
    """Iterations for which a policy is trained on the box itself."""
    tunnel: Literal["zigzag", "paper"] = "zigzag"
    seed: int = 0


def draw(task: Reacher, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return designs (N, 5) m, uniform in the box."""
    return rng.uniform(task.design_space.lo, task.design_space.hi, (count, LINKS))


def train_on_the_box(task: Reacher, iterations: int, seed: int) -> Policy:
    """Return a policy that has met a new design in every episode."""
    method = make_method("no_hw_opt", task)
    state = start(task, method, seed)
    for iteration in range(1, iterations + 1):
        state.set_learning_rates(method, iteration)
        rollout = run_trajectories(
            task, state, task.hw_phy(draw(task, method.trajectories, state.rng)), method.trajectories
        )
        state.control.learn(state, rollout, iteration)
    return state.control.policy


def touches(task: Reacher, policy: Policy, designs: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return (N,) bool: which designs touched the goal in one sampled episode each."""
    hw_phy = task.hw_phy(designs)
    start_states = task.reset(hw_phy, len(designs), rng)
    return collect(task, lambda observation: policy.act(observation, rng), hw_phy, start_states).successes


def main(options: Feasible) -> None:
    torch.set_num_threads(1)
    task, rng, began = Reacher(tunnel=options.tunnel), np.random.default_rng(options.seed), time.process_time()
    policies = {"trained on the box": train_on_the_box(task, options.iterations, options.seed)}
    for path in options.checkpoints:
        folder = RunFolder(path)
        state, _ = load_checkpoint(folder, folder.checkpoint_iterations()[-1], task, read_method(folder.record()))
        policies[path.name] = state.control.policy
    designs = draw(task, options.designs, rng)
    initial = np.tile(task.design_space.initial, (options.designs, 1))
    found, found_initial = np.zeros(options.designs, dtype=bool), 0
    for name, policy in policies.items():
        passed = np.zeros_like(found)
        for _ in range(options.episodes):
            passed |= touches(task, policy, designs, rng)
            found_initial += int(touches(task, policy, initial, rng).sum())
        found |= passed
        print(f"{name}: {passed.sum()} of {options.designs} designs", flush=True)
    share = found.mean()
    error = np.sqrt(share * (1 - share) / len(found))
    tried = options.designs * options.episodes * len(policies)
    print(f"{options.tunnel}: at least {share:.1%} +- {error:.1%} of the box passes ({len(policies)} policies)")
    print(f"the initial design: {found_initial} touches in {tried} episodes; {time.process_time() - began:.0f} CPU-s")


if __name__ == "__main__":
    main(tyro.cli(Feasible, description=__doc__))
