"""`morph-studio log`: what was done to a run, each command with its iteration and who sent it."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from studio.cli.arguments import RunName, RunsArguments, parse
from studio.cli.choice import open_run
from studio.cli.output import write_json
from studio.log import LogEntry, log_of


@dataclass(frozen=True)
class LogArguments(RunsArguments):
    """Print what was done to a run: its commands with what became of them, and each start and end of its trainer."""

    run: Annotated[RunName, tyro.conf.Positional] = tyro.MISSING
    """Run whose log is printed: its name, or the path of its folder."""
    json: bool = False
    """Print one JSON document and nothing else."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio log` with these words; return the exit status."""
    arguments = parse(LogArguments, words, "log")
    entries = log_of(open_run(arguments.runs, arguments.run))
    if arguments.json:
        write_json(entries)
    else:
        _print_table(entries)
    return 0


def _print_table(entries: list[LogEntry]) -> None:
    from rich.table import Table
    from rich.text import Text

    from studio.cli.terminal import make_console

    console = make_console()
    if not entries:
        console.print("nothing was done to this run yet")
        return
    table = Table(box=None, pad_edge=False)
    for heading in ("iteration", "time", "what", "by"):
        table.add_column(heading, justify="right" if heading == "iteration" else "left", overflow="fold")
    for entry in entries:
        undone = ", undone: the trainer went on from before it" if entry.undone else ""
        when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(entry.time))
        table.add_row(str(entry.iteration), when, Text(entry.words + undone), Text(entry.sender))
    console.print(table)
