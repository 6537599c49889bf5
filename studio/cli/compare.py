"""`morph-studio compare`: two designs of any runs of one task, and how they differ."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from morph_core.run_folder import RunFolderError
from studio.cli.arguments import RunsArguments, UsageError, parse
from studio.cli.choice import open_run
from studio.cli.output import write_json
from studio.compare import Compared, Side, compare, split_place

_NOT_KNOWN = "-"
Place = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN[@DESIGN]")]


@dataclass(frozen=True)
class CompareArguments(RunsArguments):
    """Compare two designs of any runs of one task: success, return and reward terms on Hw-Phy, phi, and masses."""

    a: Place = tyro.MISSING
    """First design: a run, by name or path, and after @ one of best, latest or an iteration; without it the best."""
    b: Place = tyro.MISSING
    """Second design, in the same way."""
    json: bool = False
    """Print one JSON document and nothing else."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio compare` with these words; return the exit status."""
    arguments = parse(CompareArguments, words, "compare")
    (first, which), (second, other) = split_place(arguments.a), split_place(arguments.b)
    try:
        found = compare(open_run(arguments.runs, first), which, open_run(arguments.runs, second), other)
    except RunFolderError as error:
        raise UsageError(str(error)) from error
    except ValueError as error:
        raise UsageError(f"compare: {error}") from error
    if arguments.json:
        write_json(found)
    else:
        _print(found)
    return 0


def _print(found: Compared) -> None:
    """Print a line for each quantity: both values and what the second has more."""
    from rich.table import Table
    from rich.text import Text

    from studio.cli.terminal import make_console

    console = make_console()
    for name, side in (("A", found.a), ("B", found.b)):
        episodes = f", {side.episodes} episodes" if side.episodes else ""
        console.print(Text(f"{name}: {side.run}, iteration {side.iteration}{episodes}"), soft_wrap=True)
        if side.note:
            console.print(Text(f"   {side.note}"), soft_wrap=True)
    table = Table(box=None, pad_edge=False)
    for heading in ("", "A", "B", "B - A"):
        table.add_column(heading, justify="right" if heading else "left")
    a, b, more = found.a, found.b, found.differences
    table.add_row(Text("success [95 %]"), _success(a), _success(b), _signed(more.success))
    table.add_row(Text("return [95 %]"), _return(a), _return(b), _signed(more.episode_return))
    for term in dict.fromkeys((*a.reward_terms, *b.reward_terms)):
        values = [_number(side.reward_terms.get(term)) for side in (a, b)]
        table.add_row(f"  {term}", *values, _signed(more.reward_terms.get(term)))
    for name in dict.fromkeys((*a.phi, *b.phi)):
        values = [_number(side.phi.get(name)) for side in (a, b)]
        table.add_row(Text(f"{name} [{found.units[name]}]".removesuffix(" []")), *values, _signed(more.phi.get(name)))
    table.add_row(Text("mass of the robot [kg]"), _number(a.mass), _number(b.mass), _signed(more.mass))
    for body in dict.fromkeys((*a.masses, *b.masses)):
        values = [_number(side.masses.get(body)) for side in (a, b)]
        table.add_row(f"  {body}", *values, _signed(more.masses.get(body)))
    console.print(table)


def _success(side: Side) -> str:
    return _with_interval(side.success, side.success_interval)


def _return(side: Side) -> str:
    return _with_interval(side.episode_return, side.return_interval)


def _with_interval(value: float | None, ends: tuple[float, float] | None) -> str:
    return _number(value) + (" [{:.2f}, {:.2f}]".format(*ends) if ends else "")


def _number(value: float | None) -> str:
    return _NOT_KNOWN if value is None else f"{value:.3f}"


def _signed(value: float | None) -> str:
    return _NOT_KNOWN if value is None else f"{value:+.3f}"
