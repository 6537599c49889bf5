"""`morph-studio import`: go on from a design that was exported, in a running run or in a new one."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from morph_core.protocol import InjectDesign
from studio.cli.arguments import Count, RunsArguments, UsageError, parse
from studio.cli.choice import open_run
from studio.cli.output import complain, say

DESIGN_METAVAR = "DESIGN"


@dataclass(frozen=True)
class ImportArguments(RunsArguments):
    """Read a design.json, or a bundle for its design.json; nothing else in a bundle is looked at."""

    design: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar=DESIGN_METAVAR)] = tyro.MISSING
    """Design to go on from: a design.json, or the zip or folder that morph-studio export wrote."""
    into: Annotated[str | None, tyro.conf.arg(metavar="RUN")] = None
    """Hand the design to this run, whose trainer is at work and goes on from there."""
    start: bool = False
    """Start a new run from the design."""
    method: Annotated[str, tyro.conf.arg(metavar="METHOD")] = "morph"
    """Method of the new run."""
    seed: int = 0
    """Seed of the new run."""
    iterations: Count = 100
    """Iterations of the new run."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio import` with these words; return the exit status."""
    arguments = parse(ImportArguments, words, "import")
    if arguments.into is not None and arguments.start:
        raise UsageError("import: choose one of --into RUN and --start")
    from studio.export.design_file import load_design, phi_for
    from studio.export.errors import ExportError

    try:
        design = load_design(arguments.design)
        if arguments.start:
            return _start(arguments, design)
        if arguments.into is not None:
            history = open_run(arguments.runs, arguments.into)
            return _send(history, phi_for(design, history.record.task, history.design_space).tolist())
    except ExportError as error:
        raise UsageError(f"import: {error}") from error
    say(f"{design.task}, iteration {design.iteration} of {design.run}")
    for p in design.parameters:
        say(f"  {p.name} = {p.value:.6g} {p.unit}")
    say("go on from it: --into RUN, --start, or morph-studio evaluate RUN --phi-from DESIGN")
    return 0


def _send(history, phi: list[float]) -> int:
    from studio.log import sender_here
    from studio.runs import Runs

    folder = history.folder
    try:
        number = Runs(folder.path.parent).send(folder.id, InjectDesign(phi), sender_here("command line"))
    except ValueError as error:
        raise UsageError(f"import: {error}") from error
    say(f"sent to {folder.id} as command {number}")
    return 0


def _start(arguments: ImportArguments, design) -> int:
    from studio.cli.follow import follow
    from studio.export.design_file import starting_from
    from studio.new_run import StartRun, prepare_run
    from studio.trainers import spawn_trainer

    wish = StartRun(method=arguments.method, seed=arguments.seed, iterations=arguments.iterations)
    try:
        folder = prepare_run(arguments.runs, starting_from(design, wish))
    except (ValueError, TypeError, OSError) as error:
        raise UsageError(f"import: {error}") from error
    complain(folder.id)
    return follow(folder, lambda: spawn_trainer(folder, further=None), quiet=False).code
