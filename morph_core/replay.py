"""`python -m morph_core.replay --run DIR`: a run done again from its seed and its log, compared with what it wrote.

It prints one JSON document a line: `{"iteration": .., "of": ..}` as it goes, then the comparison. The run's folder is
only read.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import torch

from morph_core.beginning import begin
from morph_core.catalogue import make_task, read_method
from morph_core.edits import AnyEdit
from morph_core.history import History
from morph_core.processor import processor
from morph_core.protocol import Progress, StateChanged
from morph_core.run_folder import RunFolder, RunFolderError
from morph_core.train import apply_edit


class Difference(msgspec.Struct, frozen=True):
    """The first iteration after which a run and its replay have another phi."""

    iteration: int
    recorded: list[float]
    replayed: list[float]


class Processor(msgspec.Struct, frozen=True):
    """A processor, and the instruction set that torch takes on it; empty where a run does not say."""

    name: str
    instruction_set: str


class Comparison(msgspec.Struct, frozen=True):
    """What a replay found."""

    run: str
    compared: int
    """Number of iterations whose phi was compared."""
    difference: Difference | None
    recorded_on: list[Processor]
    """The processors on which the run was started and gone on with, each once."""
    replayed_on: Processor


def replayed(history: History) -> Iterator[tuple[Progress, Progress]]:
    """Do a run again from its beginning; yield what it wrote of each iteration, and what came out this time.

    The commands of its log are obeyed where they were. What a resume voided is left out, as it is in the history.
    """
    record = history.record
    task, method = make_task(record.task, record.task_options), read_method(record)
    written = {progress.iteration: progress for progress in history.progress}
    edits = defaultdict(list)
    for event in history.commands():
        if isinstance(event.command, AnyEdit):
            edits[event.iteration].append(event.command)
    state = begin(history.folder, record, task, method).state
    for command in edits[state.iteration]:
        apply_edit(command, state, task)
    if state.iteration >= history.iteration:
        return
    for progress in method.iterations(task, state):
        if progress.iteration in written:
            yield written[progress.iteration], progress
        for command in edits[progress.iteration]:
            apply_edit(command, state, task)
        if progress.iteration >= history.iteration:
            return


def compare(history: History, last: int) -> Iterator[dict[str, int] | Comparison]:
    """Yield how far a replay up to the iteration `last` is, and in the end, or at a first difference, what it found."""
    difference, compared = None, 0
    for recorded, again in replayed(history):
        if recorded.iteration > last:
            break
        compared += 1
        if not np.array_equal(recorded.phi, again.phi):
            difference = Difference(recorded.iteration, recorded.phi, again.phi)
            break
        yield {"iteration": recorded.iteration, "of": last}
    yield Comparison(history.folder.id, compared, difference, _processors(history), this_processor())


def this_processor() -> Processor:
    """Return the processor at work here."""
    return Processor(processor(), torch.backends.cpu.get_cpu_capability())


def _processors(history: History) -> list[Processor]:
    starts = [e for e in history.events if isinstance(e, StateChanged) and e.status == "starting"]
    return list(dict.fromkeys(Processor(e.processor, e.instruction_set) for e in starts))


def main() -> int:
    """Replay and compare; 0 where nothing differs, 1 where something does, 2 where the run does not allow it."""
    parser = argparse.ArgumentParser(prog="python -m morph_core.replay", description=__doc__)
    parser.add_argument("--run", type=Path, required=True, help="run folder")
    parser.add_argument("--until", type=int, help="last iteration to compare (default: the last recorded one)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    try:
        history = History(RunFolder(options.run.resolve()))
        last = history.iteration if options.until is None else min(options.until, history.iteration)
        for said in compare(history, last):
            print(msgspec.json.encode(said).decode(), flush=True)  # noqa: T201 - a process entry
    except (RunFolderError, ValueError, TypeError) as error:
        print(f"morph_core.replay: {error}", file=sys.stderr)  # noqa: T201 - a process entry
        return 2
    return 1 if isinstance(said, Comparison) and said.difference else 0


if __name__ == "__main__":
    sys.exit(main())
