"""`morph-studio study`: compare methods over tasks and seeds at equal environment steps."""

import functools
import shlex
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import tyro
from rich.console import Group
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from morph_core.run_folder import STUDY
from studio import limits
from studio.cli.arguments import UsageError, parse
from studio.cli.follow import interrupts
from studio.cli.output import complain, say, write_json
from studio.cli.terminal import Cadence, Screen, in_words, make_console
from studio.study.launcher import Launcher
from studio.study.launchers import launcher_of_study, make_launcher
from studio.study.plan import (
    Study,
    StudyError,
    parse_seeds,
    parse_task,
    parse_variant,
    plan_study,
    read_study,
    write_study,
)
from studio.study.report import write_report, write_tables_into
from studio.study.slurm_options import SlurmOptions
from studio.study.standing import RunStanding, Standings, by_variant, seconds_left, share_done

POLL_SECONDS = 0.5
LINE_SECONDS = 10.0
"""Seconds between two printed lines where there is no terminal."""
SHOWN_RUNS = 16
"""Largest number of running runs that a terminal shows one by one."""


@dataclass(frozen=True)
class StudyArguments:
    """Compare methods over tasks and seeds at equal environment steps, and report what came of it.

    A method V is METHOD or PRESET, or one of them with settings behind commas, METHOD,setting=value,... under the
    names that `morph-studio train` gives them; LABEL:V names it in tables and figures. The same words again go on
    where a study was.
    """

    tasks: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="TASK...")] = ()
    """Tasks to compare on; TASK,option=value,... sets options."""
    methods: Annotated[tuple[str, ...], tyro.conf.arg(metavar="V...")] = ()
    """Methods to compare, such as: paper morph slow:morph,alpha=.1,search=drift direct."""
    seeds: Annotated[str, tyro.conf.arg(metavar="SEEDS")] = "0-9"
    """Seeds of every method on every task."""
    env_steps: Annotated[float | None, tyro.conf.arg(metavar="N")] = None
    """Budget of every run: it ends after the iteration that reaches N environment steps."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of the study: a new or an empty one, or this study's own, which then goes on."""
    level: Annotated[float, tyro.conf.arg(metavar="SHARE")] = 0.95
    """Success of the sampled policy in an evaluation that counts as solved."""
    final_episodes: Annotated[int, tyro.conf.arg(metavar="N")] = 256
    """Episodes of each kind, sampled and deterministic, in the evaluation at the end of every run; 0 for none."""
    launcher: Annotated[str, tyro.conf.arg(metavar="NAME")] = "local"
    """What gives the runs their trainers: local, a queue over the cores of this machine, or slurm, a cluster's."""
    slots: Annotated[int | None, tyro.conf.arg(metavar="K")] = None
    """Runs at a time; by default one for each core."""
    slurm: tyro.conf.OmitArgPrefixes[SlurmOptions] = SlurmOptions()
    """Options of --launcher slurm."""
    status: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Show how far the study in DIR is, and nothing else."""
    cancel: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Stop the study in DIR: its trainers save a checkpoint, what waits is not started."""
    report: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Write the report of the study in DIR, however far it is."""
    table: Annotated[Path | None, tyro.conf.arg(metavar="FILE.md")] = None
    """Document into whose places for tables --report writes those of the study, in place of a report."""
    json: bool = False
    """Print one JSON document at the end and nothing else."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio study` with these words; return the exit status. UsageError says what is allowed."""
    asked = parse(StudyArguments, words, "study")
    report = functools.partial(_tables, asked.table) if asked.table else _report
    acts: dict[str, Callable[[Path, bool], int]] = {"status": _status, "cancel": _cancel, "report": report}
    chosen = [name for name in acts if getattr(asked, name) is not None]
    try:
        if not chosen:
            return _run(asked)
        alone = {name: getattr(asked, name) for name in ("json", chosen[0], *["table"] * (chosen == ["report"]))}
        if len(chosen) > 1 or asked != StudyArguments(**alone):
            others = "--table or --json" if chosen[0] == "report" else "--json"
            raise UsageError(f"study: --{chosen[0]} DIR goes alone, or with {others}")
        return acts[chosen[0]](getattr(asked, chosen[0]), asked.json)
    except ValueError as error:
        raise error if isinstance(error, UsageError) else UsageError(f"study: {error}") from error


# --- what was asked for -----------------------------------------------------------------------------------------------


def _planned(asked: StudyArguments) -> Study:
    if asked.env_steps is None:
        raise UsageError("study: --env-steps is missing: the budget of every run, such as --env-steps 8e5")
    tasks = [parse_task(word) for word in asked.tasks]
    variants = [parse_variant(word) for word in asked.methods]
    return plan_study(
        tasks,
        variants,
        parse_seeds(asked.seeds),
        env_steps=limits.env_steps(asked.env_steps),
        level=asked.level,
        final_episodes=asked.final_episodes,
    )


def _run(asked: StudyArguments) -> int:
    if asked.out is None:
        raise UsageError("study: --out is missing: the folder of the study, a new or an empty one")
    launcher = make_launcher(asked.launcher, asked.slots, asked.slurm)
    study, out = _planned(asked), asked.out
    is_new = not (out / STUDY).exists()
    study = write_study(out, study)
    names = [planned.run for planned in study.runs]
    try:
        launcher.requeue(out, names)
        launcher.submit(out, names)
    except ValueError:
        if is_new:
            shutil.rmtree(out)
        raise
    standings, code = _follow(out, study, launcher, quiet=asked.json)
    _conclude(out, study, standings, asked.json)
    if code != 130 and not asked.json:
        _try_report(out)
    return code


def _status(directory: Path, as_json: bool) -> int:
    study = read_study(directory)
    launcher = launcher_of_study(directory, study)
    standings = Standings(directory, study).read(launcher.states(directory, [planned.run for planned in study.runs]))
    _conclude(directory, study, standings, as_json)
    return 0


def _cancel(directory: Path, as_json: bool) -> int:
    study = read_study(directory)
    launcher = launcher_of_study(directory, study)
    names = [planned.run for planned in study.runs]
    standings = Standings(directory, study).read(launcher.states(directory, names))
    over = {run.run for run in standings if run.status == "finished"}
    launcher.cancel(directory, [name for name in names if name not in over])
    count = len(names) - len(over)
    said = f"cancelled {count} run{'s' * (count != 1)}; the words that the study was started with go on with it"
    _tell({"cancelled": count}, said, as_json)
    return 0


def _report(directory: Path, as_json: bool) -> int:
    path = write_report(directory)
    _tell({"report": str(path)}, f"report: {path}", as_json)
    return 0


def _try_report(directory: Path) -> None:
    """Write the report of a study that is over; the study has come to what it has, with a report or without."""
    try:
        _report(directory, as_json=False)
    except StudyError as error:
        complain(f"morph-studio: {error}")


def _tables(document: Path, directory: Path, as_json: bool) -> int:
    count = write_tables_into(directory, document)
    _tell({"tables": count}, f"{count} table{'s' * (count != 1)} written to {document}", as_json)
    return 0


# --- following it -----------------------------------------------------------------------------------------------------


def _follow(directory: Path, study: Study, launcher: Launcher, *, quiet: bool) -> tuple[list[RunStanding], int]:
    """Show the study until all its runs are over; return what they have come to, and the exit status.

    The first Ctrl-C stops the trainers that can't go on without this process, the second ends them at once.
    """
    console = make_console(stderr=True, soft_wrap=True)
    reader, names = Standings(directory, study), [planned.run for planned in study.runs]
    standings: list[RunStanding] = []
    heard = 0
    with interrupts() as presses, Screen(console, quiet) as screen:
        view = (_Bars if console.is_terminal else _Lines)(screen, study)
        serve = f"morph-studio serve --runs {shlex.quote(str(directory))}"
        screen.say(f"{len(names)} runs in {directory}; watch them: {serve}")
        while True:
            launcher.tend(directory)
            standings = reader.read(launcher.states(directory, names))
            view.show(standings, launcher.slots)
            if len(presses) > heard and heard < 2:
                heard += 1
                screen.say(launcher.leave(directory, at_once=heard == 2))
            over = all(run.over for run in standings) or bool(presses)
            if over and not launcher.working(directory):
                break
            time.sleep(POLL_SECONDS)
        view.show(standings, launcher.slots, last=True)
    standings = reader.read(launcher.states(directory, names))
    if presses:
        return standings, 0 if launcher.stays else 130
    return standings, 0 if all(run.status == "finished" for run in standings) else 1


class _Bars:
    """A bar for the study on the last lines of the terminal, and one line for each run that is running."""

    def __init__(self, screen: Screen, study: Study) -> None:
        self._screen, self._study = screen, study
        self._whole = Progress(
            TextColumn("{task.description}"), BarColumn(bar_width=None), TextColumn("{task.fields[eta]}"),
            console=screen.console, expand=True,
        )  # fmt: skip
        self._task = self._whole.add_task("starting", total=1.0, eta="")

    def show(self, standings: Sequence[RunStanding], slots: int, last: bool = False) -> None:
        """Show how far the study is; `last` prints it too."""
        self._whole.update(
            self._task,
            description=_counts(standings),
            completed=share_done(self._study, standings),
            eta=_eta(self._study, standings, slots),
        )
        self._screen.draw(Group(self._whole, _running_table(self._study, standings)))
        if last:
            self._screen.say(_counts(standings))


class _Lines:
    """A line now and then, for a log file."""

    def __init__(self, screen: Screen, study: Study) -> None:
        self._screen, self._study, self._cadence = screen, study, Cadence(LINE_SECONDS)

    def show(self, standings: Sequence[RunStanding], slots: int, last: bool = False) -> None:
        """Print a line if it is time for one and there is news, and anyway if it is the `last` one."""
        words = f"{_counts(standings)}  {100 * share_done(self._study, standings):.0f} % of all steps"
        if self._cadence.is_due(words, last):
            self._screen.say(f"{words}  {_eta(self._study, standings, slots)}".rstrip())


def _counts(standings: Sequence[RunStanding]) -> str:
    """Return how many runs are finished, running, waiting and over for other reasons."""
    finished = sum(run.status == "finished" for run in standings)
    over = sum(run.over for run in standings) - finished
    at_work = sum(run.status in ("starting", "running", "pausing", "paused") and not run.over for run in standings)
    waiting = len(standings) - finished - over - at_work
    others = {"at work": at_work, "waiting": waiting, "over without an end": over}
    counts = [f"{count} {what}" for what, count in others.items() if count]
    return ", ".join([f"{finished} of {len(standings)} runs finished", *counts])


def _eta(study: Study, standings: Sequence[RunStanding], slots: int) -> str:
    left = seconds_left(study, standings, slots)
    return in_words(left) if left else ""


def _running_table(study: Study, standings: Sequence[RunStanding]) -> Table:
    table = Table.grid(padding=(0, 2))
    running = [run for run in standings if run.status in ("starting", "running", "pausing", "paused")]
    for run in running[:SHOWN_RUNS]:
        success = "" if run.sampled_success is None else f"success {run.sampled_success:.2f}"
        table.add_row(*(Text(cell, no_wrap=True) for cell in (
            run.run, f"{100 * min(1.0, run.env_steps / study.env_steps):3.0f} %", f"iteration {run.iteration}", success,
            run.stage or run.status, run.where,
        )))  # fmt: skip
    if len(running) > SHOWN_RUNS:
        table.add_row(Text(f"and {len(running) - SHOWN_RUNS} more"))
    return table


# --- what came of it --------------------------------------------------------------------------------------------------


def _conclude(directory: Path, study: Study, standings: list[RunStanding], as_json: bool) -> None:
    if as_json:
        write_json(document(directory, study, standings))
        return
    console = make_console()
    console.print(
        Text(f"{_counts(standings)}; solved: sampled success ≥ {study.level:g}; medians of the seeds"), soft_wrap=True
    )
    console.print(table_of(study, standings))
    for variant in by_variant(study, standings):
        for failure in variant.failures:
            console.print(Text(failure), soft_wrap=True)
    if not all(run.over for run in standings):
        console.print(Text(f"watch it: morph-studio serve --runs {shlex.quote(str(directory))}"), soft_wrap=True)


def table_of(study: Study, standings: Sequence[RunStanding]) -> Table:
    """Return one line for each task and method: how many seeds solved it, after how much, and success at the end."""
    table = Table(box=None, pad_edge=False)
    for heading in ("task", "method"):
        table.add_column(heading, overflow="fold")
    for heading in ("finished", "solved", "steps to solve", "CPU to solve", "success at the end", "deterministic"):
        table.add_column(heading, justify="right")
    for line in by_variant(study, standings):
        steps, cpu = line.median_env_steps, line.median_cpu_seconds
        table.add_row(*(Text(cell) for cell in (
            line.task, line.variant, f"{line.finished} of {line.runs}", f"{line.solved} of {line.runs}",
            "" if steps is None else f"{steps / 1e6:.3f} M", "" if cpu is None else f"{cpu:.1f} s",
            _share(line.sampled_success), _share(line.deterministic_success),
        )))  # fmt: skip
    return table


def _share(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def document(directory: Path, study: Study, standings: Sequence[RunStanding]) -> dict[str, object]:
    """Return what a study has come to, for programs."""
    return {
        "study": str(directory.resolve()),
        "env_steps": study.env_steps,
        "level": study.level,
        "over": all(run.over for run in standings),
        "methods": [msgspec.to_builtins(line) for line in by_variant(study, standings)],
        "runs": [msgspec.to_builtins(run) for run in standings],
    }


def _tell(document: dict[str, object], words: str, as_json: bool) -> None:
    if as_json:
        write_json(document)
    else:
        say(words)
