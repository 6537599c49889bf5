"""A trainer seen from the terminal: its progress, Ctrl-C, and what became of it."""

import contextlib
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType

from rich.console import Console, Group
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.text import Text

from morph_core.history import History
from morph_core.protocol import Status, Stop
from morph_core.run_folder import RunFolder
from studio.cli.terminal import Cadence, Screen, in_words, make_console
from studio.inquest import Child, start_child
from studio.log import sender_here

POLL_SECONDS = 0.2
LINE_SECONDS = 5.0
"""Seconds between two printed lines where there is no terminal."""


@dataclass(frozen=True)
class Outcome:
    """What became of the trainer, and the exit status that says so."""

    code: int
    status: Status
    message: str


def follow(folder: RunFolder, spawn: Callable[[], subprocess.Popen[bytes]], *, quiet: bool) -> Outcome:
    """Start a trainer and show it until it ends. The first Ctrl-C stops it after the iteration, the second kills it."""
    console = make_console(stderr=True, soft_wrap=True)
    with interrupts() as presses:
        child = start_child(folder, spawn)
        with Screen(console, quiet) as screen:
            screen.say(
                f"{folder.id}: started; morph-studio serve --runs {shlex.quote(str(folder.path.parent))} shows it"
            )
            _wait(child, presses, screen)
        outcome = _outcome(child, interrupted=bool(presses))
        if not quiet or outcome.code == 1:
            _conclude(console, folder, outcome)
        return outcome


def _wait(child: Child, presses: list[int], screen: Screen) -> None:
    history = History(child.folder)
    view = (Bar if screen.console.is_terminal else Lines)(screen)
    heard = 0
    while child.process.poll() is None:
        time.sleep(POLL_SECONDS)
        history.poll()
        view.show(history)
        if presses and heard == 0:
            heard = 1
            child.folder.send(Stop(), sender_here("Ctrl-C"))
            screen.say("stopping after this iteration; Ctrl-C again ends it at once")
        elif len(presses) > 1 and heard == 1:
            heard = 2
            child.process.kill()  # a checkpoint is whole or not there: nothing before it is lost
    history.poll()
    view.show(history, last=True)


@contextlib.contextmanager
def interrupts() -> Iterator[list[int]]:
    """Collect Ctrl-C and SIGTERM in a list instead of being ended by them."""
    presses: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - the signature of a handler
        presses.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield presses
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _outcome(child: Child, interrupted: bool) -> Outcome:
    code, end = child.process.wait(), child.spoken_end(History(child.folder))
    if end is None and interrupted and code == -signal.SIGKILL:
        return Outcome(130, "lost", "ended at once; what came after the newest checkpoint will be done again")
    if end is None:
        return Outcome(1, "failed", child.cause())
    codes: dict[Status, int] = {"finished": 0, "stopped": 130 if interrupted else 0}
    return Outcome(codes.get(end.status, 1), end.status, end.message)


def _conclude(console: Console, folder: RunFolder, outcome: Outcome) -> None:
    console.print(Text(f"{outcome.status}: {outcome.message}"))
    if outcome.status != "finished":
        console.print(Text(f"go on with it: morph-studio train --resume {shlex.quote(str(folder.path))}"))


# --- two ways to show it ----------------------------------------------------------------------------------------------


class Bar:
    """A progress bar that stays on the last lines of the terminal, success, return and phi under it."""

    def __init__(self, screen: Screen) -> None:
        self._screen = screen
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[eta]}"),
            console=screen.console,
            expand=True,
        )
        self._task = self._progress.add_task("starting", total=None, eta="")
        screen.draw(self._progress)

    def show(self, history: History, last: bool = False) -> None:
        """Show how far the run is; `last` prints the final line too."""
        beat, status = history.heartbeat, history.status
        self._progress.update(
            self._task,
            description=beat.stage if beat and status in ("starting", "running") else status,
            completed=history.iteration,
            total=_planned(history),
            eta=_eta(history),
        )
        words = _in_short(history)
        self._screen.draw(Group(self._progress, Text(words, no_wrap=True, overflow="ellipsis")))
        if last:
            self._screen.say(f"iteration {history.iteration}/{_planned(history)}  {words}")


class Lines:
    """A line now and then, for a log file."""

    def __init__(self, screen: Screen) -> None:
        self._screen, self._cadence = screen, Cadence(LINE_SECONDS)

    def show(self, history: History, last: bool = False) -> None:
        """Print a line if it is time for one, and anyway if it is the `last` one."""
        if history.iteration and self._cadence.is_due(history.iteration, last):
            words = f"iteration {history.iteration}/{_planned(history)}  {_in_short(history)}  {_eta(history)}"
            self._screen.say(words.rstrip())


def _planned(history: History) -> int:
    return history.heartbeat.iterations if history.heartbeat else history.planned_iterations or 0


def _in_short(history: History) -> str:
    """Return success, milestones and return of the last evaluation, or else of the last iteration, and phi."""
    if not history.progress:
        return ""
    last = history.progress[-1]
    success, gain, milestones = last.success, last.episode_return, {}
    if history.evaluations:
        score = history.evaluations[-1]
        success, gain, milestones = score.sampled_success, score.sampled_return, score.milestones
    words = [f"success {success:.2f}", *(f"{name} {share:.2f}" for name, share in milestones.items())]
    words += [f"return {gain:.2f}", f"phi {' '.join(f'{value:.2f}' for value in history.phi)}"]
    return "  ".join(words + [f"diverged {last.diverged}"] * (last.diverged > 0))


def _eta(history: History) -> str:
    eta = history.heartbeat.eta_seconds if history.heartbeat else None
    if eta is None or history.iteration >= _planned(history):
        return ""
    return in_words(eta)
