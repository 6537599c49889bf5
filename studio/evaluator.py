"""The process that evaluates designs, held ready: started when somebody asks, one question at a time, gone when idle.

It alone loads torch. It ends with the server, and whatever kills it is told as an error of the question at hand.
"""

import contextlib
import heapq
import itertools
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from typing import IO

import msgspec

from morph_core.what_if import (
    Answer,
    Asked,
    Measured,
    Played,
    Question,
    Refused,
    Told,
    Withdrawal,
    Withdrawn,
    decode_told,
)
from studio.cancellation import Cancellation, CancelledError
from studio.trainers import trainer_environment

IDLE = 300.0
"""Seconds without a question after which the process ends by itself."""
MEMORY = 2 << 30
"""Largest size of the memory that is the process's own, in bytes."""
LONGEST = 120.0
"""Seconds after which a question is given up, and the process with it."""
GRACE = 3.0
"""Seconds in which a question that was withdrawn must be given up, or the process is killed."""
MOST_WAITING = 16
"""Largest number of questions that wait for their turn."""
_HURRIED, _PATIENT = 0, 1

Spawn = Callable[[IO[bytes]], subprocess.Popen[bytes]]
"""Function that starts the process, with a file for what it says beside its answers."""


class EvaluatorError(RuntimeError):
    """The process that evaluates designs has died or is overloaded: a question has no answer, though it was allowed."""


def spawn_evaluator(said: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start the process; it reads questions on its standard input."""
    words = ["-P", "-m", "morph_core.evaluator", "--idle", str(IDLE), "--memory", str(MEMORY)]
    return subprocess.Popen(
        [sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said,
        env=trainer_environment(), start_new_session=True,
    )  # fmt: skip


class Evaluator:
    """One process that evaluates designs, and the queue before it. It is thread-safe."""

    def __init__(self, spawn: Spawn = spawn_evaluator) -> None:
        self._spawn = spawn
        self._turn = threading.Condition()
        self._numbers = itertools.count(1)
        self._waiting: list[tuple[int, int]] = []  # (how patient, number), a heap
        self._at_work: int | None = None
        self._process: _Process | None = None
        self._closed = False

    def warm_up(self) -> None:
        """Start the process, unless it is there: it takes seconds to load."""
        with self._turn:
            if self._at_work is None and not self._closed:
                self._present()

    def ask(
        self,
        question: Question,
        cancellation: Cancellation,
        *,
        patient: bool = False,
        on_played: Callable[[bytes], None] | None = None,
    ) -> Measured:
        """Wait for the turn of a question, and for its answer; its `id` is given anew.

        Questions that are `patient` let all others go before them. `on_played` is handed an episode before the rest is
        run. Raise ValueError with the reason if the question is refused, CancelledError once it is cancelled, and
        EvaluatorError if the process dies of it or too many wait.
        """
        number = next(self._numbers)
        question = msgspec.structs.replace(question, id=number, shown=on_played is not None)
        with self._my_turn(number, cancellation, _PATIENT if patient else _HURRIED):
            for _ in range(2):
                process = self._present()
                told = process.answer(question, cancellation, on_played)
                if told is not None:
                    return told
            raise EvaluatorError("the process that evaluates designs ends as soon as it is started")

    def close(self) -> None:
        """End the process; whoever waits is told so."""
        with self._turn:
            self._closed = True
            self._turn.notify_all()
            if self._process is not None:
                self._process.kill()

    @contextlib.contextmanager
    def _my_turn(self, number: int, cancellation: Cancellation, patience: int) -> Iterator[None]:
        """Wait until no other question is at work and none goes before; then keep all others waiting."""
        mine = patience, number
        cancellation.call(self._wake)
        try:
            with self._turn:
                if len(self._waiting) >= MOST_WAITING:
                    raise EvaluatorError(f"{MOST_WAITING} evaluations wait already: try again once they are done")
                heapq.heappush(self._waiting, mine)
                self._turn.wait_for(
                    lambda: cancellation.is_set or self._closed or (self._at_work is None and self._waiting[0] == mine)
                )
                self._waiting.remove(mine)
                heapq.heapify(self._waiting)
                self._turn.notify_all()
                cancellation.check()
                if self._closed:
                    raise EvaluatorError("the server is about to end")
                self._at_work = number
            try:
                yield
            finally:
                with self._turn:
                    self._at_work = None
                    self._turn.notify_all()
        finally:
            cancellation.forget(self._wake)

    def _wake(self) -> None:
        with self._turn:
            self._turn.notify_all()

    def _present(self) -> "_Process":
        """Return the process; start one if there is none."""
        with self._turn:
            if self._process is None or self._process.is_gone:
                self._process = _Process(self._spawn)
            return self._process


class _Process:
    """One process, and what it says."""

    def __init__(self, spawn: Spawn) -> None:
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - held as long as the process
        self._child = spawn(self._said)
        self._writing = threading.Lock()
        self._outlived = False
        """Whether it was killed because a question took too long."""

    @property
    def is_gone(self) -> bool:
        """Tell whether it has ended."""
        return self._child.poll() is not None

    def kill(self) -> None:
        """End it at once, and wait until it has."""
        self._child.kill()
        self._child.wait()

    def answer(
        self, question: Question, cancellation: Cancellation, on_played: Callable[[bytes], None] | None
    ) -> Measured | None:
        """Return the answer to a question, or None if the process had ended for want of questions."""

        def withdraw() -> None:
            self._kill_after(GRACE, timers)
            self._write(Withdrawal(question.id))

        timers: list[threading.Timer] = []
        self._kill_after(LONGEST, timers)
        try:
            self._write(question)
            cancellation.call(withdraw)
            return self._read(question, cancellation, on_played)
        finally:
            cancellation.forget(withdraw)
            for timer in timers:
                timer.cancel()

    def _read(
        self, question: Question, cancellation: Cancellation, on_played: Callable[[bytes], None] | None
    ) -> Measured | None:
        for told in self._told():
            if told.id != question.id:
                continue
            match told:
                case Played(episode=episode):
                    if on_played is not None and not cancellation.is_set:
                        on_played(episode)
                case Answer(measured=measured):
                    cancellation.check()
                    return measured
                case Refused(reason=reason):
                    raise ValueError(reason)
                case Withdrawn():
                    raise CancelledError("given up: nobody waits for it any more")
        status = self._child.wait()
        cancellation.check()
        if status == 0:
            return None
        raise EvaluatorError(self._epitaph(status))

    def _told(self) -> Iterator[Told]:
        assert self._child.stdout is not None
        for line in self._child.stdout:
            yield decode_told(line)

    def _write(self, asked: Asked) -> None:
        assert self._child.stdin is not None
        with self._writing, contextlib.suppress(OSError):  # it has ended: the reader finds out how
            self._child.stdin.write(msgspec.json.encode(asked) + b"\n")
            self._child.stdin.flush()

    def _kill_after(self, seconds: float, timers: list[threading.Timer]) -> None:
        def outlive() -> None:
            self._outlived = True
            self.kill()

        timer = threading.Timer(seconds, outlive)
        timer.daemon = True
        timers.append(timer)
        timer.start()

    def _epitaph(self, status: int) -> str:
        """Return in a sentence why the process is dead."""
        if self._outlived:
            return f"this evaluation took longer than {LONGEST:g} s and was given up: ask for fewer episodes"
        self._said.seek(max(0, self._said.seek(0, os.SEEK_END) - 4096))
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        last = f" ({lines[-1][:200]})" if lines else ""
        return f"the process that evaluates designs {how}{last}; the next question starts another one"
