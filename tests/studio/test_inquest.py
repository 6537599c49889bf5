"""One reason why a trainer died, whoever asks: the browser's list and the command line."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import eventually, in_mood, make_run, stand_in

from morph_core.history import History
from morph_core.run_folder import RunFolder
from studio.cli.follow import Outcome, follow
from studio.inquest import cause_of_death, start_child
from studio.new_run import StartRun
from studio.runs import Runs


def kill_when_it_runs(folder: RunFolder) -> None:
    """Kill the trainer of a run once it has spoken."""

    def wait_and_kill() -> None:
        beat = eventually(lambda: (h := History(folder)).state and h.state.status == "running" and h.heartbeat)
        os.kill(beat.pid, signal.SIGKILL)  # pyright: ignore[reportAttributeAccessIssue]

    threading.Thread(target=wait_and_kill, daemon=True).start()


@pytest.mark.parametrize(
    ("mood", "killed", "reason"),
    [
        ("stillborn", False, "ImportError: no module named torch, says the stand-in"),
        ("dying", False, "FloatingPointError: loss is NaN, says the stand-in"),
        (
            "healthy", True,
            "the trainer was killed by SIGKILL (perhaps out of memory); resume goes on from its newest checkpoint",
        ),
    ],
)  # fmt: skip
def test_browser_and_command_line_say_the_same_of_a_death(
    runs_folder: Path, mood: str, killed: bool, reason: str
) -> None:
    runs = Runs(runs_folder, in_mood(mood))
    run_id = runs.start(StartRun(task="reacher"))
    followed = make_run(runs_folder, "followed", ended=None)
    if killed:
        kill_when_it_runs(RunFolder(runs_folder / run_id))
        kill_when_it_runs(followed)
    outcome = follow(followed, lambda: stand_in(followed, mood=mood), quiet=True)
    assert outcome == Outcome(1, "failed", reason)
    assert eventually(lambda: runs.summary(run_id).status == "failed")
    assert runs.summary(run_id).reason == reason


@pytest.mark.parametrize(
    ("code", "log", "said"),
    [
        (1, "Traceback\n  File x\nValueError: no\n\n", "ValueError: no"),
        (1, "", "the trainer ended with exit status 1 and without a word"),
        (None, "MemoryError\n", "the trainer died: MemoryError"),
        (None, " \n", "the trainer died; resume goes on from its newest checkpoint"),
        (-11, "Error\n", "the trainer was killed by SIGSEGV; resume goes on from its newest checkpoint"),
        (1, "x" * 9999 + "\n", "x" * 500),
        (1, b"\xff\xfe\n", "\ufffd\ufffd"),
    ],
)  # fmt: skip
def test_a_death_is_said_by_signal_or_last_words(
    runs_folder: Path, code: int | None, log: str | bytes, said: str
) -> None:
    folder = make_run(runs_folder)
    (folder.path / "trainer.log").write_bytes(log if isinstance(log, bytes) else log.encode())
    assert cause_of_death(folder, code) == said


def test_what_an_earlier_trainer_said_is_not_taken_for_this_ones_words(runs_folder: Path) -> None:
    folder = make_run(runs_folder, ended="finished")
    (folder.path / "trainer.log").write_text("said long ago\n")
    child = start_child(folder, silent(3))
    child.process.wait()
    assert child.spoken_end(History(folder)) is None
    assert child.cause() == "the trainer ended with exit status 3 and without a word"


def silent(code: int) -> Callable[[], subprocess.Popen[bytes]]:
    return lambda: subprocess.Popen([sys.executable, "-c", f"raise SystemExit({code})"])
