"""Films and stills made in the background: one at a time, by a process of its own that gives way to all others."""

import contextlib
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import psutil

from morph_core.protocol import Which
from studio.trainers import trainer_environment

LONGEST = 60.0
"""Seconds that an evolution takes at most in such a film; the command line makes longer ones."""
MOST_FRAMES = 3600
"""Frames of the longest such film."""
CPU_SECONDS = 1800
"""Processor time after which a film is given up. A clock would not do: beside trainings a film may take hours."""
_PATIENCE = 30.0
"""Seconds in which whoever asks for a film is told that it can't be made, rather than that it has begun."""
_LOG_BYTES = 4096
_PREFIX, _LOCK = "morph-film-", "lock"
"""Beginning of the names of folders in which films are made, and the file in each that its server holds locked."""

Format = Literal["mp4", "gif", "svg", "png"]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
Design = Annotated[str, msgspec.Meta(pattern="^(best|latest|[0-9]{1,9})$")]


class FilmWish(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Wish for a film (mp4, gif) or a still (svg, png) of a run."""

    run: Name
    format: Format = "mp4"
    design: Design | None = None
    """Design whose recorded episode is filmed, best, latest or an iteration; without it, the whole evolution. Of a
    still, the design that is shown, by default the best one."""
    beside: Name | None = None
    """Another run of the task, which a film shows on its right."""
    beside_design: Design | None = None
    """Design of the run on the right, where episodes are filmed."""
    episode: Which | None = None
    """Word for the recorded episode that is seen, by default median."""
    at: Annotated[float, msgspec.Meta(ge=0, le=3600)] | None = None
    """Moment of the episode that a still shows, in seconds; without it, the design in its start posture."""
    height: Literal[360, 540, 720, 1080] | None = None
    """Height of a film in pixels, 16:9; by default 1080, of a GIF 540."""
    seconds: Annotated[float, msgspec.Meta(ge=2, le=LONGEST)] | None = None
    """Seconds that the evolution takes in a film, by default 0.2 for each iteration, and from 6 to 30."""

    def __post_init__(self) -> None:
        if self.is_still and (given := [name for name in _OF_FILMS if getattr(self, name) is not None]):
            raise ValueError(f"{given[0]} goes with mp4 and gif; {self.format} is a still of one design")
        if not self.is_still and self.at is not None:
            raise ValueError(f"at goes with svg and png; {self.format} shows the whole episode")
        if self.beside is None and self.beside_design is not None:
            raise ValueError("beside_design goes with beside, the run on the right")
        if not self.is_still and self.shows_episodes and self.seconds is not None:
            raise ValueError("seconds goes with an evolution; an episode is filmed as long as it is")

    @property
    def is_still(self) -> bool:
        """Whether one picture is wished for."""
        return self.format in ("svg", "png")

    @property
    def shows_episodes(self) -> bool:
        """Whether a film shows recorded episodes in place of the evolution."""
        return any(word is not None for word in (self.design, self.beside_design, self.episode))

    @property
    def runs(self) -> list[str]:
        """Names of the runs that are seen."""
        return [name for name in (self.run, self.beside) if name is not None]

    @property
    def file_name(self) -> str:
        """Name of the file."""
        seen = self.design or "best" if self.is_still or self.shows_episodes else "evolution"
        return f"{self.run}-{seen}.{self.format}"


_OF_FILMS = ("beside", "beside_design", "height", "seconds")


class FilmState(msgspec.Struct, frozen=True, kw_only=True):
    """The film that is being made, or was made last."""

    state: Literal["none", "making", "ready", "failed", "cancelled"] = "none"
    number: int = 0
    """Number of films begun since the server started, which tells one from the next."""
    wish: FilmWish | None = None
    name: str = ""
    """Name of the file; empty while none was wished for."""
    frames: int = 0
    """Frames that it will have; 0 until that is known."""
    done: int = 0
    """Frames that are drawn."""
    seconds_left: float | None = None
    """Time until it is ready, as fast as the frames up to now; None until some are drawn."""
    resting: bool = False
    """Whether it is made slowly, as other work keeps the processors busy."""
    size: int = 0
    """Bytes of the file, once it is ready."""
    reason: str = ""
    """Why it has failed."""


class Order(msgspec.Struct, frozen=True):
    """What the process is told to make."""

    wish: FilmWish
    folders: list[str]
    """Paths of the run folders, as many as there are runs in the wish."""
    out: str


class Said(msgspec.Struct, frozen=True, omit_defaults=True):
    """A line of the process: how many frames there will be and are done, whether it rests, or why it is given up."""

    frames: int = 0
    done: int = 0
    resting: bool = False
    failed: str = ""


@dataclass
class _Making:
    """A film that is being made."""

    home: Path
    child: subprocess.Popen[bytes]
    begun: threading.Event = field(default_factory=threading.Event)
    """Set as soon as it is known whether it can be made at all."""
    first: tuple[float, int] | None = None
    """When the first frames were drawn, by the monotonic clock, and how many: what an interruption left is no pace."""


def spawn_filming(order: Order, log: Path) -> subprocess.Popen[bytes]:
    """Start the process that makes a film; it says on its standard output how far it is."""
    words = ["-P", "-m", "studio.film", msgspec.json.encode(order).decode()]
    with log.open("wb") as errors:
        return subprocess.Popen(
            [sys.executable, *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors,
            env=trainer_environment(), start_new_session=True,
        )  # fmt: skip


class Films:
    """The film that is being made, or was made last; it is kept until another one is begun. It is thread-safe."""

    def __init__(
        self,
        find: Callable[[str], Path],
        spawn: Callable[[Order, Path], subprocess.Popen[bytes]] = spawn_filming,
    ) -> None:
        """Make none yet; `find` returns the folder of a run, or raises RunFolderError."""
        self._find = find
        self._spawn = spawn
        self._lock = threading.Lock()
        self._state = FilmState()
        self._making: _Making | None = None
        self._home: _Home | None = None
        self._closed = False
        _sweep()

    @property
    def state(self) -> FilmState:
        """Return how far the film is."""
        with self._lock:
            resting = self._state.resting and self._making is not None
            return msgspec.structs.replace(self._state, seconds_left=self._seconds_left(), resting=resting)

    def start(self, wish: FilmWish) -> FilmState:
        """Begin a film. Raise ValueError with a sentence if another one is being made, or this one can't be."""
        folders = [str(self._find(run).resolve()) for run in wish.runs]
        with self._lock:
            if self._making is not None:
                raise ValueError(
                    f"{self._state.name} is being made, and it is one at a time: wait until it is ready, or cancel it"
                )
            if self._closed:
                raise ValueError("the studio is about to end")
            self._discard()
            self._state = FilmState(number=self._state.number)
            try:
                self._home = _Home.made()
                home = self._home.path
                child = self._spawn(Order(wish, folders, str(home / wish.file_name)), home / "log")
            except OSError as error:
                self._discard()
                where = tempfile.gettempdir()
                raise ValueError(f"no film can be made in {where}: {error.strerror or error}") from error
            self._making = making = _Making(home, child)
            self._state = FilmState(state="making", number=self._state.number + 1, wish=wish, name=wish.file_name)
        threading.Thread(target=self._follow, args=(making,), name="film", daemon=True).start()
        making.begun.wait(_PATIENCE)
        found = self.state
        if found.state == "failed":
            raise ValueError(found.reason)
        return found

    def cancel(self) -> FilmState:
        """Give up the film that is being made, or remove the one that is ready."""
        with self._lock:
            if self._making is not None:
                _end(self._making.child)
                self._making = None
                self._state = msgspec.structs.replace(self._state, state="cancelled")
            elif self._state.state == "ready":
                self._state = FilmState(number=self._state.number)
            self._discard()
        return self.state

    def file(self, number: int) -> Path | None:
        """Return the path of a film that is ready, by its number; None where there is no such one."""
        with self._lock:
            ready = self._state.state == "ready" and self._state.number == number and self._home is not None
            return self._home.path / self._state.name if ready and self._home else None

    def close(self) -> None:
        """Make no more films, and remove what there is."""
        with self._lock:
            self._closed = True
        self.cancel()

    def _follow(self, making: _Making) -> None:
        """Take in what the process says until it ends."""
        assert making.child.stdout is not None
        failed = ""
        for line in making.child.stdout:
            with contextlib.suppress(msgspec.DecodeError):
                said = msgspec.json.decode(line, type=Said)
                failed = failed or said.failed
                self._note(making, said)
        status = making.child.wait()
        with self._lock:
            if self._making is making:
                self._making = None
                path = making.home / self._state.name
                if status == 0 and path.is_file():
                    size = path.stat().st_size
                    self._state = msgspec.structs.replace(
                        self._state, state="ready", size=size, done=self._state.frames
                    )
                else:
                    reason = failed or _epitaph(status, making.home / "log")
                    self._state = msgspec.structs.replace(self._state, state="failed", reason=reason)
                    self._discard()
        making.begun.set()

    def _note(self, making: _Making, said: Said) -> None:
        with self._lock:
            if self._making is making and said.frames:
                self._state = msgspec.structs.replace(
                    self._state, frames=said.frames, done=said.done, resting=said.resting
                )
                if said.done and making.first is None:
                    making.first = time.monotonic(), said.done
        if said.frames:
            making.begun.set()

    def _seconds_left(self) -> float | None:
        first, found = self._making.first if self._making else None, self._state
        if first is None or found.done <= first[1]:
            return None
        return round((time.monotonic() - first[0]) / (found.done - first[1]) * (found.frames - found.done), 1)

    def _discard(self) -> None:
        if self._home is not None:
            self._home.remove()
            self._home = None


@dataclass(frozen=True)
class _Home:
    """The folder in which a film is made. The lock in it is ours as long as we live."""

    path: Path
    lock: int

    @classmethod
    def made(cls) -> "_Home":
        """Make the folder, once those are removed that servers have left which were killed. Raise OSError."""
        _sweep()
        path = Path(tempfile.mkdtemp(prefix=_PREFIX))
        lock = None
        try:
            lock = os.open(path / _LOCK, os.O_RDWR | os.O_CREAT, 0o600)
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            if lock is not None:
                os.close(lock)
            shutil.rmtree(path, ignore_errors=True)
            raise
        return cls(path, lock)

    def remove(self) -> None:
        """Remove the folder with all that is in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self.lock)


def _sweep() -> None:
    """Remove the folders of films whose servers are dead, whose locks the kernel has let go of."""
    for home in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):  # in use, or another's
            lock = os.open(home / _LOCK, os.O_RDWR | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if home.lstat().st_uid == os.getuid():
                    shutil.rmtree(home)
            finally:
                os.close(lock)


def _end(child: subprocess.Popen[bytes]) -> None:
    """End a process at once, and what encodes for it: that would go on to write where nothing is to be left."""
    with contextlib.suppress(psutil.Error):
        maker = psutil.Process(child.pid)
        maker.suspend()  # so that it starts no other one
        for encoder in maker.children(recursive=True):
            with contextlib.suppress(psutil.Error):
                encoder.kill()
    child.kill()
    child.wait()


def _epitaph(status: int, log: Path) -> str:
    """Return in a sentence why the process has ended without a film."""
    if -status == getattr(signal, "SIGXCPU", 0):
        most = f"{CPU_SECONDS // 60} minutes of processor time"
        return f"the film took more than {most} and was given up: ask for fewer seconds or a smaller height"
    with contextlib.suppress(OSError):
        lines = log.read_bytes()[-_LOG_BYTES:].decode(errors="replace").strip().splitlines()
        if lines:
            return f"the film can't be made: {lines[-1][:300]}"
    how = f"was killed by signal {-status}, perhaps for want of memory" if status < 0 else f"ended with {status}"
    return f"the process that makes the film {how}"
