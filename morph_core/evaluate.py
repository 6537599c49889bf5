"""`python -m morph_core.evaluate --run DIR`: success and return of a run's design and policy on Hw-Phy, as JSON."""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import torch

from morph_core.catalogue import make_task, read_method
from morph_core.checkpoint import load_checkpoint
from morph_core.design import DesignSpace
from morph_core.episodes import play, score_of
from morph_core.history import History
from morph_core.networks import Policy
from morph_core.rollout import Rollout
from morph_core.run_folder import RunFolder, RunFolderError
from morph_core.task import Task
from morph_core.what_if import Measured, wilson_interval

MOST_EPISODES = 100_000
"""Largest number of episodes that a design is measured on: they are simulated at once."""


def evaluate_run(
    folder: RunFolder, which: str, episodes: int, seed: int = 0, other_phi: list[float] | None = None
) -> dict[str, object]:
    """Return success and return of design `which` with the policy of the newest checkpoint up to its iteration.

    `other_phi` takes the design's place. Raise RunFolderError where there is no such design or policy, ValueError
    where `other_phi` is outside the task's own box or can't be put together.
    """
    history = History(folder)
    iteration, phi = history.design(which)
    checkpoint = folder.checkpoint_up_to(iteration)
    task = make_task(history.record.task, history.record.task_options)
    if other_phi is not None:
        phi = DesignSpace(tuple(history.record.parameters)).whole.check(other_phi)
        task.check_buildable(phi)
    state, _ = load_checkpoint(folder, checkpoint, task, read_method(history.record))
    scores = {}
    for name, sampled in (("sampled", True), ("deterministic", False)):
        measured, _ = measure(task, state.control.policy, phi, episodes, (seed, iteration), sampled)
        scores[name] = msgspec.to_builtins(measured)
    return {
        "run": folder.id,
        "task": task.name,
        "method": history.record.method,
        "iteration": iteration,
        "policy_iteration": checkpoint,
        "episodes": episodes,
        "seed": seed,
        "phi": dict(zip(history.design_space.names, phi.tolist(), strict=True)),
        **scores,
    }


def measure(
    task: Task,
    policy: Policy,
    phi: np.ndarray,
    episodes: int,
    seeds: tuple[int, int],
    sampled: bool,
    before_step: Callable[[], None] = lambda: None,
) -> tuple[Measured, Rollout]:
    """Run the policy on Hw-Phy with phi (d,), and say what it came to; whatever `before_step` raises ends it early."""
    rollout = play(task, policy, phi, episodes, np.random.default_rng(seeds), sampled, before_step)
    score = score_of(task, rollout)
    measured = Measured(
        episodes=episodes,
        success=score.success,
        success_interval=wilson_interval(int(rollout.successes.sum()), episodes),
        episode_return=score.episode_return,
        return_interval=score.return_interval,
        reward_terms=score.reward_terms,
        milestones=score.milestones,
        diverged=score.diverged,
    )
    return measured, rollout


def main() -> int:
    """Print one JSON document; 2 where the folder or the arguments do not allow it."""
    parser = argparse.ArgumentParser(prog="python -m morph_core.evaluate", description=__doc__)
    parser.add_argument("--run", type=Path, required=True, help="run folder")
    parser.add_argument("--design", default="best", help="best, latest or an iteration")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--phi", type=json.loads, help="a JSON list: another design in its place")
    options = parser.parse_args()
    if not 1 <= options.episodes <= MOST_EPISODES:
        parser.error(f"--episodes must be a whole number from 1 to {MOST_EPISODES}, not {options.episodes}")
    torch.set_num_threads(1)
    try:
        result = evaluate_run(
            RunFolder(options.run.resolve()), options.design, options.episodes, options.seed, options.phi
        )
    except (RunFolderError, ValueError, TypeError) as error:
        print(f"morph_core.evaluate: {error}", file=sys.stderr)  # noqa: T201 - a process entry
        return 2
    print(json.dumps(result))  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
