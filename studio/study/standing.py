"""How far a study is: what each of its runs has come to, and the same in one line per task and method."""

import statistics
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from morph_core.history import History
from morph_core.protocol import AnyEvent, Progress, StateChanged, Status, Stop
from morph_core.run_folder import RunFolder, RunFolderError
from studio.study.launcher import Place
from studio.study.plan import PlannedRun, Study

START_SECONDS = 3.0
"""Seconds that a trainer takes before its first word, for the estimate of what is left."""


class Solved(msgspec.Struct, frozen=True):
    """What it took until an evaluation first reached the study's level."""

    env_steps: int
    cpu_seconds: float


class Work(msgspec.Struct, frozen=True):
    """What a run's trainers have done by the wall clock, what was voided by a resume included."""

    seconds: float = 0.0
    """Time in which a trainer was at work: neither paused nor gone."""
    env_steps: int = 0


class RunStanding(msgspec.Struct, frozen=True, kw_only=True):
    """What one run of a study has come to."""

    run: str
    task: str
    variant: str
    seed: int
    status: Status
    over: bool
    """Whether no launcher will go on with it by itself: it has finished, was stopped by a user, or was given up."""
    reason: str = ""
    """Words on why it is over or waits, other than that it has finished."""
    where: str = ""
    iteration: int = 0
    env_steps: int = 0
    relabelled_steps: int = 0
    search_steps: int = 0
    cpu_seconds: float = 0.0
    work: Work = Work()
    solved: Solved | None = None
    sampled_success: float | None = None
    """Success over the episodes of the evaluation at the end; of the last one as long as there is none."""
    deterministic_success: float | None = None
    stage: str = ""


class VariantStanding(msgspec.Struct, frozen=True, kw_only=True):
    """What the runs of one task and method have come to; medians are over the seeds that have the number."""

    task: str
    variant: str
    runs: int
    finished: int
    solved: int
    median_env_steps: float | None
    """Median of the environment steps until solved, over the seeds that did."""
    median_cpu_seconds: float | None
    sampled_success: float | None
    """Median over the finished seeds of the success at the end."""
    deterministic_success: float | None
    failures: list[str]
    """The runs that are over without having finished, each with its reason."""


def stopped_by_user(history: History) -> bool:
    """Tell whether a run was stopped by a command, which nobody but a user takes back."""
    if history.state is None or history.state.status != "stopped":
        return False
    starts = [e.seq for e in history.events if isinstance(e, StateChanged) and e.status == "starting"]
    since = max(starts, default=0)
    return any(e.accepted and isinstance(e.command, Stop) and e.seq > since for e in history.acknowledged)


class Standings:
    """The runs of a study, read from their folders; what has finished is not read again."""

    def __init__(self, directory: Path, study: Study) -> None:
        self.directory, self.study = directory, study
        self._histories: dict[str, History] = {}
        self._finished: dict[str, RunStanding] = {}

    def read(self, places: Mapping[str, Place]) -> list[RunStanding]:
        """Return what each run has come to, in the plan's order; `places` is what a launcher says of them."""
        return [self._read(planned, places.get(planned.run, Place())) for planned in self.study.runs]

    def _read(self, planned: PlannedRun, place: Place) -> RunStanding:
        if planned.run in self._finished:
            return self._finished[planned.run]
        try:
            history = self._history(planned.run)
        except (RunFolderError, OSError, ValueError) as error:
            return RunStanding(
                run=planned.run, task=planned.task, variant=planned.variant, seed=planned.seed,
                status="unreadable", over=True, reason=str(error),
            )  # fmt: skip
        standing = standing_of(history, planned, self.study.level, place)
        if standing.status == "finished":
            self._finished[planned.run] = standing
            self._histories.pop(planned.run, None)
        return standing

    def _history(self, run: str) -> History:
        history = self._histories.get(run)
        if history is None:
            history = self._histories[run] = History(RunFolder(self.directory / run))
        else:
            history.poll()
        return history


def standing_of(history: History, planned: PlannedRun, level: float, place: Place) -> RunStanding:
    """Return what a run has come to."""
    status, beat = history.status, history.heartbeat
    progress: Progress | None = history.progress[-1] if history.progress else None
    last, solved = history.last_evaluation, history.first_evaluation("sampled", level)
    by_user = stopped_by_user(history)
    silent = status in ("finished", "running")
    return RunStanding(
        run=planned.run,
        task=planned.task,
        variant=planned.variant,
        seed=planned.seed,
        status=status,
        over=status == "finished" or by_user or place.given_up,
        reason=place.why or ("stopped by a user" if by_user else "" if silent else history.message),
        where=place.where,
        iteration=history.iteration,
        env_steps=progress.env_steps if progress else 0,
        relabelled_steps=progress.relabelled_steps if progress else 0,
        search_steps=progress.search_steps if progress else 0,
        cpu_seconds=history.cpu_seconds,
        work=work_of(history.events),
        solved=Solved(solved.env_steps, solved.cpu_seconds) if solved else None,
        sampled_success=last.sampled_success if last else None,
        deterministic_success=last.deterministic_success if last else None,
        stage=beat.stage if beat and status in ("starting", "running") else "",
    )


def by_variant(study: Study, standings: Sequence[RunStanding]) -> Iterator[VariantStanding]:
    """Yield one line for each task and method, in the plan's order."""
    groups: dict[tuple[str, str], list[RunStanding]] = defaultdict(list)
    for standing in standings:
        groups[standing.task, standing.variant].append(standing)
    for task in study.tasks:
        for variant in study.variants:
            runs = groups[task.name, variant.label]
            finished = [run for run in runs if run.status == "finished"]
            solved = [run.solved for run in runs if run.solved]
            yield VariantStanding(
                task=task.name,
                variant=variant.label,
                runs=len(runs),
                finished=len(finished),
                solved=len(solved),
                median_env_steps=_median([one.env_steps for one in solved]),
                median_cpu_seconds=_median([one.cpu_seconds for one in solved]),
                sampled_success=_median([run.sampled_success for run in finished]),
                deterministic_success=_median([run.deterministic_success for run in finished]),
                failures=[
                    f"{run.run}: {run.reason or run.status}" for run in runs if run.over and run.status != "finished"
                ],
            )


def _median(values: Sequence[float | None]) -> float | None:
    found = [value for value in values if value is not None]
    return float(statistics.median(found)) if found else None


def share_done(study: Study, standings: Sequence[RunStanding]) -> float:
    """Return the share of the study's environment steps that is done, or will not be done any more."""
    done = sum(1.0 if run.over else min(1.0, run.env_steps / study.env_steps) for run in standings)
    return done / len(standings)


def work_of(events: Iterable[AnyEvent]) -> Work:
    """Return what trainers have done between their words.

    A trainer that died did something after its last one, too: neither that time nor those steps are known.
    """
    seconds, steps = 0.0, 0
    since: float | None = None  # when the trainer at work said its last word
    reached = {0: 0}  # environment steps by iteration
    at = 0
    for event in events:
        if isinstance(event, StateChanged) and event.status == "starting":
            since, at = event.time, reached.get(event.iteration, at)
            continue
        if since is not None:
            seconds += max(0.0, event.time - since)
            since = event.time
        if isinstance(event, Progress):
            steps += max(0, event.env_steps - at)
            at = reached[event.iteration] = event.env_steps
        elif isinstance(event, StateChanged):
            since = event.time if event.status == "running" else None
    return Work(seconds, steps)


def seconds_left(study: Study, standings: Sequence[RunStanding], at_once: int) -> float | None:
    """Return the time until all runs are over, `at_once` of them at a time; None before anything can be told.

    A run's pace is that of all work on its task and method so far, or else on its task, or on all; it is by the wall
    clock, so that a machine that does other things too is known to be slow.
    """
    done: dict[tuple[str, ...], Work] = defaultdict(Work)
    for run in standings:
        for key in ((), (run.task,), (run.task, run.variant)):
            done[key] = Work(done[key].seconds + run.work.seconds, done[key].env_steps + run.work.env_steps)
    if not done[()].env_steps:
        return None
    left = []
    for run in (run for run in standings if not run.over):
        work = next(done[key] for key in ((run.task, run.variant), (run.task,), ()) if done[key].env_steps)
        starting = START_SECONDS if run.status in ("queued", "starting") else 0.0
        left.append(starting + work.seconds / work.env_steps * max(0, study.env_steps - run.env_steps))
    return max(sum(left) / max(1, at_once), max(left, default=0.0))
