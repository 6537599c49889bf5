"""The run folder: the only thing that trainer and studio share. One trainer writes it; anyone reads it."""

import contextlib
import fcntl
import hashlib
import io
import json
import os
import platform
import re
import time
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil

from morph_core import durable, format_1, inside, protocol
from morph_core.protocol import EPISODES, AnyCommand, AnyEvent, Heartbeat, Order, RunRecord, Status, Which

HEARTBEAT_BYTES = 4096
"""The heartbeat is rewritten in place at this size, so that it needs no new block on a full disk."""
STUDY = "study.json"
"""File beside run folders that makes them one study: its plan."""
REPORT = "report"
"""Folder beside run folders that holds the report of their study."""
ORIGIN = "origin"
"""Folder in that of a branch which holds what it took along of its parent: run.json and one checkpoint."""
MARKS = "marks.json"
"""File in a run folder with what people have noted about it."""
LAUNCH = "launch.json"
"""File in a run folder that says by whom its trainer is started."""
SAID_ENDED: tuple[Status, ...] = ("stopped", "finished", "failed")
"""Statuses by which a trainer says that it has ended."""
EVENTS_BYTES, EPISODE_BYTES, WEIGHTS_BYTES, STATE_BYTES = 512 << 20, 256 << 20, 1 << 30, 64 << 20
"""Largest event log, recorded episode, weights and state that are read: a run of 500,000 iterations has such a log."""
SMALL_BYTES = 4 << 20
"""Largest of all other files of a run that is read."""
UNPACKED_BYTES = 1 << 30
"""Largest size of the arrays of an episode together, which its file holds compressed."""
LONGEST_SENDER = 200
"""Largest number of characters that are kept of who sent a command."""
_ORDER = re.compile(r"[0-9]{1,12}\.json")
_LAST_EVENT = 10**15
"""Number of an event from which on no run counts further; no reader takes one beyond 2^53."""
_LAST_ORDER = 10**9
"""Largest number of a command that others are counted on from; a log from elsewhere may hold any."""
ITERATION = re.compile(r"[0-9]{1,12}")
"""Pattern of a word that names an iteration."""
CHECKPOINT = re.compile(r"[0-9]{6,12}")
"""Pattern of the names of checkpoints: the number of the iteration."""
_CHOSEN = "recorded"
"""Array of an episode file that holds the numbers of its episodes, in the order of EPISODES; -1 for none."""
RUN_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


class RunFolderError(ValueError):
    """A run folder that is missing, foreign, corrupt, or held by another trainer; says which and why."""


class NoEpisodeError(RunFolderError):
    """An episode that its file does not hold; says which it holds."""


class HeldError(RunFolderError):
    """A run folder that another trainer holds; it will be free once that one has ended."""


@dataclass(frozen=True)
class RunFolder:
    """Paths, readers and the inbox of one run; writing events is the trainer's (`EventLog`)."""

    path: Path

    @property
    def id(self) -> str:
        """Name of the run, which is that of its folder; bytes in it that are no characters are written out."""
        return os.fsencode(self.path.name).decode(errors="backslashreplace")

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
            written = inside.read(self.path, "run.json", SMALL_BYTES)
            if (found := protocol.format_of(written)) > protocol.FORMAT:
                raise RunFolderError(
                    f"run.json of {self.id} has format {found}; this version knows up to {protocol.FORMAT}: "
                    "open it with a newer morph-studio"
                )
            record = protocol.decode_record(written)
        except FileNotFoundError:
            raise RunFolderError(f"{self.id} has no run.json: not a run folder") from None
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise RunFolderError(f"run.json of {self.id} can't be read: {error}") from error
        if not record.parameters:
            raise RunFolderError(f"run.json of {self.id} names no design parameter: a run has at least one")
        if record.format == 1:
            return msgspec.structs.replace(record, config=format_1.translated(record.config))
        return record

    def read_events(self, offset: int = 0) -> tuple[list[AnyEvent], int]:
        """Return whole events from byte `offset` on, and the offset to go on from.

        A torn last line is left for the next call; a line that is no event (a newer version's, or damaged) is skipped.
        Raise RunFolderError where the log is no plain file of a sensible size, or can't be read.
        """
        events: list[AnyEvent] = []
        try:
            for text in inside.whole_lines(self.path, "events.jsonl", offset, EVENTS_BYTES):
                offset += len(text)
                for line in text.splitlines():
                    with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                        events.append(protocol.decode_event(line))
        except FileNotFoundError:
            return [], offset
        except OSError as error:
            raise RunFolderError(f"events.jsonl of {self.id} can't be read: {error}") from error
        return events, offset

    def heartbeat(self) -> Heartbeat | None:
        """Return the last heartbeat, or None where none can be read; RunFolderError where it is no plain file."""
        try:
            return protocol.decode_heartbeat(inside.read(self.path, "heartbeat.json", SMALL_BYTES).rstrip())
        except inside.NotPlainError as error:
            raise RunFolderError(f"heartbeat.json of {self.id} can't be read: {error}") from error
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None

    def is_launched(self) -> bool:
        """Tell whether something sees to it that this run is started: a study, or a launcher."""
        return (self.path / LAUNCH).exists() or (self.path.parent / STUDY).exists()

    def checkpoint_iterations(self) -> list[int]:
        """Return the iterations of checkpoints, ascending; half-written ones have another name.

        Whether one can be read is known by those who read it. Raise RunFolderError where a link stands in their place.
        """
        return sorted(int(name) for name in self._names("checkpoints") if CHECKPOINT.fullmatch(name))

    def episode_iterations(self) -> list[int]:
        """Return the iterations of which there is a recorded episode, ascending."""
        stems = (name.removesuffix(".npz") for name in self._names(self.episodes.name) if name.endswith(".npz"))
        return sorted(int(stem) for stem in stems if CHECKPOINT.fullmatch(stem))

    def _names(self, folder: str) -> list[str]:
        try:
            return inside.names(self.path, folder)
        except OSError as error:
            raise RunFolderError(f"{folder} of {self.id} can't be read: {error}") from error

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
        inside.folder(self.path, "commands")
        taken = [int(name[:-5]) for name in self._orders()]
        acknowledged = [e.id for e in self.read_events()[0] if isinstance(e, protocol.Acknowledged)]
        number = max((known for known in taken + acknowledged if known < _LAST_ORDER), default=0) + 1
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
        for name in self._orders():
            path = self.commands / name
            try:
                yield path, protocol.decode_order(inside.read(self.path, f"commands/{name}", SMALL_BYTES))
            except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                yield path, None

    def _orders(self) -> list[str]:
        return [name for name in self._names("commands") if _ORDER.fullmatch(name)]


def sealed(facts: Mapping[str, object], weights: bytes) -> bytes:
    """Return a checkpoint's facts as its state.json holds them: with the checksums of its weights and of themselves."""
    whole = {**facts, "weights_sha256": hashlib.sha256(weights).hexdigest()}
    return json.dumps({**whole, "sha256": _sum_of(whole)}).encode()


def unsealed(state: bytes, weights: bytes) -> dict[str, Any]:
    """Return the facts of a state.json. Raise ValueError where it, or the weights, are not as they were written.

    Those of older versions have no checksums, and are taken as they are.
    """
    facts = json.loads(state)
    if facts.pop("sha256", None) not in (None, _sum_of(facts)):
        raise ValueError("its state.json is not as it was written: damaged, or changed by hand")
    if facts.pop("weights_sha256", None) not in (None, hashlib.sha256(weights).hexdigest()):
        raise ValueError("its weights are not as they were written: damaged, or of another checkpoint")
    return facts


def _sum_of(facts: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def process_alive(pid: int, started: float) -> bool:
    """Tell whether the process `pid` that started at `started` (s since the epoch) is there and no zombie."""
    try:
        process = psutil.Process(pid)
        return abs(process.create_time() - started) < 2.0 and process.status() != psutil.STATUS_ZOMBIE
    except (psutil.Error, ValueError, OverflowError):  # of another process by now, or a number that no process has
        return False


def process_there(pid: int) -> bool:
    """Tell whether any process has the number `pid` and is no zombie."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except (psutil.Error, ValueError, OverflowError):
        return False


def find_run(runs: Path, run_id: str) -> RunFolder:
    """Return the run `run_id` of the folder `runs`; raise RunFolderError that says what is allowed."""
    if not RUN_ID.fullmatch(run_id):
        raise RunFolderError(f"{run_id[:80]!r} is no run name: letters, digits, dot, dash and underscore, at most 128")
    path = runs / run_id
    if not path.is_dir() or (path.is_symlink() and path.resolve().parent != runs.resolve()):
        raise RunFolderError(f'unknown run "{run_id}"; choose from: {", ".join(list_runs(runs)[-8:]) or "none yet"}')
    return RunFolder(path)


def list_runs(runs: Path) -> list[str]:
    """Return the names of all folders in `runs` that could be runs, oldest first."""
    return sorted(e.name for e in _entries(runs) if RUN_ID.fullmatch(e.name) and e.is_dir(follow_symlinks=False))


def passed_over(runs: Path) -> dict[str, str]:
    """Return the names of folders in `runs` that may be runs and yet can't be opened, each with the reason."""
    found = {}
    for entry in _entries(runs):
        try:
            why = _why_passed_over(entry)
        except OSError as error:  # a link that leads to itself, or into what others own
            why = f"it can't be looked into: {error.strerror}"
        if why:
            found[os.fsencode(entry.name).decode(errors="backslashreplace")] = why  # may hold what is no character
    return found


def _why_passed_over(entry: os.DirEntry[str]) -> str:
    """Return why a folder that may be a run can't be opened; nothing for a run, and for what is not meant as one."""
    if entry.is_symlink() and entry.is_dir():
        return "it is a link to a folder elsewhere: move the folder itself to here"
    if entry.is_dir() and not RUN_ID.fullmatch(entry.name) and (Path(entry.path) / "run.json").is_file():
        return "its name has other characters than letters, digits, dot, dash and underscore, at most 128: rename it"
    return ""


def _entries(runs: Path) -> list[os.DirEntry[str]]:
    """Return what is in a folder of runs, but for what is hidden and the report of a study."""
    try:
        with os.scandir(runs) as found:
            return [e for e in found if not e.name.startswith(".") and not (e.name == REPORT and _is_study(runs))]
    except OSError:
        return []


def _is_study(runs: Path) -> bool:
    return (runs / STUDY).exists()


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
    try:
        for name in ("checkpoints", "commands", "episodes", "rollouts"):
            inside.names(folder.path, name)
        lock = inside.open_plain(folder.path, "trainer.lock", os.O_RDWR | os.O_CREAT)
    except OSError as error:
        raise RunFolderError(f"{folder.id} can't be written to: {error}") from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the kernel lets go of it even after kill -9
        except BlockingIOError:
            holder = os.pread(lock, 200, 0).decode("utf-8", "replace").strip()
            raise HeldError(f"{folder.id} is held by another trainer ({holder or '?'})") from None
        except OSError as error:
            raise RunFolderError(
                f"{folder.id} can't be locked ({error.strerror}): put the runs on a file system with locks "
                "(a local disk, NFS, Lustre mounted with -o flock), not on a mounted bucket"
            ) from error
        with contextlib.suppress(OSError):  # a full disk: the lock holds all the same
            os.ftruncate(lock, 0)
            holder = f"{platform.node()} pid {os.getpid()} started {psutil.Process().create_time():.2f}"
            inside.write_at(lock, holder.encode(), 0)
        yield
    finally:
        os.close(lock)


class EventLog:
    """The append-only events.jsonl, opened by the one trainer that holds the folder."""

    def __init__(self, folder: RunFolder) -> None:
        events, self._end = folder.read_events()
        self.seq = max((e.seq for e in events), default=0)
        if self.seq >= _LAST_EVENT:
            raise RunFolderError(f"events.jsonl of {folder.id} counts up to {self.seq}: no event can follow that")
        self._fd = inside.open_plain(folder.path, "events.jsonl", os.O_RDWR | os.O_CREAT)
        os.ftruncate(self._fd, self._end)  # a torn last line of a killed trainer

    def append(self, event: AnyEvent) -> AnyEvent:
        """Write one event with the next `seq`; on OSError the log is as it was before.

        Raise FloatingPointError for one that no reader would take: a number in it is NaN, infinite or too large.
        """
        stamped = msgspec.structs.replace(event, seq=self.seq + 1, time=time.time())
        line = protocol.encode(stamped) + b"\n"
        try:
            protocol.decode_event(line)
        except msgspec.ValidationError as error:
            raise FloatingPointError(f"a number that was to be recorded is none that can be read: {error}") from error
        try:
            inside.write_at(self._fd, line, self._end)
        except OSError:
            os.ftruncate(self._fd, self._end)
            raise
        self._end += len(line)
        self.seq += 1
        return stamped

    def sync(self) -> None:
        """Make sure that what was written is on the disk: the other machines of a shared one see it only then."""
        os.fsync(self._fd)

    def close(self) -> None:
        """Make sure that every event is on the disk, and close the log."""
        self.sync()
        os.close(self._fd)


class HeartbeatFile:
    """heartbeat.json, rewritten in place in one write of a fixed size: readers see the old one or the new one."""

    def __init__(self, folder: RunFolder) -> None:
        self._fd = inside.open_plain(folder.path, "heartbeat.json", os.O_RDWR | os.O_CREAT)

    def write(self, beat: Heartbeat) -> None:
        """Write a heartbeat in place of the last one; a message that does not fit is shortened."""
        while len(text := protocol.encode(beat)) > HEARTBEAT_BYTES:
            beat = msgspec.structs.replace(beat, message=beat.message[: len(beat.message) // 2])
        inside.write_at(self._fd, text.ljust(HEARTBEAT_BYTES), 0)

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
    inside.folder(folder.path, folder.episodes.name)
    durable.write_file(folder.episode(iteration), buffer.getvalue())
    return f"{folder.episodes.name}/{iteration:06d}.npz"


def read_episode(folder: RunFolder, iteration: int, which: Which | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of a recorded episode: of the median one, or of the only one, where `which` is None.

    Raise RunFolderError if there is no such episode or it is damaged.
    """
    content = episode_bytes(folder, iteration)
    try:
        with foreign(f"episode {iteration} of {folder.id}"):
            return episode_arrays(content, which)
    except NoEpisodeError as error:
        raise RunFolderError(f"iteration {iteration} of {folder.id} {error}") from None


def episode_bytes(folder: RunFolder, iteration: int) -> bytes:
    """Return the file of a recorded episode; raise RunFolderError if there is none, or no plain one."""
    try:
        return inside.read(folder.path, f"{folder.episodes.name}/{iteration:06d}.npz", EPISODE_BYTES)
    except FileNotFoundError:
        raise RunFolderError(f"{folder.id} has no episode of iteration {iteration}") from None
    except OSError as error:
        raise RunFolderError(f"episode {iteration} of {folder.id} can't be read: {error}") from error


def episode_arrays(content: bytes, which: Which | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of one episode of an npz file, the median one by default. Nothing is unpickled.

    Raise NoEpisodeError with the choices if the file does not hold this one, ValueError where its arrays are too large.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if (size := sum(entry.file_size for entry in archive.infolist())) > UNPACKED_BYTES:
            raise ValueError(f"its arrays have {size:,} bytes, and at most {UNPACKED_BYTES:,} are read")
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        chosen = _chosen(file[_CHOSEN]) if _CHOSEN in file.files else {}
        if which is not None and which not in chosen:
            raise NoEpisodeError(f"has no {which} episode; {_choices(chosen)}")
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


@contextlib.contextmanager
def foreign(what: str) -> Iterator[None]:
    """Turn whatever other people's readers throw at damaged files into one RunFolderError that names the file."""
    try:
        yield
    except RunFolderError:
        raise
    except Exception as error:
        raise RunFolderError(f"{what} can't be read: {str(error) or type(error).__name__}") from error
