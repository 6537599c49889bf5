"""`morph-studio evaluate`: success and return of a design, or along each parameter, in a process of its own."""

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from morph_core.design import DesignSpace
from morph_core.history import History
from studio import limits
from studio.cancellation import Cancellation
from studio.cli.arguments import Count, RunName, RunsArguments, UsageError, parse
from studio.cli.choice import check_design, open_run
from studio.cli.export import DesignName
from studio.cli.output import complain, write_json
from studio.evaluator import Evaluator, EvaluatorError
from studio.trainers import trainer_environment
from studio.what_if import POINTS, Policy, SweepPoint, WhatIfs, Wish, phi_of, policy_note


@dataclass(frozen=True)
class EvaluateArguments(RunsArguments):
    """Measure success and return of a design on Hw-Phy, with the policy of the same iteration."""

    run: tyro.conf.Positional[RunName] = tyro.MISSING
    """Name of a run, or the path of its folder."""
    design: DesignName = "best"
    """Design to measure: the best evaluated one, the latest one, or that of an iteration."""
    phi: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="NAME=VALUE|VALUE")] = None
    """Another design to measure with the same policy: some values by name, laid over the design, or all values in their
    order; in the parameters' own units, anywhere in the task's own box."""
    phi_from: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """File of another design to measure with the same policy: a design.json, or an export that holds one."""
    sensitivity: bool = False
    """Measure along each parameter instead: 9 values across the task's own box, all others as in the design."""
    policy: Policy = "sampled"
    """Policy that is measured along each parameter; of a single design both are."""
    episodes: Count = 100
    """Number of episodes for the sampled policy, and as many for the deterministic one; along each parameter, at each
    value."""
    json: bool = False
    """Print one JSON document and nothing else."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio evaluate` with these words; return the exit status."""
    arguments = parse(EvaluateArguments, words, "evaluate")
    try:
        limits.whole("--episodes", arguments.episodes, 1, limits.MAX_FINAL_EPISODES)
    except ValueError as error:
        raise UsageError(f"evaluate: {error}") from error
    history = open_run(arguments.runs, arguments.run)
    check_design(history, arguments.design)
    phi = _other_phi(history, arguments)
    if arguments.sensitivity:
        wish = Wish(design=arguments.design, phi=phi, episodes=arguments.episodes, policy=arguments.policy)
        return _sweep(history, wish, arguments.json)
    done = _evaluate(history.folder.path, arguments.design, arguments.episodes, phi)
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or [f"it ended with {done.returncode}"]
        complain(f"morph-studio: {reason[0].removeprefix('morph_core.')}")
        return 2 if done.returncode == 2 else 1
    if arguments.json:
        write_json(json.loads(done.stdout))
    else:
        _print_result(json.loads(done.stdout))
    return 0


def _other_phi(history: History, arguments: EvaluateArguments) -> list[float] | None:
    """Return the design that the words ask for in place of the run's own, or None."""
    if arguments.phi is not None and arguments.phi_from is not None:
        raise UsageError("evaluate: choose one of --phi and --phi-from")
    if arguments.phi_from is not None:
        return _imported(history, arguments.phi_from)
    if arguments.phi is None:
        return None
    space = DesignSpace(tuple(history.record.parameters)).whole
    try:
        return phi_of(space, history.design(arguments.design)[1], _values(arguments.phi)).tolist()
    except ValueError as error:
        raise UsageError(f"evaluate: --phi: {error}") from error


def _values(words: Sequence[str]) -> list[float] | dict[str, float]:
    """Return what the words after --phi give; ValueError unless all are NAME=VALUE, or all are numbers."""
    pairs = [word.partition("=") for word in words]
    named = [name for name, equals, _ in pairs if equals]
    if named and len(named) < len(pairs):
        raise ValueError("give all values in their order, or NAME=VALUE each, not both")
    if len(set(named)) < len(named):
        raise ValueError("a parameter is named twice")
    numbers = [_number(value if equals else name) for name, equals, value in pairs]
    return dict(zip(named, numbers, strict=True)) if named else numbers


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f'"{word[:40]}" is no number') from None


def _imported(history: History, path: Path) -> list[float]:
    from studio.export.design_file import load_design, phi_for
    from studio.export.errors import ExportError

    try:
        space = DesignSpace(tuple(history.record.parameters)).whole
        return phi_for(load_design(path), history.record.task, space).tolist()
    except ExportError as error:
        raise UsageError(f"evaluate: {error}") from error


def _sweep(history: History, wish: Wish, as_json: bool) -> int:
    """Measure along each parameter, and show how far it is; Ctrl-C ends it."""
    from rich.progress import Progress

    from studio.cli.terminal import make_console

    evaluator, found = Evaluator(), []
    try:
        points = WhatIfs(evaluator).sweep(history, wish, Cancellation())
        with Progress(console=make_console(stderr=True), transient=True) as progress:
            bar = progress.add_task("along each parameter", total=None)
            for point in points:
                found.append(point)
                progress.update(bar, completed=point.number, total=point.of)
    except (ValueError, EvaluatorError) as error:
        complain(f"morph-studio: evaluate: {error}")
        return 2 if isinstance(error, ValueError) else 1
    finally:
        evaluator.close()
    found.sort(key=lambda point: (history.design_space.index(point.parameter), point.value))
    if as_json:
        write_json({"run": history.folder.id, "points": found})
    else:
        _print_sweep(found, wish)
    return 0


def _print_sweep(points: Sequence[SweepPoint], wish: Wish) -> None:
    """Print a line for each value: success and return, each with its interval."""
    from rich.table import Table

    from studio.cli.terminal import make_console

    table = Table(box=None, pad_edge=False)
    for heading in ("parameter", "value", "success [95 %]", "return [95 %]"):
        table.add_column(heading, justify="left" if heading == "parameter" else "right")
    for first, point in ((i % POINTS == 0, point) for i, point in enumerate(points)):
        if first and point is not points[0]:
            table.add_section()
        m = point.measured
        cells = [point.reason]
        if m is not None:
            success = _with_interval(m.success, m.success_interval)
            cells = [success, _with_interval(m.episode_return, m.return_interval)]
        table.add_row(point.parameter if first else "", f"{point.value:.4g} {point.unit}".rstrip(), *cells)
    console = make_console()
    console.print(table)
    console.print(f"{wish.policy} policy, {wish.episodes} episodes on Hw-Phy at each value", soft_wrap=True)


def _evaluate(folder: Path, design: str, episodes: int, phi: list[float] | None) -> subprocess.CompletedProcess[str]:
    """Run the evaluation in a process of its own: it needs torch, this one does not."""
    return subprocess.run(
        [sys.executable, "-P", "-m", "morph_core.evaluate", "--run", str(folder.resolve()), "--design", design,
         "--episodes", str(episodes), *(["--phi", json.dumps(phi)] if phi is not None else [])],
        capture_output=True, encoding="utf-8", errors="replace", env=trainer_environment(), check=False,
    )  # fmt: skip


def _print_result(result: dict) -> None:
    from rich.table import Table
    from rich.text import Text

    from studio.cli.terminal import make_console

    console = make_console()
    design = ", ".join(f"{name} {value:.3g}" for name, value in result["phi"].items())
    console.print(Text(f"{result['run']}, iteration {result['iteration']}: {design}"), soft_wrap=True)
    if note := policy_note(result["iteration"], result["policy_iteration"]):
        console.print(Text(note), soft_wrap=True)
    table = Table(box=None, pad_edge=False)
    milestones, diverged = list(result["sampled"]["milestones"]), ["diverged"] * _any_diverged(result)
    first = f"policy, {result['episodes']} episodes"
    for heading in (first, "success [95 %]", *milestones, "return [95 %]", *diverged):
        table.add_column(heading, justify="left" if heading.startswith("policy") else "right")
    for policy in ("sampled", "deterministic"):
        score = result[policy]
        shares = [f"{share:.3f}" for share in score["milestones"].values()]
        lost = [str(score["diverged"])] * len(diverged)
        success = _with_interval(score["success"], score["success_interval"])
        returns = _with_interval(score["episode_return"], score["return_interval"])
        table.add_row(policy, success, *shares, returns, *lost)
    console.print(table)


def _with_interval(value: float, ends: Sequence[float]) -> str:
    return "{:.3f} [{:.2f}, {:.2f}]".format(value, *ends)


def _any_diverged(result: dict) -> bool:
    return any(result[policy]["diverged"] for policy in ("sampled", "deterministic"))
