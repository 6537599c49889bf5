"""Programs in processes of their own that need not load torch first: a server that has loaded it forks them."""

import importlib
import io
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from morph_core.run_folder import RunFolder

_FORK = multiprocessing.get_context("forkserver")
_FORK.set_forkserver_preload(
    [
        *("morph_core.train", "morph_core.evaluate", "studio.cli.train", "studio.cli.export", "studio.export.apart"),
        *("cma", "torch._dynamo"),  # the search imports one, and the first optimiser the other
    ]
)


def _run(module: str, words: Sequence[str], heard: str, into: Path, cwd: Path, environment: Mapping[str, str]) -> None:
    """Be `python -m MODULE WORDS` in a new process that hears `heard`; output and errors go to two files."""
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:0] = [place for place in environment.get("PYTHONPATH", "").split(os.pathsep) if place]
    sys.stdin = io.StringIO(heard)
    for descriptor, name in ((1, "output"), (2, "errors")):
        os.dup2(os.open(into / name, os.O_WRONLY | os.O_CREAT), descriptor)
    sys.stdout.reconfigure(line_buffering=True)  # pyright: ignore[reportAttributeAccessIssue]
    sys.argv = [module, *words]
    sys.exit(importlib.import_module(module).main())


class Forked:
    """A program at work: a module with `main()`, started with the words of its command line."""

    def __init__(
        self,
        module: str,
        *words: str,
        heard: str = "",
        cwd: Path | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._said = tempfile.TemporaryDirectory()
        places = Path(self._said.name), cwd or Path.cwd()
        arguments = module, words, heard, *places, dict(os.environ if environment is None else environment)
        self._process = _FORK.Process(target=_run, args=arguments)
        self._process.start()
        assert self._process.pid is not None
        self.pid: int = self._process.pid

    def wait(self, seconds: float = 200) -> int:
        """Wait for its end and return its exit status, negative where a signal has ended it."""
        self._process.join(seconds)
        if self._process.exitcode is None:
            self.send_signal(signal.SIGKILL)
            raise TimeoutError(f"it still ran after {seconds} s")
        return self._process.exitcode

    def said(self, name: str) -> str:
        """Return what it has said so far on "output" or "errors"."""
        path = Path(self._said.name) / name
        return path.read_text() if path.exists() else ""  # not yet, where it has only just been started

    def send_signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        os.kill(self.pid, number)


def trainer(folder: RunFolder, *words: str) -> Forked:
    """Start the trainer of a run folder."""
    return Forked("morph_core.train", "--run", str(folder.path), *words)


def python(program: str, environment: Mapping[str, str] | None = None) -> Forked:
    """Start a program in Python."""
    return Forked("tests.forked", heard=program, environment=environment)


def main() -> None:
    """Run the program on standard input."""
    exec(sys.stdin.read(), {"__name__": "__main__"})


def morph_studio(
    *words: str, cwd: Path | None = None, environment: Mapping[str, str] | None = None, seconds: float = 120
) -> subprocess.CompletedProcess[str]:
    """Run `morph-studio WORDS` to its end."""
    command = Forked("studio.cli", *words, cwd=cwd, environment=environment)
    status = command.wait(seconds)
    return subprocess.CompletedProcess(words, status, command.said("output"), command.said("errors"))
