"""`morph-studio evaluate`: measure success and return of a design on Hw-Phy, in a process of its own."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import morph_core
from morph_core.design import DesignSpace
from morph_core.history import History
from studio.cli.arguments import Count, RunName, RunsArguments, UsageError, parse
from studio.cli.choice import check_design, open_run
from studio.cli.export import DesignName


@dataclass(frozen=True)
class EvaluateArguments(RunsArguments):
    """Measure success and return of a design on Hw-Phy, with the policy of the same iteration."""

    run: tyro.conf.Positional[RunName] = tyro.MISSING
    """Name of a run, or the path of its folder."""
    design: DesignName = "best"
    """Design to measure: the best evaluated one, the latest one, or that of an iteration."""
    phi_from: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """File of another design to measure with the same policy: a design.json, or an export that holds one."""
    episodes: Count = 100
    """Number of episodes for the sampled policy, and as many for the deterministic one."""
    json: bool = False
    """Print one JSON document and nothing else."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio evaluate` with these words; return the exit status."""
    arguments = parse(EvaluateArguments, words, "evaluate")
    if arguments.episodes < 1:
        raise UsageError(f"evaluate: --episodes must be at least 1, not {arguments.episodes}")
    history = open_run(arguments.runs, arguments.run)
    check_design(history, arguments.design)
    phi = _imported(history, arguments.phi_from) if arguments.phi_from else None
    done = _evaluate(history.folder.path, arguments.design, arguments.episodes, phi)
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or [f"it ended with {done.returncode}"]
        print(f"morph-studio: {reason[0].removeprefix('morph_core.')}", file=sys.stderr)  # noqa: T201
        return 2 if done.returncode == 2 else 1
    if arguments.json:
        sys.stdout.write(done.stdout)
    else:
        _print_result(json.loads(done.stdout))
    return 0


def _imported(history: History, path: Path) -> list[float]:
    from studio.export.design_file import load_design, phi_for
    from studio.export.errors import ExportError

    try:
        space = DesignSpace(tuple(history.record.parameters))
        return phi_for(load_design(path), history.record.task, space).tolist()
    except ExportError as error:
        raise UsageError(f"evaluate: {error}") from error


def _evaluate(folder: Path, design: str, episodes: int, phi: list[float] | None) -> subprocess.CompletedProcess[str]:
    """Run the evaluation in a process of its own: it needs torch, this one does not."""
    code = str(Path(morph_core.__file__).resolve().parents[1])
    path = os.pathsep.join(p for p in (code, os.environ.get("PYTHONPATH")) if p)
    return subprocess.run(
        [sys.executable, "-P", "-m", "morph_core.evaluate", "--run", str(folder.resolve()), "--design", design,
         "--episodes", str(episodes), *(["--phi", json.dumps(phi)] if phi else [])],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}, check=False,
    )  # fmt: skip


def _print_result(result: dict) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    design = ", ".join(f"{name} {value:.3g}" for name, value in result["phi"].items())
    console.print(Text(f"{result['run']}, iteration {result['iteration']}: {design}"), soft_wrap=True)
    table = Table(box=None, pad_edge=False)
    milestones, diverged = list(result["sampled"]["milestones"]), ["diverged"] * _any_diverged(result)
    for heading in (f"policy, {result['episodes']} episodes", "success", *milestones, "return", *diverged):
        table.add_column(heading, justify="left" if heading.startswith("policy") else "right")
    for policy in ("sampled", "deterministic"):
        score = result[policy]
        shares = [f"{share:.3f}" for share in (score["success"], *score["milestones"].values())]
        lost = [str(score["diverged"])] * len(diverged)
        table.add_row(policy, *shares, f"{score['episode_return']:.3f}", *lost)
    console.print(table)


def _any_diverged(result: dict) -> bool:
    return any(result[policy]["diverged"] for policy in ("sampled", "deterministic"))
