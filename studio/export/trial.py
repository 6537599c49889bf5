"""The episodes that prove a policy on the exported scene, run by a process of its own beside the rest of an export.

It is started as `python -P -m studio.export.trial` before the scene is written, reads the path of a trial on its
standard input, and writes what the trial comes to on its standard output, both as MessagePack.
"""

import contextlib
import math
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec
import numpy as np

from morph_core.catalogue import make_task
from morph_core.task import Task
from morph_core.tasks.servos import ServoName
from studio.export.apart import environment
from studio.export.check import Check
from studio.export.demand import Recorder
from studio.export.policy import Score
from studio.export.proof import prove_policy
from studio.export.servos import ServoTable, compared_servos
from studio.robots.chooser import robot_of

APART = 100
"""Number of episodes from which a process of its own pays: fewer take less time than to start one."""
PATIENCE = 600.0
"""Seconds after which a trial is given up; one of 256 episodes takes seven of the processor."""
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
    phi: Sequence[float]
    promised: Sequence[Score]
    """Scores with which the policy's success is compared."""
    servo: ServoName | None
    """Servo with which its needs are compared; None for one that they choose."""
    episodes: int

    def run(self) -> Outcome:
        """Run the episodes in this process."""
        task, phi, recorder = make_task(self.task, self.task_options), np.array(self.phi), Recorder()
        found, checks = prove_policy(self.files, task, phi, [*self.promised], self.episodes, recorder)
        return Outcome(found, checks, compared_servos(recorder, task, phi, self.servo))


def is_long(task: Task, episodes: int) -> bool:
    """Tell whether a trial takes seconds: it has many episodes, of a robot whose physics is simulated."""
    return episodes >= APART and bool(robot_of(task).servo_joints)


class Runner:
    """What runs a trial: a process `apart`, which loads while the trial is prepared, or this one when it is waited for.

    Used in a `with` block, at whose end the process is gone.
    """

    def __init__(self, *, apart: bool) -> None:
        self._apart = apart
        self._trial: Trial | None = None

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            if self._apart:
                stack.enter_context(_TURN)
                self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "studio.export.trial"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                    env=environment(), start_new_session=True,
                )  # fmt: skip
                stack.callback(self._end)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def begin(self, trial: Trial) -> None:
        """Run a trial from now on."""
        self._trial = trial
        if not self._apart:
            return
        path = self._folder / "trial"
        path.write_bytes(msgspec.msgpack.encode(trial))
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it is dead, which is told when it is waited for
            self._process.stdin.write(os.fsencode(path) + b"\n")
            self._process.stdin.flush()

    def outcome(self) -> Outcome:
        """Wait for what the trial comes to; nothing where none was begun."""
        if self._trial is None:
            return Outcome(None, [], None)
        if not self._apart:
            return self._trial.run()
        try:
            told, _ = self._process.communicate(timeout=PATIENCE)
            return msgspec.msgpack.decode(told, type=Outcome)
        except subprocess.TimeoutExpired:
            return _failed(f"the episodes took more than {PATIENCE:g} s")
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return _failed("its process ended without a word, perhaps for want of memory")

    def _end(self) -> None:
        self._process.kill()
        with contextlib.suppress(BrokenPipeError):
            self._process.__exit__(None, None, None)  # closes its pipes, and waits


def _failed(why: str) -> Outcome:
    return Outcome(None, [Check("policy", math.inf, 0.0, f"can't be run: {why}")], None)


def main() -> int:
    """Run the trial whose path comes on standard input; return the exit status."""
    told = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what readers print is no outcome
    path = sys.stdin.buffer.readline()
    if not path:  # whoever has started this has given it up
        return 1
    trial = msgspec.msgpack.decode(Path(os.fsdecode(path.rstrip(b"\n"))).read_bytes(), type=Trial)
    try:
        came = trial.run()
    except Exception as error:  # as with every other file
        came = _failed(str(error) or type(error).__name__)
    with contextlib.suppress(BrokenPipeError):
        told.write(msgspec.msgpack.encode(came))
        told.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
