"""Runs pytest in a folder as often as it is asked, each time in a child that has the slow libraries already.

`python -P tests/nursery.py LIBRARIES`, with the folder as working directory and on PYTHONPATH, reads lines of JSON,
[TESTS, SECONDS], and answers each with [STATUS, SAID]: pytest's exit status, null after so many seconds, and what it
said.
"""

import contextlib
import gc
import importlib
import json
import os
import runpy
import select
import signal
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NoReturn

SAID = "said"
FAILED_TO_RUN = 3
"""What pytest calls an internal error."""


def load(libraries: Iterable[str]) -> None:
    """Import what there is of the libraries; a child that needs another one fails by itself."""
    for name in libraries:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    if len([*Path("/proc/self/task").iterdir()]) > 1:
        raise RuntimeError("an import has started a thread, which no child would have")
    gc.collect()
    gc.freeze()  # a collection in a child would copy every page of it


def run_pytest(folder: Path, tests: Sequence[str]) -> int:
    """Do as `python -m pytest TESTS` does in a folder, of whose packages nothing is loaded; return its exit status."""
    own = {path.stem for path in folder.iterdir()}
    for name in [name for name in sys.modules if name.partition(".")[0] in own]:
        del sys.modules[name]  # what was installed with them may have been run at the start of Python
    sys.meta_path[:] = [finder for finder in sys.meta_path if type(finder).__module__.partition(".")[0] not in own]
    sys.argv = ["pytest", "-xq", "-o", "addopts=", "-p", "no:cacheprovider", "-p", "pytest_timeout", *tests]
    status = 0
    try:
        runpy.run_module("pytest", run_name="__main__", alter_sys=True)
    except SystemExit as end:
        status = int(end.code or 0)
    for name in own & sys.modules.keys():
        place = getattr(sys.modules[name], "__file__", None)
        if place and not Path(place).is_relative_to(folder):
            print(f"{name} was loaded from {place}")
            return FAILED_TO_RUN
    return status


def be_the_child(folder: Path, tests: Sequence[str], temporary: str) -> NoReturn:
    """Run pytest in a session of its own, and end without the interpreter's last steps: they take a second."""
    os.setsid()
    os.environ["TMPDIR"], tempfile.tempdir = temporary, None
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(os.open(Path(temporary) / SAID, os.O_WRONLY | os.O_CREAT), 1)
    os.dup2(1, 2)
    status = FAILED_TO_RUN
    try:
        status = run_pytest(folder, tests)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def in_a_child(folder: Path, tests: Sequence[str], seconds: float) -> tuple[int | None, str]:
    """Return pytest's exit status, negative where a signal has ended it, and its output."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        pid = os.fork()
        if pid == 0:
            be_the_child(folder, tests, temporary)
        child = os.pidfd_open(pid)
        try:
            ended = bool(select.select([child], [], [], seconds)[0])
        finally:
            os.close(child)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)  # with whatever it has started
            status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        return (status, (Path(temporary) / SAID).read_text()) if ended else (None, f"not done after {seconds:g} s")


def main() -> None:
    """Answer until nobody asks any more."""
    load(sys.argv[1:])
    for line in sys.stdin:
        tests, seconds = json.loads(line)
        print(json.dumps(in_a_child(Path.cwd(), tests, seconds)), flush=True)


if __name__ == "__main__":
    main()
