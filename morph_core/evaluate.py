"""`python -m morph_core.evaluate --run DIR`: success and return of a run's design and policy on Hw-Phy, as JSON."""

import argparse
import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import torch

from morph_core.catalogue import make_task, read_method
from morph_core.checkpoint import load_checkpoint
from morph_core.design import DesignSpace
from morph_core.episodes import evaluate
from morph_core.history import History
from morph_core.run_folder import RunFolder, RunFolderError


def evaluate_run(
    folder: RunFolder, which: str, episodes: int, seed: int = 0, other_phi: list[float] | None = None
) -> dict[str, object]:
    """Return success and return of design `which` with the policy of the newest checkpoint up to its iteration.

    `other_phi` takes the design's place. Raise RunFolderError where there is no such design or policy, ValueError
    where `other_phi` is outside the run's box.
    """
    history = History(folder)
    iteration, phi = history.design(which)
    if other_phi is not None:
        phi = DesignSpace(tuple(history.record.parameters)).check(other_phi)
    saved = [i for i in folder.checkpoint_iterations() if i <= iteration]
    if not saved:
        raise RunFolderError(f"{folder.id} has no checkpoint up to iteration {iteration}: no policy to evaluate")
    task = make_task(history.record.task, history.record.task_options)
    state, _ = load_checkpoint(folder, saved[-1], task, read_method(history.record))
    scores = {}
    for name, sampled in (("sampled", True), ("deterministic", False)):
        rng = np.random.default_rng([seed, iteration])
        score, _ = evaluate(task, state.control.policy, phi, episodes, rng, sampled)
        scores[name] = dataclasses.asdict(score)
    return {
        "run": folder.id,
        "task": task.name,
        "method": history.record.method,
        "iteration": iteration,
        "policy_iteration": saved[-1],
        "episodes": episodes,
        "seed": seed,
        "phi": dict(zip(history.design_space.names, phi.tolist(), strict=True)),
        **scores,
    }


def main() -> int:
    """Print one JSON document; 2 where the folder or the arguments do not allow it."""
    parser = argparse.ArgumentParser(prog="python -m morph_core.evaluate", description=__doc__)
    parser.add_argument("--run", type=Path, required=True, help="run folder")
    parser.add_argument("--design", default="best", help="best, latest or an iteration")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--phi", type=json.loads, help="a JSON list: another design in its place")
    options = parser.parse_args()
    if options.episodes < 1:
        parser.error(f"--episodes must be at least 1, not {options.episodes}")
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
