"""The report of the studio's folder of runs, written anew by a process of its own when its runs have changed.

The server loads none of what reports are made with, and keeps the report in a folder of its own: nobody's study is
written to because somebody looks at it.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import msgspec

import morph_core
from morph_core.run_folder import STUDY
from studio.study.plan import StudyError, read_study

EVERY = 20.0
"""Fewest seconds between the starts of two processes."""
SHARE = 0.3
"""Largest share of the time in which such a process is at work, so that the runs keep the processor."""

Fingerprint = tuple[tuple[str, int, int], ...]


class ReportState(msgspec.Struct, frozen=True, kw_only=True):
    """Whether the folder of runs is a study, and how old its report is."""

    state: Literal["no study", "writing", "ready", "failed"]
    """"writing" until there is a first report; "failed" if there is none and the last attempt came to nothing."""
    reason: str = ""
    """Why there is none, or why the newest attempt failed."""
    version: int = 0
    """Number of the report that is served: it rises by one with each; 0 before the first."""
    written: float | None = None
    """When the report that is served was begun, in seconds since the epoch."""
    writing: bool = False
    """Whether a newer one is being written."""


def spawn_writer(directory: Path, into: Path) -> subprocess.Popen[bytes]:
    """Start the process that writes the report of `directory` into the folder `into`."""
    code = str(Path(morph_core.__file__).resolve().parents[1])
    environment = {name: value for name, value in os.environ.items() if name != "MORPH_TOKEN"}
    environment |= {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    environment["PYTHONPATH"] = os.pathsep.join(p for p in (code, environment.get("PYTHONPATH")) if p)
    command = [sys.executable, "-P", "-m", "studio.study.report", str(directory.resolve()), str(into)]
    return subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment
    )


class LiveReport:
    """The newest report of one folder of runs. It is thread-safe, and works only while someone asks for it."""

    def __init__(self, runs: Path, spawn: Callable[[Path, Path], subprocess.Popen[bytes]] = spawn_writer) -> None:
        self._runs, self._spawn = runs, spawn
        self._lock = threading.Lock()
        self._home: Path | None = None
        self._child: subprocess.Popen[bytes] | None = None
        self._version, self._begun, self._took = 0, 0.0, 0.0
        self._started = 0.0
        self._written: float | None = None
        self._seen: Fingerprint | None = None
        self._reason = ""

    def state(self) -> ReportState:
        """Return how things stand, and begin a new report if one is due."""
        with self._lock:
            self._collect()
            try:
                seen = self._fingerprint()
            except StudyError as error:
                return ReportState(state="no study", reason=str(error))
            if self._child is None and seen != self._seen and self._is_due():
                self._begin(seen)
            known = "ready" if self._version else "failed" if self._reason and not self._child else "writing"
            return ReportState(
                state=known, reason=self._reason, version=self._version, written=self._written,
                writing=self._child is not None,
            )  # fmt: skip

    def file(self, name: str) -> Path | None:
        """Return the path of a file of the newest report, or None if it has none of that name."""
        with self._lock:
            if not self._version or self._home is None:
                return None
            folder = (self._home / str(self._version)).resolve()
        path = (folder / name).resolve()
        return path if path.is_file() and path.is_relative_to(folder) else None

    def close(self) -> None:
        """End the process at work, and remove what was written."""
        with self._lock:
            if self._child is not None:
                self._child.kill()
                self._child.communicate()
                self._child = None
            if self._home is not None:
                shutil.rmtree(self._home, ignore_errors=True)
                self._home = None

    def _is_due(self) -> bool:
        return time.monotonic() - self._begun >= max(EVERY, self._took / SHARE) or not self._begun

    def _begin(self, seen: Fingerprint) -> None:
        if self._home is None:
            self._home = Path(tempfile.mkdtemp(prefix="morph-study-"))
        self._seen, self._begun, self._started = seen, time.monotonic(), time.time()
        self._child = self._spawn(self._runs, self._home / str(self._version + 1))

    def _collect(self) -> None:
        """Take over what a process has written that has ended."""
        if self._child is None or self._child.poll() is None or self._home is None:
            return
        _, said = self._child.communicate()
        failed, self._child = self._child.returncode != 0, None
        self._took = time.monotonic() - self._begun
        if failed:
            lines = said.decode(errors="replace").strip().splitlines()
            self._reason = lines[-1] if lines else "the report's process was killed"
            shutil.rmtree(self._home / str(self._version + 1), ignore_errors=True)
            return
        self._version, self._written, self._reason = self._version + 1, self._started, ""
        shutil.rmtree(self._home / str(self._version - 2), ignore_errors=True)  # the last but one: a page may read it

    def _fingerprint(self) -> Fingerprint:
        """Return what changes whenever a run or the plan does; raise StudyError if there is no study."""
        study = read_study(self._runs)
        logs = (self._runs / planned.run / "events.jsonl" for planned in study.runs)
        found = []
        for path in (self._runs / STUDY, *logs):
            try:
                status = path.stat()
            except OSError:
                continue
            found.append((path.parent.name, status.st_size, status.st_mtime_ns))
        return tuple(found)
