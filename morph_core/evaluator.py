"""`python -m morph_core.evaluator`: answers what-if questions, a line of JSON each, for as long as somebody asks.

It keeps torch and the last policies loaded, and ends when its standard input does, or after a while without a question.
"""

import argparse
import functools
import io
import os
import queue
import resource
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import msgspec
import numpy as np
import torch

from morph_core.catalogue import make_task, read_method
from morph_core.checkpoint import load_checkpoint
from morph_core.design import DesignSpace
from morph_core.episodes import play, record_episode
from morph_core.evaluate import measure
from morph_core.networks import Policy
from morph_core.run_folder import RunFolder, RunFolderError
from morph_core.task import Task
from morph_core.what_if import Answer, Played, Question, Refused, Told, Withdrawal, Withdrawn, decode_asked

POLICIES_KEPT = 4
"""Number of policies that stay loaded."""


class _GivenUp(Exception):
    """The question at hand was withdrawn."""


class Inbox:
    """The questions that wait, read by a thread of its own, so that a withdrawal is noticed between two steps."""

    def __init__(self, lines: BinaryIO, on_end: Callable[[], None]) -> None:
        """Read `lines` until they end, and call `on_end` then."""
        self._questions: queue.SimpleQueue[Question] = queue.SimpleQueue()
        self._withdrawn: int | None = None  # the last one: who asks waits for each answer before the next question
        threading.Thread(target=self._read, args=(lines, on_end), name="inbox", daemon=True).start()

    def questions(self, idle: float) -> Iterator[Question]:
        """Yield the questions as they come, until there is none for `idle` seconds."""
        while True:
            try:
                yield self._questions.get(timeout=idle)
            except queue.Empty:
                return

    def check(self, number: int) -> None:
        """Raise _GivenUp if the question of this number was withdrawn."""
        if number == self._withdrawn:
            raise _GivenUp

    def _read(self, lines: BinaryIO, on_end: Callable[[], None]) -> None:
        for line in lines:
            match decode_asked(line):
                case Question() as question:
                    self._questions.put(question)
                case Withdrawal(id=number):
                    self._withdrawn = number
        on_end()


def answer(question: Question, check: Callable[[], None]) -> Iterator[Told]:
    """Yield what is to be told of a question; `check` is called before every control step."""
    check()
    folder = RunFolder(Path(question.run))
    weights = folder.checkpoint(question.checkpoint) / "weights.safetensors"
    try:
        changed = weights.stat().st_mtime_ns
    except OSError as error:
        raise RunFolderError(f"checkpoint {question.checkpoint} of {folder.id} is gone: {error.strerror}") from error
    task, space, policy = _loaded(folder, question.checkpoint, changed)
    phi = space.check(question.phi)
    task.check_buildable(phi)
    seeds = (question.seed, question.iteration)
    if question.shown:
        one = play(task, policy, phi, 1, np.random.default_rng(seeds), question.sampled, check)
        yield Played(id=question.id, episode=_npz(record_episode(task, one, phi)))
    measured, _ = measure(task, policy, phi, question.episodes, seeds, question.sampled, check)
    yield Answer(id=question.id, measured=measured)


@functools.lru_cache(maxsize=POLICIES_KEPT)
def _loaded(folder: RunFolder, checkpoint: int, _changed: int) -> tuple[Task, DesignSpace, Policy]:
    """Return a run's task, its whole box, and the policy of a checkpoint; one that was changed since is read anew."""
    record = folder.record()
    task = make_task(record.task, record.task_options)
    state, _ = load_checkpoint(folder, checkpoint, task, read_method(record))
    return task, DesignSpace(tuple(record.parameters)).whole, state.control.policy


def _npz(arrays: dict[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def main() -> None:
    """Answer what is asked on standard input, on standard output, until nobody has asked for `--idle` seconds."""
    parser = argparse.ArgumentParser(prog="python -m morph_core.evaluator", description=__doc__)
    parser.add_argument("--idle", type=float, required=True, help="seconds without a question after which it ends")
    parser.add_argument("--memory", type=int, required=True, help="bytes of memory of its own that it may take")
    options = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_DATA, (options.memory, options.memory))
    torch.set_num_threads(1)
    told = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a task prints is no answer
    inbox = Inbox(sys.stdin.buffer, on_end=lambda: os._exit(0))
    for question in inbox.questions(options.idle):
        for line in _answered(question, functools.partial(inbox.check, question.id)):
            told.write(msgspec.json.encode(line) + b"\n")
            told.flush()
    os._exit(0)  # an ordinary end would wait for the thread that reads


def _answered(question: Question, check: Callable[[], None]) -> Iterator[Told]:
    try:
        yield from answer(question, check)
    except _GivenUp:
        yield Withdrawn(id=question.id)
    except MemoryError:
        yield Refused(id=question.id, reason="this evaluation needs more memory than it may take: try fewer episodes")
    except (ValueError, OSError) as error:
        yield Refused(id=question.id, reason=str(error) or type(error).__name__)
    except Exception as error:  # a task or a method of another package may raise anything
        yield Refused(id=question.id, reason=f"the evaluation failed: {type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
