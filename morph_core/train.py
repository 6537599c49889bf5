"""The trainer process, `python -m morph_core.train --run DIR`: loops a method, writes the folder, obeys commands."""

import argparse
import contextlib
import functools
import os
import platform
import shlex
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import psutil
import torch

from morph_core import protocol
from morph_core.beginning import begin
from morph_core.catalogue import make_task, read_method
from morph_core.checkpoint import damage_of, load_checkpoint, load_newest, recover_checkpoints, save_checkpoint
from morph_core.edits import AnyEdit, edited
from morph_core.episodes import Score, evaluate, outcomes, record_episodes
from morph_core.history import History, InForce, merit
from morph_core.inside import NotPlainError, open_plain
from morph_core.keeping import tidy
from morph_core.method import Method
from morph_core.pace import Rest
from morph_core.processor import processor
from morph_core.protocol import (
    Acknowledged,
    AnyCommand,
    AnyEvent,
    DesignSpaceChanged,
    Evaluation,
    Heartbeat,
    Order,
    Progress,
    StateChanged,
    Status,
)
from morph_core.rollout import Rollout
from morph_core.run_folder import (
    SAID_ENDED,
    EventLog,
    HeartbeatFile,
    HeldError,
    RunFolder,
    RunFolderError,
    hold,
    write_episode,
)
from morph_core.state import State
from morph_core.task import Task
from morph_core.undo import earlier_edits, edits_since, take_back, unruly_alpha

T = TypeVar("T")
HEARTBEAT_SECONDS = 1.0
POLL_SECONDS = 0.02
RETRY_SECONDS = 1.0
PAUSED = "it keeps its core, on a cluster too: Resume goes on, Stop saves and frees the core"
_LEARNING = "collecting and learning"
LAST_ITERATION = 10**9
"""Largest number of iterations that a trainer can be asked for."""
SHOWN_DESIGNS = 64
"""Largest number of explored designs, and of designs that CMA-ES tried, that are kept with an evaluation."""
_SAVED_AFTER = AnyEdit | protocol.Checkpoint
"""The commands that need a checkpoint before they are acknowledged; the others change nothing that one holds."""


class Trainer:
    """One run from its newest checkpoint on. `state` belongs to the method while it iterates, to us in between."""

    def __init__(
        self, folder: RunFolder, further: int | None = None, until: int | None = None, from_start: bool = False
    ) -> None:
        self._folder, self._from_start = folder, from_start
        self._record = folder.record()
        self._status: Status = "starting"
        self._stage, self._message = "loading", ""
        self._stopping = self._step = False
        self._iteration = self._env_steps = 0
        self._cpu_start = time.process_time()  # s, when this run's CPU clock stood at zero
        history = History(folder)
        self._paused = history.paused_by_user
        self._last = history.iteration + further if further is not None else until or self._record.iterations
        self._budget = None if (further or until) is not None else self._record.env_steps
        self._rest = Rest(self._last, self._budget, self._record.final_episodes)
        self._state: State | None = None
        self._measured = {event.iteration for event in history.evaluations if event.final}
        self._answered = {event.id for event in history.acknowledged}
        self._best: Evaluation | None = None
        self._heartbeat: HeartbeatFile | None = None  # a full disk has no room for it yet
        self._process_started = psutil.Process().create_time()
        self._heartbeat = self._persist(lambda: HeartbeatFile(folder))
        self.beat()
        self._log = self._persist(lambda: EventLog(folder))

    @functools.cached_property
    def _task(self) -> Task:
        return make_task(self._record.task, self._record.task_options)

    def run(self) -> None:
        """Train until the last iteration, the end of the budget, a stop or an exception."""
        task = self._task
        method = read_method(self._record)
        method.check(task)
        self._rest.plan(method, task.horizon)
        state = self._load(task, method)
        self._state = state
        if not self._is_done(state):
            self._enter("running", "fitting the proxy" if state.proxy and not state.fitted else _LEARNING)
            self._between_iterations(state)
        if not self._is_done(state) and not self._stopping:
            method.prepare(task, state)  # no part of an iteration: what others take is not known from it
            self._set("running", _LEARNING)
            began, steps = time.monotonic(), state.env_steps
            _refuse_damage(state)
            for progress in method.iterations(task, state):
                searching = state.searched_in if progress.search_cost is not None else None
                self._rest.pace.took(time.monotonic() - began, state.env_steps - steps, searching)
                self._take_in(task, method, state, progress)
                self._between_iterations(state)
                if self._stopping or self._is_done(state):
                    break
                _refuse_damage(state)
                began, steps = time.monotonic(), state.env_steps
        if self._is_done(state):
            if self._record.final_episodes:
                self._set("running", "evaluating at the end")
                self._evaluate_finally(task, self._outcome(task, method, state))
            self._enter("finished", "finished", self._why_done(state))
        else:
            self._checkpoint(state)
            self._enter("stopped", "stopped", f"stopped after iteration {state.iteration}; resume goes on from here")

    def stop(self) -> None:
        """End after the present iteration, with a checkpoint."""
        self._stopping = True

    def reason(self, error: Exception) -> str:
        """Return in words why the run ends: what has become NaN or infinite, where it did, not what that led to."""
        unsound = isinstance(error, FloatingPointError)
        words = str(error) if unsound else f"{type(error).__name__}: {error}".removesuffix(": ")
        damage = damage_of(self._state) if self._state and not isinstance(error, OSError | MemoryError) else ""
        if damage and damage != words:
            words = f"{damage} ({words})"
        return f"{words}, in {self._where}" if damage or unsound else words

    @property
    def _where(self) -> str:
        if self._stage.startswith("evaluating"):
            return f"the evaluation after iteration {self._iteration}"
        return f"iteration {self._iteration + 1}"

    def fail(self, reason: str) -> None:
        """Say why the run ends; where not even that can be written, the heartbeat still says it."""
        self._set("failed", "failed", reason)
        with contextlib.suppress(OSError):
            self._log.append(StateChanged(status="failed", iteration=self._iteration, message=reason))

    def take_back(self, error: Exception) -> str:
        """Take back the commands since the last iteration, with which the present one has failed; return the sentence.

        Where the last ones were obeyed earlier, say only what they were: what was learnt with them is not taken back,
        and nobody knows whether it is they that failed. Return nothing where it can't be a command that failed.
        """
        history = History(self._folder)
        if isinstance(error, OSError | MemoryError | RunFolderError):
            return ""
        if not (edits := edits_since(history)):
            return earlier_edits(history)
        said = take_back(self._folder, self._task, read_method(self._record))
        for event in said:
            self._log.append(event)
        asked = ", ".join(edit.message for edit in edits)
        return f"; taken back is what was asked for before it ({asked}): resume goes on" if said else ""

    def beat(self) -> None:
        """Rewrite the heartbeat; where the disk does not take this one, it will take a later one."""
        remaining = self._rest.iterations(self._iteration, self._env_steps)
        seconds = None if self._status in SAID_ENDED else self._rest.seconds(self._iteration, remaining)
        beat = Heartbeat(
            host=platform.node(), pid=os.getpid(), process_started=self._process_started,
            time=time.time(), status=self._status, stage=self._stage, message=self._message,
            iteration=self._iteration, iterations=self._iteration + remaining,
            env_steps=self._env_steps, eta_seconds=seconds,
        )  # fmt: skip
        if self._heartbeat is not None:
            with contextlib.suppress(OSError):
                self._heartbeat.write(beat)

    def sync(self) -> None:
        """Make sure that what was said is on the disk; one that does not take it is met by the next word."""
        with contextlib.suppress(OSError, ValueError):  # ValueError: the log is being opened again
            self._log.sync()
            if self._heartbeat is not None:
                self._heartbeat.sync()

    # --- when it ends ---

    def _is_done(self, state: State) -> bool:
        return state.iteration >= self._last or (self._budget is not None and state.env_steps >= self._budget)

    def _why_done(self, state: State) -> str:
        if state.iteration >= self._last:
            return f"all {self._last} iterations are done"
        return f"the budget of {self._budget:,} environment steps is spent after iteration {state.iteration}"

    # --- one iteration ---

    @property
    def _cpu_seconds(self) -> float:
        return time.process_time() - self._cpu_start

    def _load(self, task: Task, method: Method) -> State:
        self._persist(lambda: recover_checkpoints(self._folder))
        newest, damaged = load_newest(self._folder, task, method)
        if newest is None:
            self._refuse_to_begin_anew(damaged)
            first = begin(self._folder, self._record, task, method)
            state, cpu_before, origin = first.state, first.cpu_seconds, first.words
        else:
            state, cpu_before = newest
            origin = "; ".join([f"from the checkpoint of iteration {state.iteration}", *damaged])
            if self._from_start:
                raise RunFolderError(
                    f"{self._folder.id} does not begin anew: its checkpoint of iteration {state.iteration} can be "
                    "read; resume it without --from-start, or start a new run"
                )
        self._cpu_start = time.process_time() - cpu_before
        self._iteration, self._env_steps = state.iteration, state.env_steps
        self._measured = {iteration for iteration in self._measured if iteration <= state.iteration}
        self._write(
            StateChanged(
                status="starting", iteration=state.iteration, message=origin, processor=processor(),
                instruction_set=torch.backends.cpu.get_cpu_capability(),
            )
        )  # fmt: skip
        self._write(DesignSpaceChanged(iteration=state.iteration, parameters=list(state.design_space.parameters)))
        history = History(self._folder)
        self._best = history.best
        if taken_back := unruly_alpha(history, state):
            self._checkpoint(state)
            for event in taken_back:
                self._write(event)
        if newest is None and self._record.parent:
            self._checkpoint(state)  # what it took along can be evaluated, exported and branched from at once
        return state

    def _refuse_to_begin_anew(self, damaged: list[str]) -> None:
        """Raise RunFolderError if what was learnt is on record and yet can't be read, unless a user has said yes."""
        history = History(self._folder)
        saved = [event.iteration for event in history.evaluations if not event.final]
        missing = len(saved) > 1  # each is followed by a checkpoint, but for the last one before a crash
        if self._from_start or not (damaged or missing):
            return
        why = "; ".join(damaged[:3]) if damaged else f"{self._folder.id} has lost all its checkpoints"
        raise RunFolderError(
            f"{why}. No checkpoint is left to go on from. To begin anew from the initial design, which gives up "
            f"{history.iteration - history.begins_at} iterations: "
            f"morph-studio train --resume {shlex.quote(str(self._folder.path))} --from-start"
        )

    def _take_in(self, task: Task, method: Method, state: State, progress: Progress) -> None:
        """Record an iteration; evaluate and save where it is due."""
        _refuse_damage(state)
        if not np.isfinite(progress.episode_return):
            raise FloatingPointError("the mean return became infinite or NaN")
        self._iteration, self._env_steps = state.iteration, state.env_steps
        self._rest.take_in(state)
        progress = msgspec.structs.replace(
            progress, relabelled_steps=state.relabelled_steps, search_steps=state.search_steps,
            diverged=state.diverged, cpu_seconds=self._cpu_seconds,
        )  # fmt: skip
        self._write(progress)
        if progress.iteration % method.evaluation.interval == 0 or self._is_done(state):
            began = time.monotonic()
            self._set("running", "evaluating")
            self._evaluate(task, method, state)
            self._set("running", "saving")
            self._checkpoint(state)
            tidy(self._folder, method.evaluation.interval, self._best.iteration if self._best else None)
            self._rest.pace.evaluated(time.monotonic() - began)
        self._set("running", _LEARNING)

    def _evaluate(self, task: Task, method: Method, state: State) -> None:
        # Its own random numbers, so that what is learnt does not depend on how often it is evaluated.
        rng = np.random.default_rng([self._record.seed, state.iteration])
        sampled, mean, rollout = self._score(task, state, method.evaluation.episodes, rng)
        arrays = record_episodes(task, rollout, state.phi)
        if state.explored is not None:
            arrays["population"] = state.explored[:SHOWN_DESIGNS]
        if state.generation is not None:
            arrays["generation"] = state.generation[:SHOWN_DESIGNS]
        name = self._persist(lambda: write_episode(self._folder, state.iteration, arrays))
        self._tell(state, sampled, mean, method.evaluation.episodes, episode=name, recorded=outcomes(rollout))

    def _outcome(self, task: Task, method: Method, state: State) -> State:
        """Return the state whose design and policy the method has come to, which is not always the last one."""
        best = History(self._folder).best
        if method.ends_at_best and best is not None:
            return load_checkpoint(self._folder, best.iteration, task, method)[0]
        return state

    def _evaluate_finally(self, task: Task, state: State) -> None:
        episodes = self._record.final_episodes
        if state.iteration in self._measured:
            return
        rng = np.random.default_rng([self._record.seed, state.iteration, episodes])
        sampled, mean, _ = self._score(task, state, episodes, rng)
        self._tell(state, sampled, mean, episodes, final=True)

    def _score(self, task: Task, state: State, episodes: int, rng: np.random.Generator) -> tuple[Score, Score, Rollout]:
        """Return the scores of the sampled and of the deterministic policy, and the sampled episodes."""
        policy = state.control.policy
        sampled, rollout = evaluate(task, policy, state.phi, episodes, rng, sampled=True)
        mean, _ = evaluate(task, policy, state.phi, episodes, rng, sampled=False)
        return sampled, mean, rollout

    def _tell(self, state: State, sampled: Score, mean: Score, episodes: int, **said: Any) -> None:
        told = Evaluation(
            iteration=state.iteration, env_steps=state.env_steps, phi=state.phi.tolist(),
            sampled_success=sampled.success, sampled_return=sampled.episode_return,
            deterministic_success=mean.success, deterministic_return=mean.episode_return,
            milestones=sampled.milestones, diverged=sampled.diverged, reward_terms=sampled.reward_terms,
            return_interval=sampled.return_interval, cpu_seconds=self._cpu_seconds, episodes=episodes, **said,
        )  # fmt: skip
        self._write(told)
        self._best = max((e for e in (self._best, told) if e), key=merit)

    def _checkpoint(self, state: State) -> None:
        self._persist(lambda: save_checkpoint(self._folder, state, self._cpu_seconds))

    # --- commands ---

    def _between_iterations(self, state: State) -> None:
        """Obey what is in the inbox; hold here while paused."""
        self._obey(state)
        if not self._paused or self._step or self._stopping:
            self._step = False
            return
        self._checkpoint(state)
        self._enter("paused", "paused", PAUSED)
        while self._paused and not self._step and not self._stopping:
            time.sleep(POLL_SECONDS)
            self._obey(state)
        self._step = False
        self._enter("running", _LEARNING)

    def _obey(self, state: State) -> None:
        for path, order in self._folder.pending():
            if order is not None and order.id not in self._answered:
                self._answer(order, state)
            with contextlib.suppress(OSError):  # what has been answered is not answered again
                path.unlink(missing_ok=True)

    def _answer(self, order: Order, state: State) -> None:
        try:
            before, accepted = state.design_space, True
            message = self._apply(order.command, state)
        except ValueError as error:
            before, accepted, message = state.design_space, False, str(error)
        # The checkpoint comes before the word: what was acknowledged survives any crash.
        if accepted and isinstance(order.command, _SAVED_AFTER):
            self._checkpoint(state)
        if state.design_space != before:
            parameters = list(state.design_space.parameters)
            self._write(DesignSpaceChanged(iteration=state.iteration, parameters=parameters))
        self._write(
            Acknowledged(
                id=order.id,
                iteration=state.iteration,
                accepted=accepted,
                command=order.command,
                message=message,
                sender=order.sender,
            )
        )
        self._answered.add(order.id)

    def _apply(self, command: AnyCommand, state: State) -> str:
        """Carry out one command; return what was done, or raise ValueError that says what is allowed."""
        match command:
            case protocol.Pause():
                self._paused = True
                return "paused"
            case protocol.Resume():
                self._paused = False
                return "resumed"
            case protocol.StepIteration():
                self._paused = self._step = True
                return "one iteration"
            case protocol.Stop():
                self._stopping = True
                return "stopping"
            case protocol.Kill():
                raise ValueError("a trainer does not end itself at once: send stop, or ask the studio on its machine")
            case protocol.Checkpoint():
                return f"checkpoint of iteration {state.iteration} saved"
        return apply_edit(command, state, self._task)

    # --- saying and saving ---

    def _enter(self, status: Status, stage: str, message: str = "") -> None:
        self._write(StateChanged(status=status, iteration=self._iteration, message=message))
        self._set(status, stage, message)

    def _set(self, status: Status, stage: str, message: str = "") -> None:
        self._status, self._stage, self._message = status, stage, message
        self.beat()

    def _write(self, event: AnyEvent) -> None:
        self._persist(lambda: self._log.append(event))

    def _persist(self, action: Callable[[], T]) -> T:
        """Do something that writes; while the disk does not take it, pause and say so. Nothing written is lost."""
        before = self._status, self._stage, self._message
        while True:
            try:
                result = action()
            except NotPlainError:
                raise
            except OSError as error:
                if self._stopping:
                    raise
                self._set("paused", "waiting for the disk", f"the disk does not take the run's data: {error.strerror}")
                time.sleep(RETRY_SECONDS)
            else:
                if self._stage == "waiting for the disk":
                    self._set(*before)
                return result


def _refuse_damage(state: State) -> None:
    """Raise FloatingPointError that names what no iteration can begin with."""
    if damage := damage_of(state):
        raise FloatingPointError(damage)


def apply_edit(command: AnyEdit, state: State, task: Task) -> str:
    """Put a command in force and return the sentence that says so; raise ValueError, the state unchanged, if it is not
    allowed."""
    before = InForce(state.design_space, state.phi, state.alpha, state.projection)
    edit = edited(task, before, command)
    after = edit.in_force
    # A proxy of another design would pull phi back, so it is fitted afresh.
    state.fitted = state.fitted and bool(np.array_equal(after.phi, state.phi))
    # The search goes on, even where it had been found good enough to freeze phi.
    state.frozen = state.frozen and not edit.concerns_design
    state.design_space, state.phi, state.alpha, state.projection = after.space, after.phi, after.alpha, after.projection
    return edit.message


def train(folder: RunFolder, further: int | None = None, until: int | None = None, from_start: bool = False) -> int:
    """Run one trainer on the folder in this process; return the exit status."""
    torch.set_num_threads(1)
    with hold(folder):
        trainer = Trainer(folder, further, until, from_start)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: trainer.stop())
        ended = threading.Event()
        beats = threading.Thread(target=_keep_beating, args=(trainer, ended), daemon=True)
        beats.start()
        try:
            trainer.run()
        except RunFolderError as error:
            print(error, file=sys.stderr)  # noqa: T201 - the last line of its log says why it has ended
            trainer.fail(str(error))
            return 1
        except Exception as error:
            traceback.print_exc()
            reason = trainer.reason(error)
            with contextlib.suppress(OSError, RunFolderError):  # then the run fails without it
                reason += trainer.take_back(error)
            trainer.fail(reason)
            return 1
        finally:
            ended.set()
            beats.join()
            trainer.sync()
    return 0


def _keep_beating(trainer: Trainer, ended: threading.Event) -> None:
    while not ended.wait(HEARTBEAT_SECONDS):
        trainer.beat()
        trainer.sync()  # once a second, beside the learning: a network disk shows the word of a trainer no sooner


def _say_into(log: Path) -> None:
    """Let standard output and error go to the end of this file from now on, and work beside it."""
    os.chdir(log.parent)
    descriptor = open_plain(log.parent, log.name, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(descriptor, stream)
    os.close(descriptor)


def main() -> int:
    """Parse the arguments; `--standby` waits, with everything loaded, for the arguments as JSON on standard input.

    The exit status is 0 where the run has ended or was stopped, 2 where another trainer holds it, 1 for any failure.
    """
    for number in (signal.SIGUSR1, signal.SIGUSR2):  # a cluster's warnings, sent to every process of a job
        signal.signal(number, signal.SIG_IGN)
    parser = argparse.ArgumentParser(prog="python -m morph_core.train", description=__doc__)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--run", type=Path, help="run folder")
    what.add_argument("--standby", action="store_true", help="wait for run, further and from_start on stdin")
    last = parser.add_mutually_exclusive_group()
    last.add_argument("--further", type=int, help="iterations beyond the last recorded one (default: as planned)")
    last.add_argument(
        "--until", type=int, help="last iteration, however often the trainer is started (default: as planned)"
    )
    parser.add_argument(
        "--from-start", action="store_true", help="begin anew where no checkpoint of a run is left that can be read"
    )
    options = parser.parse_args()
    if options.standby:
        line = sys.stdin.readline()
        if not line:
            return 0  # whoever kept us in reserve is gone
        order = msgspec.json.decode(line)
        options.run, options.further = Path(order["run"]), order["further"]
        options.from_start = order.get("from_start", False)
        _say_into(options.run / "trainer.log")
    for name in ("further", "until"):
        asked = getattr(options, name)
        if asked is not None and not 1 <= asked <= LAST_ITERATION:
            parser.error(f"--{name} must be a whole number from 1 to {LAST_ITERATION}, not {asked}")
    try:
        return train(RunFolder(options.run.resolve()), options.further, options.until, options.from_start)
    except (RunFolderError, OSError) as error:
        print(f"morph_core.train: {error}", file=sys.stderr)  # noqa: T201 - a process entry
        return 2 if isinstance(error, HeldError) else 1


if __name__ == "__main__":
    sys.exit(main())
