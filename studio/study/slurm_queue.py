"""What Slurm says: its commands with their refusals in plain words, and where tasks are, asked for all at once."""

import math
import re
import subprocess
import threading
import time
from collections.abc import Sequence

from studio.study.launcher import Place
from studio.trainers import trainer_environment

FRESH_SECONDS = 10.0
"""Seconds for which the answer of squeue counts."""
ANSWER_WITHIN = 60.0
"""Seconds after which a command of Slurm is given up."""
WAITING = frozenset({"PENDING", "REQUEUED", "REQUEUE_FED", "REQUEUE_HOLD", "SPECIAL_EXIT", "RESV_DEL_HOLD"})
"""Slurm's states of a task that it will start."""
AT_WORK = frozenset(
    {"RUNNING", "COMPLETING", "CONFIGURING", "SUSPENDED", "STOPPED", "RESIZING", "SIGNALING", "STAGE_OUT"}
)
"""Slurm's states of a task that has a node; any other one is that of a task which has ended."""
TASK = re.compile(r"\d{1,12}_\d{1,7}")
FORGOTTEN = Place(why="Slurm does not know its job any more: resume submits it anew", given_up=True)
_WORDS = {
    "JobArrayTaskLimit": "as many runs as --parallel allows are at work",
    "Resources": "waits for a free core",
    "Priority": "other jobs come first",
    "BeginTime": "was queued once more, and starts in a moment",
    "Dependency": "waits for the part of the study before it",
    "None": "Slurm has not looked at it yet",
    "PartitionTimeLimit": "--time is longer than the partition allows: cancel it, and submit it with a shorter one",
    "JobHeldUser": "held: scontrol release lets it go",
    "JobHeldAdmin": "held by an administrator of the cluster",
}
"""Slurm's reasons why a task waits, in plain words."""
_ADVICE = {
    "partition": "sinfo -s lists the partitions",
    "account": "sacctmgr show associations user=$USER lists your accounts",
    "feature": 'sinfo -o "%P %f" lists what --constraint can name',
    "node configuration": 'sinfo -o "%P %c %m %f" lists what nodes have; ask for less --mem',
    "memory": 'sinfo -o "%P %m" lists what nodes have; ask for less --mem',
    "time": 'sinfo -o "%P %l" lists the limits of the partitions; give a shorter --time',
    "array": "this cluster takes fewer tasks in an array (scontrol show config, MaxArraySize): make studies smaller",
    "contact slurm controller": "Slurm's controller does not answer: try again later; runs at work go on",
    "configuration source": "this machine belongs to no cluster: start it on a login node, or use --launcher local",
    "qos": "the limits of your account are reached (sacctmgr show qos): wait, or lower --parallel",
}
"""Parts of Slurm's refusals, in lower case, each with what to do; the first that is found counts."""


class SlurmError(ValueError):
    """Slurm is absent, or refuses; says its words and what to do."""


def call(*words: str) -> str:
    """Run a command of Slurm and return what it prints; SlurmError says its words and what to do."""
    try:
        done = subprocess.run(
            words, capture_output=True, text=True, errors="replace", timeout=ANSWER_WITHIN, env=trainer_environment(),
            stdin=subprocess.DEVNULL, check=False,
        )  # fmt: skip
    except FileNotFoundError:
        raise SlurmError(
            f"{words[0]} is not on this machine: start it on a login node of the cluster, or use --launcher local"
        ) from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SlurmError(f"{words[0]} does not answer ({error}): try again later; runs at work go on") from error
    if done.returncode == 0:
        return done.stdout
    lines = [line.strip() for line in (done.stderr or done.stdout).splitlines() if line.strip()]
    said = "; ".join(lines) or f"it ended with {done.returncode}"
    advice = next((advice for part, advice in _ADVICE.items() if part in said.lower()), "")
    raise SlurmError(f"Slurm refuses: {said}" + (f" ({advice})" if advice else ""))


class Queue:
    """What squeue says of tasks: one call for all of them, and a fresh one at most every ten seconds."""

    def __init__(self) -> None:
        self.trouble = ""
        self._lock = threading.Lock()
        self._asking = threading.Lock()
        self._wanted: dict[str, float] = {}  # when each task was last looked for, monotonic s
        self._known: dict[str, Place] = {}
        self._asked = -math.inf  # monotonic s

    def look(self, tasks: Sequence[str], patient: bool) -> dict[str, Place]:
        """Return where those tasks are of which that is known."""
        now = time.monotonic()
        with self._lock:
            stale = now - self._asked >= FRESH_SECONDS or any(task not in self._wanted for task in tasks)
            self._wanted |= dict.fromkeys(tasks, now)
        if tasks and stale and patient:
            self._ask()
        elif tasks and stale and not self._asking.locked():
            threading.Thread(target=self._ask, name="squeue", daemon=True).start()
        with self._lock:
            return {task: self._known[task] for task in tasks if task in self._known}

    def expect(self, task: str) -> None:
        """Take it that a task waits, until Slurm is asked again."""
        with self._lock:
            self._wanted[task] = time.monotonic()
            self._known[task] = Place(why=f"submitted to Slurm as job {task}")

    def forget(self) -> None:
        """Let the next question go to Slurm, however fresh the last answer is."""
        with self._lock:
            self._asked = -math.inf

    def _ask(self) -> None:
        with self._asking:
            with self._lock:
                self._asked = time.monotonic()
                tasks = [task for task, at in self._wanted.items() if at > self._asked - 6 * FRESH_SECONDS]
            try:
                found, trouble = _places(tasks), ""
            except SlurmError as error:
                found, trouble = {}, str(error)
            with self._lock:
                self._known, self.trouble = found, trouble


def _places(tasks: Sequence[str]) -> dict[str, Place]:
    """Ask Slurm where tasks are."""
    jobs = sorted({task.split("_")[0] for task in tasks})
    try:
        said = call(
            "squeue", "--noheader", "--array", "--states=all", f"--jobs={','.join(jobs)}", "--format=%i|%T|%N|%r"
        )
    except SlurmError as error:
        if "Invalid job id" not in str(error):
            raise
        said = ""
    lines = dict(line.split("|", 1) for line in said.splitlines() if line.count("|") >= 3)
    # An array that was cancelled before a task of it began is one line, under the number of the array.
    return {task: _place(task, lines.get(task) or lines.get(task.split("_")[0])) for task in tasks}


def _place(task: str, line: str | None) -> Place:
    if line is None:
        return FORGOTTEN
    state, node, reason = line.split("|", 2)
    if state in WAITING:
        return Place(why=f"{_WORDS.get(reason, 'waits')} (Slurm job {task}: {state}, {reason})")
    if state in AT_WORK:
        return Place(where=f"{node or 'a node'} (Slurm job {task}: {state})")
    if state == "COMPLETED":  # finished, or stopped by a user: its folder says which
        return Place(given_up=True)
    return Place(why=f"Slurm job {task}: {state}" + (f", {reason}" if reason != "None" else ""), given_up=True)
