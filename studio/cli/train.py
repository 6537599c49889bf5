"""`morph-studio train`: co-optimise body and controller without a browser, or go on with a run."""

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from morph_core.catalogue import make_task, read_method
from morph_core.config import paths_of
from morph_core.history import History
from morph_core.protocol import Resume
from morph_core.run_folder import LAUNCH, RunFolder, process_alive
from studio import limits
from studio.cli.arguments import RunsArguments, UsageError, value_after
from studio.cli.choice import open_run
from studio.cli.follow import Outcome, follow
from studio.cli.wanted import Wanted, parse_wanted
from studio.new_run import prepare_run
from studio.study.slurm import Slurm, slurm_launch
from studio.trainers import spawn_trainer

DEFAULT_ITERATIONS = 100
BEATS_WITHIN = 3.0
"""Seconds in which the heartbeat of a living trainer, here or on another machine, changes."""


@dataclass(frozen=True)
class TrainArguments(RunsArguments):
    """Co-optimise body and controller without a browser; the studio shows the run live all the same.

    Ctrl-C saves and stops after the iteration; --resume goes on from there.
    """

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")] = ""
    """Task to train on; with --resume it may be left out."""
    iterations: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Iterations of a new run, by default 100, or as many as the budget holds; with --resume, those after the last
    recorded one, or as planned."""
    env_steps: Annotated[float | None, tyro.conf.arg(metavar="N")] = None
    """Budget of a new run: it ends after the iteration that reaches N environment steps, or after --iterations."""
    resume: Annotated[str | None, tyro.conf.arg(metavar="RUN")] = None
    """Run to go on with from its newest checkpoint: its name, or the path of its folder."""
    json: bool = False
    """Print one JSON document at the end and nothing else."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio train` with these words; return the exit status. UsageError says what is allowed."""
    wanted = _asked(words)
    asked = wanted.arguments
    if asked.iterations is not None and asked.iterations < 1:
        raise UsageError(f"train: --iterations must be at least 1, not {asked.iterations}")
    if asked.resume is not None and asked.env_steps is not None:
        raise UsageError("train: a run keeps the budget it was started with: leave out --env-steps")
    folder, further = _resumed(wanted) if asked.resume is not None else (_prepared(wanted), None)
    if slurm_launch(folder):
        return _requeue(folder, further, quiet=asked.json)
    outcome = follow(folder, lambda: spawn_trainer(folder, further=further), quiet=asked.json)
    if asked.json:
        json.dump(_document(History(folder), outcome), sys.stdout, indent=2)
        sys.stdout.write("\n")
    return outcome.code


# --- what was asked for -----------------------------------------------------------------------------------------------


def _asked(words: Sequence[str]) -> Wanted:
    """Return what the words ask for; the flags of a run that is resumed are those it was started with."""
    resumed = value_after(words, "--resume")
    if resumed is None:
        return parse_wanted(TrainArguments, words, "train")
    named = value_after(words, "--runs")
    record = open_run(Path(named) if named else RunsArguments().runs, resumed).record
    try:
        recorded = make_task(record.task, record.task_options), read_method(record), record.seed
    except (TypeError, ValueError) as error:
        raise UsageError(f"{resumed} can't be resumed: {error}") from error
    return parse_wanted(TrainArguments, words, "train", recorded)


def _prepared(wanted: Wanted) -> RunFolder:
    asked = wanted.arguments
    try:
        budget = None if asked.env_steps is None else limits.env_steps(asked.env_steps)
        longest = DEFAULT_ITERATIONS if budget is None else limits.iterations_within(budget, 1)
        return prepare_run(
            asked.runs,
            task=asked.task,
            method=asked.method,
            seed=asked.seed,
            iterations=longest if asked.iterations is None else asked.iterations,
            env_steps=budget,
            settings=wanted.settings,
            task_options=wanted.task_options,
        )
    except (ValueError, OSError) as error:
        raise UsageError(f"train: {error}") from error


def _resumed(wanted: Wanted) -> tuple[RunFolder, int | None]:
    """Return the folder to go on with, and how many iterations beyond the last recorded one (None: as planned)."""
    asked = wanted.arguments
    history = open_run(asked.runs, asked.resume)
    record, folder = history.record, history.folder
    if asked.task and asked.task != record.task:
        raise UsageError(f"{folder.id} is a run of the task {record.task}, not {asked.task}")
    recorded = dict(paths_of(read_method(record)))
    given = [name for name in ("method", "seed") if getattr(asked, name) != getattr(record, name)]
    given += ["preset"] if asked.preset else []
    given += [name for name, value in wanted.settings.items() if value != recorded.get(name)]
    if given or wanted.task_options:
        names = ", ".join("--" + name.replace("_", "-") for name in (*given, *wanted.task_options))
        raise UsageError(f"{folder.id} keeps what it was started with: leave out {names}, or start a new run")
    if _trainer_at_work(folder):
        raise UsageError(f"{folder.id} is {history.status}: its trainer is at work; watch it with morph-studio serve")
    if asked.iterations is None and (history.status == "finished" or history.iteration >= record.iterations):
        done = f"{folder.id} is done after {history.iteration} iterations"
        raise UsageError(f"{done}: give --iterations M for M further ones")
    if history.paused_by_user:  # else its trainer would come back paused
        folder.send(Resume())
    return folder, asked.iterations


def _requeue(folder: RunFolder, further: int | None, quiet: bool) -> int:
    """Put a run back into Slurm's queue, from which it came: a login node is no place for its trainer."""
    history = History(folder)
    until = history.iteration + further if further is not None else None
    slurm = Slurm()
    try:
        slurm.resume(folder.path.parent, folder.id, until=until)
        [place] = slurm.states(folder.path.parent, [folder.id]).values()
    except ValueError as error:
        raise UsageError(
            f"{folder.id} came from Slurm's queue, to which it can't go back: {error}; to go on on this machine "
            f"instead, remove {folder.path / LAUNCH}"
        ) from error
    if quiet:
        json.dump(_document(history, Outcome(0, "queued", place.where or place.why)), sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        at = f"at work on {place.where}" if place.where else f"queued: {place.why}"
        print(f"{folder.id} is {at}; morph-studio runs shows how it does", file=sys.stderr)  # noqa: T201
    return 0


def _trainer_at_work(folder: RunFolder) -> bool:
    """Tell whether a trainer holds the folder; one just killed here leaves a heartbeat that looks alive, but stands."""
    beat = folder.heartbeat()
    if beat is None or not folder.trainer_alive():
        return False
    deadline = time.monotonic() + BEATS_WITHIN
    while time.monotonic() < deadline:
        if process_alive(beat.pid, beat.process_started) or folder.heartbeat() != beat:
            return True
        time.sleep(0.1)
    return False


# --- what came of it --------------------------------------------------------------------------------------------------


def _document(history: History, outcome: Outcome) -> dict[str, object]:
    last = history.evaluations[-1] if history.evaluations else None
    progress = history.progress[-1] if history.progress else None
    return {
        "run": history.folder.id,
        "path": str(history.folder.path.resolve()),
        "task": history.record.task,
        "method": history.record.method,
        "seed": history.record.seed,
        "status": outcome.status,
        "message": outcome.message,
        "iterations": history.iteration,
        "env_steps": progress.env_steps if progress else 0,
        "relabelled_steps": progress.relabelled_steps if progress else 0,
        "search_steps": progress.search_steps if progress else 0,
        "diverged": progress.diverged if progress else 0,
        "phi": dict(zip(history.design_space.names, history.phi.tolist(), strict=True)),
        "last_evaluation": _evaluation(last),
        "best_evaluation": _evaluation(history.best),
        "cpu_seconds": history.cpu_seconds,
    }


def _evaluation(evaluation: Any) -> dict[str, object] | None:
    if evaluation is None:
        return None
    names = ("iteration", "env_steps", "phi", "sampled_success", "sampled_return", "deterministic_success",
             "deterministic_return", "milestones", "diverged", "episode", "cpu_seconds", "episodes",
             "final")  # fmt: skip
    return {name: getattr(evaluation, name) for name in names}
