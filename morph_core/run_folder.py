"""The run folder: the only thing that trainer and studio share. One trainer writes it; anyone reads it."""

import contextlib
import fcntl
import io
import os
import platform
import re
import time
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import psutil

from morph_core import durable, format_1, protocol
from morph_core.protocol import EPISODES, AnyCommand, AnyEvent, Heartbeat, Order, RunRecord, Status, Which

HEARTBEAT_BYTES = 4096
"""The heartbeat is rewritten in place at this size, so that it needs no new block on a full disk."""
LOST_AFTER = 60.0
"""Seconds in which the heartbeat of a trainer on another host changes: disks that hosts share show it late."""
LARGEST_SKEW = 60.0
"""Seconds by which a clock of another host may differ from the one here."""
STUDY = "study.json"
"""File beside run folders that makes them one study: its plan."""
REPORT = "report"
"""Folder beside run folders that holds the report of their study."""
ORIGIN = "origin"
"""Folder in that of a branch which holds what it took along of its parent: run.json and one checkpoint."""
LAUNCH = "launch.json"
"""File in a run folder that says by whom its trainer is started."""
SAID_ENDED: tuple[Status, ...] = ("stopped", "finished", "failed")
"""Statuses by which a trainer says that it has ended."""
LONGEST_SENDER = 200
"""Largest number of characters that are kept of who sent a command."""
_CHOSEN = "recorded"
"""Array of an episode file that holds the numbers of its episodes, in the order of EPISODES; -1 for none."""
RUN_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


class RunFolderError(ValueError):
    """A run folder that is missing, foreign, corrupt, or held by another trainer; says which and why."""


class HeldError(RunFolderError):
    """A run folder that another trainer holds; it will be free once that one has ended."""


@dataclass(frozen=True)
class RunFolder:
    """Paths, readers and the inbox of one run; writing events is the trainer's (`EventLog`)."""

    path: Path

    @property
    def id(self) -> str:
        """Name of the run, which is that of its folder."""
        return self.path.name

    @property
    def events(self) -> Path:
        """Path of the event log."""
        return self.path / "events.jsonl"

    @property
    def episodes(self) -> Path:
        """Return the folder of recorded episodes, which format 1 called `rollouts`."""
        old = self.path / "rollouts"
        return old if old.is_dir() and not (self.path / "episodes").is_dir() else self.path / "episodes"

    @property
    def checkpoints(self) -> Path:
        """Path of the folder of checkpoints."""
        return self.path / "checkpoints"

    @property
    def commands(self) -> Path:
        """Path of the inbox, in which each command is a file."""
        return self.path / "commands"

    @property
    def exports(self) -> Path:
        """Path of the folder of exports."""
        return self.path / "exports"

    # --- reading ---

    def record(self) -> RunRecord:
        """Return the content of run.json, of older formats too, with today's names of the settings.

        Raise RunFolderError if it is missing, foreign, damaged, or of a format newer than this version.
        """
        try:
            written = (self.path / "run.json").read_bytes()
            if (found := protocol.format_of(written)) > protocol.FORMAT:
                raise RunFolderError(
                    f"run.json of {self.id} has format {found}; this version knows up to {protocol.FORMAT}: "
                    "open it with a newer morph-studio"
                )
            record = protocol.decode_record(written)
        except FileNotFoundError:
            raise RunFolderError(f"{self.id} has no run.json: not a run folder") from None
        except (OSError, msgspec.DecodeError) as error:
            raise RunFolderError(f"run.json of {self.id} can't be read: {error}") from error
        if record.format == 1:
            return msgspec.structs.replace(record, config=format_1.translated(record.config))
        return record

    def read_events(self, offset: int = 0) -> tuple[list[AnyEvent], int]:
        """Return whole events from byte `offset` on, and the offset to go on from.

        A torn last line is left for the next call; a line that is no event (a newer version's, or damaged) is skipped.
        """
        try:
            with self.events.open("rb") as file:
                file.seek(offset)
                text = file.read()
        except FileNotFoundError:
            return [], offset
        whole = text.rfind(b"\n") + 1
        events = []
        for line in text[:whole].splitlines():
            with contextlib.suppress(msgspec.DecodeError):
                events.append(protocol.decode_event(line))
        return events, offset + whole

    def heartbeat(self) -> Heartbeat | None:
        """Return the last heartbeat, or None if there is none that can be read."""
        try:
            return protocol.decode_heartbeat((self.path / "heartbeat.json").read_bytes().rstrip())
        except (OSError, msgspec.DecodeError):
            return None

    def trainer_alive(self) -> bool:
        """Tell whether a trainer holds this folder: its process is there, or its heartbeat is of late."""
        beat = self.heartbeat()
        return beat is not None and beat.status not in SAID_ENDED and still_beating(beat)

    def is_launched(self) -> bool:
        """Tell whether something sees to it that this run is started: a study, or a launcher."""
        return (self.path / LAUNCH).exists() or (self.path.parent / STUDY).exists()

    def checkpoint_iterations(self) -> list[int]:
        """Return the iterations of whole checkpoints, ascending; half-written ones have another name."""
        if not self.checkpoints.is_dir():
            return []
        return sorted(int(p.name) for p in self.checkpoints.iterdir() if p.is_dir() and re.fullmatch(r"\d{6,}", p.name))

    def checkpoint_up_to(self, iteration: int) -> int:
        """Return the iteration of the newest checkpoint up to `iteration`.

        Raise RunFolderError that says from where on there are any.
        """
        saved = self.checkpoint_iterations()
        known = [i for i in saved if i <= iteration]
        if not known:
            first = f"the first is of iteration {saved[0]}" if saved else "there is none at all"
            raise RunFolderError(
                f"{self.id} has no checkpoint up to iteration {iteration}: no policy to evaluate; {first}"
            )
        return known[-1]

    def checkpoint(self, iteration: int) -> Path:
        """Return the path of the checkpoint of an iteration."""
        return self.checkpoints / f"{iteration:06d}"

    def episode(self, iteration: int) -> Path:
        """Return the path of the recorded episode of an iteration."""
        return self.episodes / f"{iteration:06d}.npz"

    # --- the inbox ---

    def send(self, command: AnyCommand, sender: str = "") -> int:
        """Put a command into the inbox and return the id by which it will be acknowledged.

        `sender` says in words who sends it and by which way.
        """
        self.commands.mkdir(exist_ok=True)
        taken = [int(p.stem) for p in self.commands.iterdir() if p.stem.isdigit()]
        acknowledged = [e.id for e in self.read_events()[0] if isinstance(e, protocol.Acknowledged)]
        number = max(taken + acknowledged, default=0) + 1
        while True:
            draft = self.commands / f".{number:06d}.{os.getpid()}.{time.monotonic_ns()}"
            durable.write_file(draft, protocol.encode(Order(number, command, sender[:LONGEST_SENDER])))
            try:
                os.link(draft, self.commands / f"{number:06d}.json")  # fails where rename would replace another's
                return number
            except FileExistsError:
                number += 1
            finally:
                draft.unlink()

    def pending(self) -> Iterator[tuple[Path, Order | None]]:
        """Yield the inbox in order, with None for a file that is no order; the trainer removes what it has taken."""
        if not self.commands.is_dir():
            return
        for path in sorted(self.commands.glob("[0-9]*.json")):
            try:
                yield path, protocol.decode_order(path.read_bytes())
            except (OSError, msgspec.DecodeError):
                yield path, None


def still_beating(beat: Heartbeat, unchanged: float = 0.0) -> bool:
    """Tell whether the heartbeat's process is there; on another host, whether the heartbeat is of late, and has not
    stayed `unchanged` for too many seconds of the reader's own clock."""
    if beat.host == platform.node():
        return process_alive(beat.pid, beat.process_started)
    return unchanged < LOST_AFTER and abs(time.time() - beat.time) < LOST_AFTER + LARGEST_SKEW


def process_alive(pid: int, started: float) -> bool:
    """Tell whether the process `pid` that started at `started` (s since the epoch) is there and no zombie."""
    try:
        process = psutil.Process(pid)
        return abs(process.create_time() - started) < 2.0 and process.status() != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return False


def find_run(runs: Path, run_id: str) -> RunFolder:
    """Return the run `run_id` of the folder `runs`; raise RunFolderError that says what is allowed."""
    if not RUN_ID.fullmatch(run_id):
        raise RunFolderError(f"{run_id[:80]!r} is no run name: letters, digits, dot, dash and underscore, at most 128")
    path = runs / run_id
    if not path.is_dir() or path.resolve().parent != runs.resolve():
        raise RunFolderError(f'unknown run "{run_id}"; choose from: {", ".join(list_runs(runs)[-8:]) or "none yet"}')
    return RunFolder(path)


def list_runs(runs: Path) -> list[str]:
    """Return the names of all folders in `runs` that could be runs, oldest first."""
    if not runs.is_dir():
        return []
    return sorted(p.name for p in runs.iterdir() if p.is_dir() and RUN_ID.fullmatch(p.name) and not _is_report(p))


def _is_report(path: Path) -> bool:
    return path.name == REPORT and (path.parent / STUDY).exists()


def create_run(runs: Path, record: RunRecord, files: Mapping[str, bytes] | None = None) -> RunFolder:
    """Write a new run folder: whole or not at all. Raise RunFolderError if the name is taken.

    `files` are written into it, by their path in the folder.
    """
    if not RUN_ID.fullmatch(record.id):
        raise RunFolderError(f"{record.id!r} is no run name: letters, digits, dot, dash and underscore, at most 128")
    runs.mkdir(parents=True, exist_ok=True)
    target = runs / record.id
    try:
        with durable.new_folder(target) as draft:
            for folder in ("episodes", "checkpoints", "commands", "exports"):
                (draft / folder).mkdir()
            (draft / "run.json").write_bytes(msgspec.json.format(protocol.encode(record), indent=2))
            (draft / "events.jsonl").touch()
            for name, content in (files or {}).items():
                (draft / name).parent.mkdir(parents=True, exist_ok=True)
                (draft / name).write_bytes(content)
    except OSError:
        if target.exists():
            raise RunFolderError(f"a run named {record.id} is there already") from None
        raise
    return RunFolder(target)


def new_run_id(task: str, method: str, seed: int, now: float | None = None) -> str:
    """Return a name such as 20261122-101530-reacher-morph-s0."""
    return f"{time.strftime('%Y%m%d-%H%M%S', time.localtime(now))}-{task}-{method}-s{seed}"


# --- what only the trainer does ---


@contextlib.contextmanager
def hold(folder: RunFolder) -> Iterator[None]:
    """Hold the folder as its single writer; raise HeldError if another trainer does.

    Raise RunFolderError with the reason where the file system of the folder has no locks.
    """
    with (folder.path / "trainer.lock").open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the kernel lets go of it even after kill -9
        except BlockingIOError:
            file.seek(0)
            raise HeldError(f"{folder.id} is held by another trainer ({file.read().strip() or '?'})") from None
        except OSError as error:
            raise RunFolderError(
                f"{folder.id} can't be locked ({error.strerror}): put the runs on a file system with locks "
                "(a local disk, NFS, Lustre mounted with -o flock), not on a mounted bucket"
            ) from error
        file.truncate(0)
        file.write(f"{platform.node()} pid {os.getpid()} started {psutil.Process().create_time():.2f}")
        file.flush()
        yield


class EventLog:
    """The append-only events.jsonl, opened by the one trainer that holds the folder."""

    def __init__(self, folder: RunFolder) -> None:
        events, whole = folder.read_events()
        self.seq = max((e.seq for e in events), default=0)
        self._file = folder.events.open("r+b" if folder.events.exists() else "w+b")
        self._file.truncate(whole)  # a torn last line of a killed trainer
        self._file.seek(whole)

    def append(self, event: AnyEvent) -> AnyEvent:
        """Write one event with the next `seq`; on OSError the log is as it was before."""
        stamped = msgspec.structs.replace(event, seq=self.seq + 1, time=time.time())
        before = self._file.tell()
        try:
            self._file.write(protocol.encode(stamped) + b"\n")
            self._file.flush()
        except OSError:
            self._file = _reopen(self._file, before)
            raise
        self.seq += 1
        return stamped

    def sync(self) -> None:
        """Make sure that what was written is on the disk: the other machines of a shared one see it only then."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Make sure that every event is on the disk, and close the log."""
        self.sync()
        self._file.close()


def _reopen(file: io.BufferedRandom, size: int) -> io.BufferedRandom:
    """Drop what is stuck in the buffer of `file` and cut it back to `size` bytes."""
    os.ftruncate(file.fileno(), size)
    with contextlib.suppress(OSError):
        file.close()  # the buffered rest fails again; the descriptor closes all the same
    fresh = open(file.name, "r+b")  # noqa: SIM115 - held for the log's life
    fresh.truncate(size)
    fresh.seek(size)
    return fresh


class HeartbeatFile:
    """heartbeat.json, rewritten in place in one write of a fixed size: readers see the old one or the new one."""

    def __init__(self, folder: RunFolder) -> None:
        self._fd = os.open(folder.path / "heartbeat.json", os.O_RDWR | os.O_CREAT, 0o666)

    def write(self, beat: Heartbeat) -> None:
        """Write a heartbeat in place of the last one; a message that does not fit is shortened."""
        while len(text := protocol.encode(beat)) > HEARTBEAT_BYTES:
            beat = msgspec.structs.replace(beat, message=beat.message[: len(beat.message) // 2])
        os.pwrite(self._fd, text.ljust(HEARTBEAT_BYTES), 0)

    def sync(self) -> None:
        """Make sure that the last heartbeat is on the disk: the other machines of a shared one see it only then."""
        os.fsync(self._fd)

    def close(self) -> None:
        """Close the file; the last heartbeat stays in it."""
        os.close(self._fd)


def write_episode(folder: RunFolder, iteration: int, arrays: dict[str, np.ndarray]) -> str:
    """Write the recorded episodes of an evaluation; return the file's name relative to the run folder."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    folder.episodes.mkdir(exist_ok=True)
    durable.write_file(folder.episode(iteration), buffer.getvalue())
    return f"{folder.episodes.name}/{iteration:06d}.npz"


def read_episode(folder: RunFolder, iteration: int, which: Which | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of a recorded episode: of the median one, or of the only one, where `which` is None.

    Raise RunFolderError if there is no such episode or it is damaged.
    """
    try:
        return episode_arrays(folder.episode(iteration).read_bytes(), which)
    except FileNotFoundError:
        raise RunFolderError(f"{folder.id} has no episode of iteration {iteration}") from None
    except RunFolderError as error:
        raise RunFolderError(f"iteration {iteration} of {folder.id} {error}") from None
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise RunFolderError(f"episode {iteration} of {folder.id} can't be read: {error}") from error


def episode_arrays(content: bytes, which: Which | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of one episode of an npz file, the median one by default. Nothing is unpickled.

    Raise RunFolderError with the choices if the file does not hold this one.
    """
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        chosen = _chosen(file[_CHOSEN]) if _CHOSEN in file.files else {}
        if which is not None and which not in chosen:
            raise RunFolderError(f"has no {which} episode; {_choices(chosen)}")
        own = f"{chosen[which]}/" if which else ""
        names = {name: name for name in file.files if name != _CHOSEN and not name.partition("/")[0].isdecimal()}
        if own:
            names |= {name.removeprefix(own): name for name in file.files if name.startswith(own)}
        return {name: file[stored] for name, stored in names.items()}


def _chosen(numbers: np.ndarray) -> dict[Which, int]:
    """Return which episodes a file holds, and under which number."""
    found = zip(EPISODES, numbers.astype(int).reshape(-1).tolist(), strict=False)
    return {which: number for which, number in found if number >= 0}


def _choices(chosen: Mapping[Which, int]) -> str:
    return f"choose from: {', '.join(chosen)}" if chosen else "a single one was recorded, which has no name"
