"""How honest the reacher's sweep is: re-sweep what trained policies executed, ten times finer.

`python tests/bench/resweep.py RUNS...` with the run folders of a study of the reacher.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro

from morph_core.catalogue import read_method
from morph_core.checkpoint import load_checkpoint
from morph_core.episodes import evaluate
from morph_core.rollout import Rollout
from morph_core.run_folder import RunFolder
from morph_core.tasks.reacher import LINKS, Reacher

FINER = 10


@dataclass(frozen=True)
class Resweep:
    """Which policies to test."""

    checkpoints: tyro.conf.Positional[tuple[Path, ...]]
    episodes: int = 256


def deepest_penetration(task: Reacher, phi: np.ndarray, rollout: Rollout) -> float:
    """Return the largest depth (m) of any link in a wall along the executed moves, in fine steps."""
    arm = task.hw_phy(phi)
    worst = -np.inf
    for s, a in zip(rollout.s[rollout.alive], rollout.a[rollout.alive], strict=True):
        q = s[:LINKS].copy()
        for j in reversed(range(LINKS)):
            swing = abs(a[j]) * phi[j:].sum()  # at least as far as any point moves
            postures = np.repeat(q[None], 1 + int(FINER * swing / task.sweep_resolution), 0)
            postures[:, j] += np.linspace(0, 1, len(postures) + 1)[1:] * a[j]
            worst = max(worst, float(task.walls.depth(*arm.outline(postures).T).max()))
            q[j] += a[j]
    return worst


def main(options: Resweep) -> None:
    torch.set_num_threads(1)
    task = Reacher()
    finer = replace(task, sweep_resolution=task.sweep_resolution / FINER)
    print("policy | success | with the finer sweep | deepest link in a wall (m), over 32 episodes")
    for path in options.checkpoints:
        folder = RunFolder(path)
        state, _ = load_checkpoint(folder, folder.checkpoint_iterations()[-1], task, read_method(folder.record()))
        success = {}
        for sampled in (True, False):
            for world in (task, finer):
                rng = np.random.default_rng(1)
                score, _ = evaluate(world, state.control.policy, state.phi, options.episodes, rng, sampled)
                success[sampled, world.sweep_resolution] = score.success
        _, rollout = evaluate(task, state.control.policy, state.phi, 32, np.random.default_rng(2), sampled=True)
        columns = [
            f"sampled {success[True, step]:.3f} det {success[False, step]:.3f}"
            for step in (task.sweep_resolution, finer.sweep_resolution)
        ]
        print(path.name, *columns, f"{deepest_penetration(task, state.phi, rollout):.3f}", sep=" | ", flush=True)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Resweep, description=__doc__)))
