"""Runs as tasks of Slurm's job arrays, by its own commands alone: no process of ours has to live on."""

import contextlib
import math
import re
import secrets
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, ClassVar, TypeVar

import msgspec
import tyro

from morph_core import durable
from morph_core.history import History
from morph_core.run_folder import LAUNCH, RunFolder
from studio.study.launcher import Launcher, Place
from studio.study.local import CANCELLED, launcher_of
from studio.study.standing import stopped_by_user
from studio.trainers import trainer_command, trainer_environment

LARGEST_ARRAY = 1000
"""Tasks of one array: Slurm's own limit (MaxArraySize) is 1,001 unless a cluster sets another."""
MOST_AT_ONCE = 1000
"""Largest cap that can be asked for."""
WARNING_SECONDS = 120
"""How long before the time limit a trainer is told to save, or a quarter of the limit if that is shorter."""
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


class SlurmError(ValueError):
    """Slurm is absent, or refuses; says its words and what to do."""


@dataclass(frozen=True)
class SlurmOptions:
    """What Slurm is asked for; what is not given, the cluster's own defaults decide."""

    partition: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Slurm partition to run in; by default the cluster's."""
    time: Annotated[str | None, tyro.conf.arg(metavar="LIMIT")] = None
    """Time limit of a task as Slurm writes it (90, 12:00:00, 2-00:00:00); a run that reaches it is queued once more."""
    account: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Slurm account that is charged; by default the user's."""
    constraint: Annotated[str | None, tyro.conf.arg(metavar="FEATURES")] = None
    """Features that a node must have, such as avx512: bitwise resumption needs one kind of processor."""
    mem: Annotated[str, tyro.conf.arg(metavar="SIZE")] = "2G"
    """Memory of a task, as a number with K, M, G or T; 0 for all that a node has."""
    parallel: Annotated[int, tyro.conf.arg(metavar="N")] = 32
    """Largest number of runs at once."""

    def __post_init__(self) -> None:
        """Raise ValueError that says what is allowed."""
        for name in ("partition", "account", "constraint"):
            value = getattr(self, name)
            if value is not None and not (value.isprintable() and value.strip() and len(value) <= 200):
                raise ValueError(f"{name} must be printable, not empty and at most 200 characters long")
        if self.time is not None:
            seconds_of(self.time)
        if not re.fullmatch(r"\d{1,9}[KMGT]?", self.mem):
            raise ValueError(f'mem must be a number with K, M, G or T, such as 2G, not "{self.mem[:40]}"')
        if not 1 <= self.parallel <= MOST_AT_ONCE:
            raise ValueError(f"parallel must be a whole number from 1 to {MOST_AT_ONCE}, not {self.parallel}")

    def words(self) -> list[str]:
        """Return the options of sbatch."""
        given = {name: getattr(self, name) for name in ("partition", "time", "account", "constraint", "mem")}
        warning = WARNING_SECONDS if self.time is None else min(WARNING_SECONDS, seconds_of(self.time) // 4)
        # B: to the job script alone, which then tells the trainer; without it every process of the job gets the signal.
        return [f"--{name}={value}" for name, value in given.items() if value is not None] + [
            f"--signal=B:USR1@{warning}"
        ]


_TIME = re.compile(
    r"(?:(?P<days>\d{1,4})-(?P<dh>\d{1,2})(?::(?P<dm>\d{1,2})(?::(?P<ds>\d{1,2}))?)?"
    r"|(?:(?P<h>\d{1,5}):)?(?P<m>\d{1,6}):(?P<s>\d{1,2})|(?P<minutes>\d{1,6}))"
)


def seconds_of(limit: str) -> int:
    """Return a time limit in seconds; ValueError that says what is allowed if it can't be read or is below a minute."""
    match = _TIME.fullmatch(limit)
    part = {name: int(text) for name, text in match.groupdict(default="0").items()} if match else {}
    seconds = sum(
        part.get(name, 0) * unit
        for unit, names in ((86400, ("days",)), (3600, ("dh", "h")), (60, ("dm", "m", "minutes")), (1, ("ds", "s")))
        for name in names
    )
    if seconds < 60:
        raise ValueError(
            "time must be at least a minute, as MINUTES, HOURS:MINUTES:SECONDS or DAYS-HOURS:MINUTES:SECONDS, "
            f'not "{limit[:40]}"'
        )
    return seconds


class Launch(msgspec.Struct, frozen=True, kw_only=True):
    """Content of launch.json of a run that is a task of Slurm's."""

    launcher: str = "slurm"
    job: str
    """Number of the task, such as 42_7."""
    submitted: float
    """When it was submitted (seconds since the epoch)."""
    options: dict[str, object] = {}
    """What was asked for, and is asked for again when the run is submitted anew."""
    until: int | None = None
    """Last iteration, where it is not the planned one."""


class Slurm(Launcher):
    """The launcher on a cluster; `options` are those of new tasks, by default those that a run had before."""

    name: ClassVar[str] = "slurm"
    stays: ClassVar[bool] = True

    def __init__(self, options: SlurmOptions | None = None) -> None:
        self.slots = (options or SlurmOptions()).parallel
        self._options = options
        self._queue = _Queue()

    @property
    def trouble(self) -> str:
        """Why Slurm did not say where runs are when it was last asked; empty if it did."""
        return self._queue.trouble

    def check(self) -> None:
        """Raise SlurmError, with Slurm's words and what to do, if it would not take a task with these options."""
        _slurm("sbatch", "--test-only", *(self._options or SlurmOptions()).words(), "--wrap=true")

    def submit(self, directory: Path, runs: Sequence[str]) -> None:
        """Queue those runs that are left and have no task that Slurm knows: all of them, or none with SlurmError.

        More than 1,000 are split; each part waits for the one before, so that `parallel` caps all of them.
        """
        for run in runs:
            if (launcher := launcher_of(directory / run)) not in ("", self.name):
                raise SlurmError(
                    f"{run} is in the hands of the launcher {launcher}: go on with --launcher {launcher}, or cancel "
                    f"it first: morph-studio study --cancel {directory}"
                )
        places = self._fresh_states(directory, runs)
        new = [run for run in runs if run not in places or places[run] == _FORGOTTEN]
        self._submit(directory, [folder for folder in _folders(directory, new) if _is_left(folder)])

    def states(self, directory: Path, runs: Sequence[str], *, patient: bool = True) -> Mapping[str, Place]:
        """Return what is known of these runs. Slurm is asked once for all, and at most every ten seconds.

        Without `patient`, the answer is what is known now, while Slurm is asked in the background.
        """
        launches = {f.id: launch for f in _folders(directory, runs) if (launch := slurm_launch(f))}
        said = self._queue.look([launch.job for launch in launches.values()], patient)
        found = {run: said[launch.job] for run, launch in launches.items() if launch.job in said}
        return found | {run: _CANCELLED_PLACE for run in launches if (directory / run / CANCELLED).exists()}

    def cancel(self, directory: Path, runs: Sequence[str]) -> None:
        """Take runs out of the queue; those at work save and stop. Runs that have ended stay as they are."""
        places = self._fresh_states(directory, runs)
        tasks = []
        for folder in _folders(directory, runs):
            launch, place = slurm_launch(folder), places.get(folder.id)
            if launch and place and not place.given_up:
                tasks.append(launch.job)
                (folder.path / CANCELLED).touch()
        for part in _parts(tasks):
            _slurm("scancel", *part)

    def requeue(self, directory: Path, runs: Sequence[str]) -> None:
        """Queue runs once more that are left, and that were cancelled or have failed."""
        for folder in _folders(directory, runs):
            cancelled = folder.path / CANCELLED
            if cancelled.exists() and launcher_of(folder.path) != self.name:  # taken from another launcher
                (folder.path / LAUNCH).unlink(missing_ok=True)
                cancelled.unlink()
        self._go_on(directory, [f for f in _folders(directory, runs) if slurm_launch(f) and _is_left(f)])

    def resume(self, directory: Path, run: str, *, until: int | None = None) -> None:
        """Queue a run once more that has ended: it goes on from its newest checkpoint, to iteration `until` or as
        planned. One that waits or runs already is left alone."""
        self._go_on(directory, _folders(directory, [run]), until)

    def _fresh_states(self, directory: Path, runs: Sequence[str]) -> Mapping[str, Place]:
        """Return where these runs are now, or raise SlurmError if Slurm does not say."""
        self._queue.forget()
        places = self.states(directory, runs)
        if self.trouble:
            raise SlurmError(self.trouble)
        return places

    def _go_on(self, directory: Path, folders: Sequence[RunFolder], until: int | None = None) -> None:
        places = self._fresh_states(directory, [folder.id for folder in folders])
        anew = []
        for folder in folders:
            launch, place = slurm_launch(folder), places.get(folder.id)
            if launch and place and not place.given_up:
                continue
            if launch and place != _FORGOTTEN and until in (None, launch.until) and _requeued(launch.job):
                self._queue.expect(launch.job)
                (folder.path / CANCELLED).unlink(missing_ok=True)
            else:
                anew.append(folder)
        self._submit(directory, anew, until)

    def _submit(self, directory: Path, folders: Sequence[RunFolder], until: int | None = None) -> None:
        for options, group in _by_options(folders, self._options):
            jobs: list[str] = []
            try:
                for part in _parts(group):
                    jobs.append(_sbatch(directory, part, options, until, after=jobs[-1] if jobs else None))
            except SlurmError:
                if jobs:
                    _slurm("scancel", *jobs)
                raise
            for number, folder in enumerate(group):
                task = f"{jobs[number // LARGEST_ARRAY]}_{number % LARGEST_ARRAY}"
                launch = Launch(job=task, submitted=time.time(), options=asdict(options), until=until)
                durable.write_file(folder.path / LAUNCH, msgspec.json.encode(launch))
                (folder.path / CANCELLED).unlink(missing_ok=True)
                self._queue.expect(task)


def slurm_launch(folder: RunFolder) -> Launch | None:
    """Return how a run was launched if that was by Slurm; None too for a file that names no task of Slurm."""
    try:
        launch = msgspec.json.decode((folder.path / LAUNCH).read_bytes(), type=Launch)
    except (OSError, msgspec.DecodeError):
        return None
    return launch if launch.launcher == Slurm.name and _TASK.fullmatch(launch.job) else None


def _folders(directory: Path, runs: Sequence[str]) -> list[RunFolder]:
    return [RunFolder(directory / run) for run in runs]


def _is_left(folder: RunFolder) -> bool:
    """Tell whether a study is to go on with a run; what a user has stopped, nobody else starts."""
    try:
        history = History(folder)
    except (OSError, ValueError):  # the standing of the run says why
        return False
    return history.status != "finished" and not stopped_by_user(history)


def _requeued(task: str) -> bool:
    """Tell whether Slurm has put a task back into its queue; what it has forgotten, or may not touch, it does not."""
    try:
        _slurm("scontrol", "requeue", task)
    except SlurmError:
        return False
    return True


def _by_options(
    folders: Sequence[RunFolder], options: SlurmOptions | None
) -> Iterator[tuple[SlurmOptions, list[RunFolder]]]:
    """Yield runs with the options that their tasks shall have: those given, else the ones they had before."""
    groups: dict[SlurmOptions, list[RunFolder]] = {}
    for folder in folders:
        groups.setdefault(options or _options_before(folder), []).append(folder)
    yield from groups.items()


def _options_before(folder: RunFolder) -> SlurmOptions:
    launch = slurm_launch(folder)
    try:
        return SlurmOptions(**launch.options) if launch else SlurmOptions()  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):  # written by another version, or by hand
        return SlurmOptions()


T = TypeVar("T")


def _parts(items: Sequence[T]) -> Iterator[Sequence[T]]:
    """Yield the items in parts that fit into one array."""
    for first in range(0, len(items), LARGEST_ARRAY):
        yield items[first : first + LARGEST_ARRAY]


def _sbatch(
    directory: Path, folders: Sequence[RunFolder], options: SlurmOptions, until: int | None, after: str | None
) -> str:
    """Queue one array of tasks and return its number."""
    paths = [str(folder.path.resolve()) for folder in folders]
    if any("\n" in path for path in paths):
        raise SlurmError("the path of the runs must not have a line break in it")
    kept = directory.resolve() / ".slurm" / f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
    kept.mkdir(parents=True)
    (kept / "runs.txt").write_text("".join(f"{path}\n" for path in paths))
    further = [] if until is None else ["--until", str(until)]
    try:
        said = _slurm(
            "sbatch", "--parsable", f"--job-name=morph-{directory.resolve().name}",
            f"--array=0-{len(paths) - 1}%{options.parallel}", "--requeue", "--nodes=1", "--ntasks=1",
            "--cpus-per-task=1", *options.words(), "--export=ALL", f"--chdir={directory.resolve()}",
            "--open-mode=append", f"--output={str(kept).replace('%', '%%')}/%a.log",
            *([f"--dependency=afterany:{after}"] if after else []),
            str(files("studio.study") / "slurm_job.sh"), str(kept / "runs.txt"),
            *trainer_command(*further, "--run"),
        )  # fmt: skip
    except SlurmError:
        shutil.rmtree(kept)
        with contextlib.suppress(OSError):
            kept.parent.rmdir()  # only if nothing else is in it
        raise
    return said.strip().split(";")[0]  # NUMBER;CLUSTER where there are several clusters


# --- what Slurm says --------------------------------------------------------------------------------------------------

_TASK = re.compile(r"\d{1,12}_\d{1,7}")
_FORGOTTEN = Place(why="Slurm does not know its job any more: resume submits it anew", given_up=True)
_CANCELLED_PLACE = Place(why="cancelled: resume queues it once more", given_up=True)
_WORDS = {
    "JobArrayTaskLimit": "as many runs as --parallel allows are at work",
    "Resources": "waits for a free core",
    "Priority": "other jobs come first",
    "BeginTime": "was queued once more, and starts in a moment",
    "Dependency": "waits for the first 1,000 runs",
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


def _slurm(*words: str) -> str:
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


class _Queue:
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
        said = _slurm(
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
        return _FORGOTTEN
    state, node, reason = line.split("|", 2)
    if state in WAITING:
        return Place(why=f"{_WORDS.get(reason, 'waits')} (Slurm job {task}: {state}, {reason})")
    if state in AT_WORK:
        return Place(where=f"{node or 'a node'} (Slurm job {task}: {state})")
    if state == "COMPLETED":  # finished, or stopped by a user: its folder says which
        return Place(given_up=True)
    return Place(why=f"Slurm job {task}: {state}" + (f", {reason}" if reason != "None" else ""), given_up=True)
