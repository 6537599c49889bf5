"""`morph-studio train`: co-optimise body and controller without a browser, or go on with a run."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tyro

from morph_core.catalogue import make_task, read_method
from morph_core.config import paths_of
from morph_core.design import DesignSpace
from morph_core.history import History
from morph_core.origin import Origin, origin_at
from morph_core.protocol import Parameter, Resume
from morph_core.pulse import at_work
from morph_core.run_folder import LAUNCH, RunFolder
from studio.cli.arguments import RunsArguments, UsageError, value_after
from studio.cli.choice import open_run, place_of
from studio.cli.follow import Outcome, follow
from studio.cli.output import complain, write_json
from studio.cli.wanted import Wanted, branch_method, parse_wanted
from studio.log import sender_here
from studio.new_run import Branch, StartRun, method_at, prepare_run, space_at
from studio.settings import at_home
from studio.study.slurm import Slurm, slurm_launch
from studio.trainers import spawn_trainer


@dataclass(frozen=True)
class TrainArguments(RunsArguments):
    """Co-optimise body and controller without a browser; the studio shows the run live all the same.

    Ctrl-C saves and stops after the iteration; --resume goes on from there.
    """

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")] = ""
    """Task to train on; with --resume or --branch it may be left out."""
    iterations: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Iterations of a new run, by default 100, or as many as the budget holds; with --resume or --branch, those after
    where it goes on, by default as planned."""
    env_steps: Annotated[float | None, tyro.conf.arg(metavar="N")] = None
    """Budget of a new run: it ends after the iteration that reaches N environment steps, or after --iterations."""
    resume: Annotated[str | None, tyro.conf.arg(metavar="RUN")] = None
    """Run to go on with from its newest checkpoint: its name, or the path of its folder."""
    from_start: bool = False
    """Whether a run that --resume finds without a readable checkpoint begins anew, which gives up what it learnt."""
    branch: Annotated[str | None, tyro.conf.arg(metavar="RUN[@ITERATION]")] = None
    """Run to branch from, at an iteration or at its last one: a new run beside it begins with the nearest checkpoint up
    to there. It is like its parent in all that no flag changes; one with nothing changed goes on as its parent did."""
    bounds: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=LO:HI")] = ()
    """Bounds of design parameters of a new run, such as link_1=0.5:2."""
    lock: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[=VALUE]")] = ()
    """Design parameters that a new run holds at a value, or at the one it begins with."""
    unlock: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = ()
    """Locked design parameters of the run that is branched from, free in the new one."""
    json: bool = False
    """Print one JSON document at the end and nothing else."""


@dataclass(frozen=True)
class _Asked:
    """What the words ask for, and where it begins if that is in another run."""

    wanted: Wanted
    origin: Origin | None = None
    runs: Path | None = None
    """Folder of the run that is branched from."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio train` with these words; return the exit status. UsageError says what is allowed."""
    found = _asked(words)
    wanted, asked = found.wanted, found.wanted.arguments
    if asked.iterations is not None and asked.iterations < 1:
        raise UsageError(f"train: --iterations must be at least 1, not {asked.iterations}")
    if asked.resume is not None and asked.env_steps is not None:
        raise UsageError("train: a run keeps the budget it was started with: leave out --env-steps")
    if asked.from_start and asked.resume is None:
        raise UsageError("train: --from-start goes with --resume RUN; a new run begins at the start anyway")
    folder, further = _resumed(wanted) if asked.resume is not None else (_prepared(found), None)
    if slurm_launch(folder):
        if asked.from_start:
            raise UsageError(f"train: {folder.id} came from Slurm's queue, from which a run can't begin anew")
        return _requeue(folder, further, quiet=asked.json)
    spawn = functools.partial(spawn_trainer, folder, further=further, from_start=asked.from_start)
    try:
        outcome = follow(folder, spawn, quiet=asked.json)
    except OSError as error:
        raise UsageError(f"train: {error}") from error
    if asked.json:
        write_json(_document(History(folder), outcome))
    return outcome.code


# --- what was asked for -----------------------------------------------------------------------------------------------


def _asked(words: Sequence[str]) -> _Asked:
    """Return what the words ask for; the flags of a run that is resumed or branched from are those it was started
    with."""
    resumed, branched, named = (value_after(words, option) for option in ("--resume", "--branch", "--runs"))
    runs = at_home(named) if named else RunsArguments().runs
    if resumed is not None and branched is not None:
        raise UsageError("train: choose one of --resume, which goes on with a run, and --branch, which starts another")
    if resumed is not None:
        record = open_run(runs, resumed).record
        try:
            recorded = make_task(record.task, record.task_options), read_method(record), record.seed
        except (TypeError, ValueError) as error:
            raise UsageError(f"{resumed} can't be resumed: {error}") from error
        return _Asked(parse_wanted(TrainArguments, words, "train", recorded))
    if branched is None:
        return _Asked(parse_wanted(TrainArguments, words, "train"))
    history, iteration = place_of(runs, branched, "train: --branch")
    try:
        origin = origin_at(history, iteration)
        task, parent = make_task(origin.record.task, origin.record.task_options), method_at(origin)
    except (TypeError, ValueError) as error:
        raise UsageError(f"train: {branched} can't be branched from: {error}") from error
    recorded = task, branch_method(words, "train", task, parent), origin.record.seed
    return _Asked(parse_wanted(TrainArguments, words, "train", recorded), origin, history.folder.path.parent)


def _prepared(found: _Asked) -> RunFolder:
    asked, origin = found.wanted.arguments, found.origin
    wish = StartRun(
        task=asked.task or None,
        method=asked.method,
        seed=asked.seed,
        iterations=asked.iterations,
        env_steps=asked.env_steps,
        settings=dict(found.wanted.everything if origin else found.wanted.settings),
        task_options=dict(found.wanted.task_options),
        branch=Branch(origin.run, origin.iteration) if origin else None,
    )
    try:
        space = space_at(origin) if origin else make_task(asked.task, wish.task_options).design_space
        wish = msgspec.structs.replace(wish, parameters=_parameters(asked, space))
        folder = prepare_run(found.runs or asked.runs, wish)
    except (ValueError, OSError) as error:
        raise UsageError(f"train: {error}") from error
    if origin and not asked.json:
        complain(f"{folder.id} begins {origin.words}")
    return folder


def _parameters(asked: TrainArguments, space: DesignSpace) -> list[Parameter]:
    """Return the design parameters whose bounds or locks are asked to be other than in `space`."""
    edited = space
    for name in asked.unlock:
        edited = edited.without_lock(name)
    for word in asked.bounds:
        name, _, ends = word.partition("=")
        lo, _, hi = ends.partition(":")
        edited = edited.with_bound(name, _number(word, lo), _number(word, hi))
    for word in asked.lock:
        name, given, value = word.partition("=")
        held = _number(word, value) if given else float(space.initial[space.index(name)])
        edited = edited.with_lock(name, held)
    return [p for p, before in zip(edited.parameters, space.parameters, strict=True) if p != before]


def _number(word: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f'"{word}" can\'t be read: bounds are NAME=LO:HI, a lock is NAME or NAME=VALUE') from None


def _resumed(wanted: Wanted) -> tuple[RunFolder, int | None]:
    """Return the folder to go on with, and how many iterations beyond the last recorded one (None: as planned)."""
    asked = wanted.arguments
    history = open_run(asked.runs, asked.resume)
    record, folder = history.record, history.folder
    if asked.task and asked.task != record.task:
        raise UsageError(f"{folder.id} is a run of the task {record.task}, not {asked.task}")
    recorded = dict(paths_of(read_method(record)))
    given = [name for name in ("method", "seed") if getattr(asked, name) != getattr(record, name)]
    given += [name for name in ("bounds", "lock", "unlock") if getattr(asked, name)]
    given += ["preset"] if asked.preset else []
    given += [name for name, value in wanted.settings.items() if value != recorded.get(name)]
    if given or wanted.task_options:
        names = ", ".join("--" + name.replace("_", "-") for name in (*given, *wanted.task_options))
        raise UsageError(f"{folder.id} keeps what it was started with: leave out {names}, or start a new run")
    if at_work(folder.heartbeat):
        raise UsageError(f"{folder.id} is {history.status}: its trainer is at work; watch it with morph-studio serve")
    if asked.iterations is None and (history.status == "finished" or history.iteration >= record.iterations):
        done = f"{folder.id} is done after {history.iteration} iterations"
        raise UsageError(f"{done}: give --iterations M for M further ones")
    if history.paused_by_user:  # else its trainer would come back paused
        folder.send(Resume(), sender_here("command line"))
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
        write_json(_document(history, Outcome(0, "queued", place.where or place.why)))
    else:
        at = f"at work on {place.where}" if place.where else f"queued: {place.why}"
        complain(f"{folder.id} is {at}; morph-studio runs shows how it does")
    return 0


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
