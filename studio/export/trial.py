"""The episodes that prove a policy on the exported scene, run by a process of its own beside the rest of an export."""

import math
import multiprocessing
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np

from morph_core.catalogue import make_task
from morph_core.tasks.servos import ServoName
from studio.export.check import Check
from studio.export.demand import Recorder
from studio.export.policy import Score
from studio.export.proof import prove_policy
from studio.export.servos import ServoTable, compared_servos
from studio.robots.chooser import robot_of

APART = 100
"""Number of episodes from which a process of its own pays: fewer take less time than to start one."""
_TURN = threading.Lock()
"""Held by the trial that is under way: each takes all cores, and memory of its own."""


@dataclass(frozen=True)
class Outcome:
    """What the episodes have come to."""

    score: Score | None
    """Success of the policy; None where it can't be run."""
    checks: list[Check]
    table: ServoTable | None
    """What the policy needs beside what a servo has; None where the hardware has no servos."""


@dataclass(frozen=True)
class Trial:
    """What is tried: a policy on the scene of some files."""

    files: Mapping[str, bytes]
    task: str
    task_options: dict[str, object]
    phi: np.ndarray  # (d,)
    promised: Sequence[Score]
    """Scores with which the policy's success is compared."""
    servo: ServoName | None
    """Servo with which its needs are compared; None for one that they choose."""
    episodes: int

    @property
    def is_long(self) -> bool:
        """Whether it takes seconds: many episodes, of a robot whose physics is simulated."""
        return self.episodes >= APART and bool(robot_of(make_task(self.task, self.task_options)).servo_joints)

    def run(self) -> Outcome:
        """Run the episodes in this process."""
        task, recorder = make_task(self.task, self.task_options), Recorder()
        found, checks = prove_policy(self.files, task, self.phi, [*self.promised], self.episodes, recorder)
        return Outcome(found, checks, compared_servos(recorder, task, self.phi, self.servo))


@contextmanager
def begun(trial: Trial | None) -> Iterator[Callable[[], Outcome]]:
    """Begin a trial, and give the function that waits for what it comes to: nothing where there is none.

    One that takes seconds is run in a process of its own, any other when it is waited for.
    """
    if trial is None or not trial.is_long:
        yield trial.run if trial else lambda: Outcome(None, [], None)
        return
    # A fork has all modules loaded, but would copy the locks that other threads hold.
    alone = sys.platform == "linux" and threading.active_count() == 1
    context = multiprocessing.get_context("fork") if alone else multiprocessing.get_context("spawn")
    end, other = context.Pipe(duplex=False)
    with _TURN:
        process = context.Process(target=_run, args=(trial, other), daemon=True)
        process.start()
        other.close()
        try:
            yield lambda: awaited(end)
        finally:
            process.terminate()
            process.join()
            end.close()


def awaited(end: Connection) -> Outcome:
    """Return what the process at the other end comes to."""
    try:
        told = end.recv()
    except EOFError:
        told = "its process ended without a word, perhaps for want of memory"
    return told if isinstance(told, Outcome) else Outcome(None, [_failed(told)], None)


def _failed(why: str) -> Check:
    return Check("policy", math.inf, 0.0, f"can't be run: {why}")


def _run(trial: Trial, end: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who has started the process ends it
    try:
        end.send(trial.run())
    except Exception as error:  # as with every other file
        end.send(f"{str(error) or type(error).__name__}")
