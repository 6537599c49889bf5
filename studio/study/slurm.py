"""Runs as tasks of Slurm's job arrays, by its own commands alone: no process of ours has to live on."""

import contextlib
import os
import secrets
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import ClassVar, TypeVar

import msgspec

from morph_core import durable, inside
from morph_core.history import History
from morph_core.run_folder import LAUNCH, SMALL_BYTES, RunFolder
from studio.study.launcher import Launcher, Place, check_hands, launcher_of
from studio.study.local import CANCELLED
from studio.study.slurm_options import SlurmOptions
from studio.study.slurm_queue import FORGOTTEN, TASK, Queue, SlurmError, call
from studio.study.standing import stopped_by_user
from studio.trainers import trainer_command

LARGEST_ARRAY = 1000
"""Tasks of one array: Slurm's own limit (MaxArraySize) is 1,001 unless a cluster sets another."""
_CANCELLED = Place(why="cancelled: resume queues it once more", given_up=True)


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
        self._queue = Queue()

    @property
    def trouble(self) -> str:
        """Why Slurm did not say where runs are when it was last asked; empty if it did."""
        return self._queue.trouble

    def check(self) -> None:
        """Raise SlurmError, with Slurm's words and what to do, if it would not take a task with these options."""
        call("sbatch", "--test-only", *(self._options or SlurmOptions()).words(), "--wrap=true")

    def submit(self, directory: Path, runs: Sequence[str]) -> None:
        """Queue those runs that are left and have no task that Slurm knows: all of them, or none with ValueError.

        More than 1,000 are split; each part waits for the one before, so that `parallel` caps all of them.
        """
        check_hands(directory, runs, self.name)
        places = self._fresh_states(directory, runs)
        new = [run for run in runs if run not in places or places[run] == FORGOTTEN]
        self._submit(directory, [folder for folder in _folders(directory, new) if _is_left(folder)])

    def states(self, directory: Path, runs: Sequence[str], *, patient: bool = True) -> Mapping[str, Place]:
        """Return what is known of these runs. Slurm is asked once for all, and at most every ten seconds.

        Without `patient`, the answer is what is known now, while Slurm is asked in the background.
        """
        launches = {f.id: launch for f in _folders(directory, runs) if (launch := slurm_launch(f))}
        said = self._queue.look([launch.job for launch in launches.values()], patient)
        found = {run: said[launch.job] for run, launch in launches.items() if launch.job in said}
        return found | {run: _CANCELLED for run in launches if (directory / run / CANCELLED).exists()}

    def cancel(self, directory: Path, runs: Sequence[str]) -> None:
        """Take runs out of the queue; those at work save and stop. Runs that have ended stay as they are."""
        places = self._fresh_states(directory, runs)
        tasks = []
        for folder in _folders(directory, runs):
            launch, place = slurm_launch(folder), places.get(folder.id)
            if launch and place and not place.given_up:
                tasks.append(launch.job)
                inside.touch(folder.path, CANCELLED)
        for part in _parts(tasks):
            call("scancel", "--quiet", *part)  # quiet: no error for what has ended meanwhile

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
            if launch and place != FORGOTTEN and until in (None, launch.until) and _requeued(launch.job):
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
                    call("scancel", *jobs)
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
        launch = msgspec.json.decode(inside.read(folder.path, LAUNCH, SMALL_BYTES), type=Launch)
    except (OSError, ValueError, RecursionError):
        return None
    return launch if launch.launcher == Slurm.name and TASK.fullmatch(launch.job) else None


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
        call("scontrol", "requeue", task)
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
    try:
        kept.mkdir(parents=True)
        (kept / "runs.txt").write_bytes(os.fsencode("".join(f"{path}\n" for path in paths)))
    except OSError as error:
        raise SlurmError(f"the list of the runs can't be written ({error})") from error
    further = [] if until is None else ["--until", str(until)]
    try:
        said = call(
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
