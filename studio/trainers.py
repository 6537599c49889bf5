"""Trainer processes: each a session of its own, so that a run outlives the server."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import morph_core
from morph_core import inside
from morph_core.run_folder import RunFolder

RESERVE_DELAY = 10.0
"""Seconds between a start and the loading of the next trainer, so that the new run has the processor first."""


def spawn_trainer(
    folder: RunFolder, *, further: int | None = None, from_start: bool = False, held: Sequence[int] = ()
) -> subprocess.Popen[bytes]:
    """Start the trainer of a run as a process of its own; it inherits the file descriptors `held`, and so the locks."""
    path = folder.path.resolve()
    words = ["--run", str(path)]
    if further is not None:
        words += ["--further", str(further)]
    if from_start:
        words.append("--from-start")
    with os.fdopen(inside.open_plain(path, "trainer.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND), "ab") as log:
        return _popen(words, stdin=subprocess.DEVNULL, output=log, cwd=path, held=held)


class Reserve:
    """One trainer in reserve with everything loaded, which saves seconds between Start and the first iteration."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ready: subprocess.Popen[bytes] | None = None
        self._timer: threading.Timer | None = None
        self._closed = False

    def load(self) -> None:
        """Load a trainer into reserve, unless one is there."""
        with self._lock:
            if not self._closed and (self._ready is None or self._ready.poll() is not None):
                self._ready = _popen(["--standby"], stdin=subprocess.PIPE, output=subprocess.DEVNULL, cwd=None)

    def spawn(
        self, folder: RunFolder, *, further: int | None = None, from_start: bool = False
    ) -> subprocess.Popen[bytes]:
        """Start the trainer of a run: the one in reserve, or a new one if there is none."""
        with self._lock:
            trainer, self._ready = self._ready, None
            if self._timer is None or not self._timer.is_alive():
                self._timer = threading.Timer(RESERVE_DELAY, self.load)
                self._timer.daemon = True
                self._timer.start()
        if trainer is not None and trainer.stdin is not None:
            order = {"run": str(folder.path.resolve()), "further": further, "from_start": from_start}
            try:
                trainer.stdin.write(json.dumps(order).encode() + b"\n")
                trainer.stdin.close()
            except OSError:
                trainer.wait()
            else:
                return trainer
        return spawn_trainer(folder, further=further, from_start=from_start)

    def close(self) -> None:
        """End the trainer in reserve; trainers at work go on."""
        with self._lock:
            self._closed = True
            if self._timer is not None:
                self._timer.cancel()
            if self._ready is not None and self._ready.stdin is not None:
                self._ready.stdin.close()
                self._ready.terminate()
                self._ready.wait()


def trainer_command(*words: str) -> list[str]:
    """Return the command of a trainer with these words after it."""
    # -P: code that lies in a run folder from elsewhere must not be imported.
    return [sys.executable, "-P", "-m", "morph_core.train", *words]


def trainer_environment() -> dict[str, str]:
    """Return the environment of a trainer: one thread, this code, words in UTF-8, and no token."""
    code = str(Path(morph_core.__file__).resolve().parents[1])
    environment = {name: value for name, value in os.environ.items() if name != "MORPH_TOKEN"}
    environment |= {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    environment["PYTHONIOENCODING"] = "utf-8"
    environment["PYTHONPATH"] = os.pathsep.join(p for p in (code, environment.get("PYTHONPATH")) if p)
    return environment


def _popen(
    words: list[str], *, stdin: int, output: int | IO[bytes], cwd: Path | None, held: Sequence[int] = ()
) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        trainer_command(*words), stdin=stdin, stdout=output, stderr=output, cwd=cwd, env=trainer_environment(),
        start_new_session=True, pass_fds=held,
    )  # fmt: skip
