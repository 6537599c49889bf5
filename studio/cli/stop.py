"""`morph-studio stop`: end the trainer of a run, after its iteration or at once, or take the run out of the queue."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from morph_core.protocol import Kill, Stop
from studio.cli.arguments import RunName, RunsArguments, UsageError, parse
from studio.cli.choice import open_run
from studio.cli.output import say
from studio.log import sender_here
from studio.overdue import KILL_OFFERED_AFTER
from studio.runs import Runs


@dataclass(frozen=True)
class StopArguments(RunsArguments):
    """Save a checkpoint after the present iteration and end the trainer; a run that waits leaves the queue."""

    run: Annotated[RunName, tyro.conf.Positional] = tyro.MISSING
    """Run to stop: its name, or the path of its folder."""
    kill: bool = False
    """End the trainer at once, without a checkpoint: what came after the newest one is done again at a resume."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio stop` with these words; return the exit status."""
    arguments = parse(StopArguments, words, "stop")
    folder = open_run(arguments.runs, arguments.run).folder
    place = shlex.quote(str(folder.path))
    command = Kill() if arguments.kill else Stop()
    try:
        number = Runs(folder.path.parent).send(folder.id, command, sender_here("command line"))
    except ValueError as error:
        raise UsageError(f"stop: {error}") from error
    if number:
        say(
            f"{folder.id} stops after its iteration; where it has not after {KILL_OFFERED_AFTER:.0f} s: "
            f"morph-studio stop {place} --kill"
        )
    else:
        say(f"{folder.id} is ended; to go on: morph-studio train --resume {place}")
    return 0
