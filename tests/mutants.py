"""Does a test fail where a line is wrong? `python -m tests.mutants` breaks them one by one, in a copy of the tree.

A survivor is a line that no test holds. The list is in `tests/mutations.py`; to be run as a whole before a release.
"""

import argparse
import compileall
import contextlib
import fnmatch
import itertools
import json
import os
import py_compile
import queue
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, TypeVar

from tests.mutations import MUTANTS, Mutant

ROOT = Path(__file__).parents[1]
SECONDS = 300
"""A run of tests that takes longer hangs: that is noticed, too."""
LIBRARIES = (
    *("pytest", "hypothesis", "numpy", "scipy.stats", "torch", "torch._dynamo", "cma", "mujoco", "msgspec", "psutil"),
    *("starlette.testclient", "fastapi", "uvicorn", "httpx", "websockets.sync.client", "rich.console", "tyro"),
    *("viser", "trimesh", "lxml.etree", "networkx", "manifold3d", "safetensors.torch", "zstandard", "yourdfpy"),
    *("matplotlib.pyplot", "jinja2", "PIL.Image", "imageio_ffmpeg"),
)
"""Not Gymnasium, whose import our packages watch for, and none that starts threads, which a child would lack."""
NOT_COPIED = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "dist", "typings")

T = TypeVar("T")
R = TypeVar("R")
Verdict = Literal["killed", "SURVIVED", "STALE", "BROKEN"]
"""BROKEN: the named tests could not be run with it, so that nothing is known of it."""


def stale(mutant: Mutant, root: Path) -> str | None:
    """Return why a mutant no longer fits the tree; None where its text is found once and its tests exist."""
    file = root / mutant.file
    found = file.read_text().count(mutant.old) if file.is_file() else 0
    if found != 1:
        return f"{mutant.old!r} stands {found} times in {mutant.file}; it must stand there once"
    for test in mutant.tests:
        path, *names = test.partition("[")[0].split("::")
        text = (root / path).read_text() if (root / path).is_file() else None
        if text is None or not all(re.search(rf"^\s*(def|class) {re.escape(name)}\b", text, re.M) for name in names):
            return f"there is no test {test}"
    return None


class Copy:
    """A copy of the tree, and a process that runs its tests in children which need not load the libraries first."""

    def __init__(self, root: Path, path: Path, libraries: Sequence[str] = ()) -> None:
        self.path = shutil.copytree(root, path, ignore=NOT_COPIED)
        compileall.compile_dir(path, quiet=2, invalidation_mode=py_compile.PycInvalidationMode.CHECKED_HASH)
        environment = os.environ | {
            "PYTHONPATH": str(path),
            "PYTHONDONTWRITEBYTECODE": "1",  # the time and size of a source may be those of the mutant before
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # they take longer to load than most of these tests to run
            "OMP_NUM_THREADS": "1",
        }
        command = [sys.executable, "-P", str(ROOT / "tests/nursery.py"), *libraries]
        pipe = subprocess.PIPE
        self._nursery = subprocess.Popen(command, cwd=path, env=environment, stdin=pipe, stdout=pipe, text=True)

    def run_tests(self, tests: Sequence[str], seconds: float = SECONDS) -> tuple[int | None, str]:
        """Return pytest's exit status, None where it hangs, and what it said."""
        assert self._nursery.stdin
        assert self._nursery.stdout
        print(json.dumps([tests, seconds]), file=self._nursery.stdin, flush=True)
        if not (answer := self._nursery.stdout.readline()):
            raise RuntimeError("the process that runs the tests has ended")
        status, said = json.loads(answer)
        return status, said

    def close(self) -> None:
        """End the process; the copy stays."""
        self._nursery.communicate()


def verdict(mutant: Mutant, tree: Copy) -> tuple[Verdict, str]:
    """Return what becomes of a mutant in a copy of the tree, which is left as it was."""
    if reason := stale(mutant, tree.path):
        return "STALE", reason
    file = tree.path / mutant.file
    text = file.read_text()
    file.write_text(text.replace(mutant.old, mutant.new))
    try:
        status, said = tree.run_tests(mutant.tests)
    finally:
        file.write_text(text)
    if status == 0:
        return "SURVIVED", ""
    return ("killed", "") if status in (1, None) else ("BROKEN", said.strip().rpartition("\n")[2])


class Copies:
    """Copies of a tree, at work on one thing each."""

    def __init__(self, root: Path, folder: Path, count: int, libraries: Sequence[str]) -> None:
        self._all = [Copy(root, folder / str(number), libraries) for number in range(count)]
        self._free: queue.SimpleQueue[Copy] = queue.SimpleQueue()
        for copy in self._all:
            self._free.put(copy)
        self._pool = ThreadPoolExecutor(count)

    def map(self, work: Callable[[Copy, T], R], things: Iterable[T]) -> Iterator[R]:
        """Yield what comes of each thing, in their order."""

        def on_a_free_one(thing: T) -> R:
            copy = self._free.get()
            try:
                return work(copy, thing)
            finally:
                self._free.put(copy)

        return self._pool.map(on_a_free_one, things)

    def close(self) -> None:
        """Begin nothing more, and end the processes."""
        self._pool.shutdown(cancel_futures=True)
        for copy in self._all:
            copy.close()


def chosen(mutants: Sequence[Mutant], only: str | None, sample: int | None, seed: int | None) -> list[Mutant]:
    """Return the mutants whose file, text or tests fit the pattern, or a random sample of them."""
    fitting = [m for m in mutants if only is None or any(fnmatch.fnmatch(t, f"*{only}*") for t in (m.file, m.old))]
    return fitting if sample is None else random.Random(seed).sample(fitting, min(sample, len(fitting)))


def by_file(mutants: Iterable[Mutant]) -> list[list[str]]:
    """Return the tests that mutants name, those of one file together."""
    named = sorted({test for mutant in mutants for test in mutant.tests})
    return [list(tests) for _, tests in itertools.groupby(named, lambda test: test.partition("::")[0])]


def judge(mutants: Sequence[Mutant], root: Path = ROOT, jobs: int = 1, libraries: Sequence[str] = LIBRARIES) -> int:
    """Print what becomes of each mutant, then the survivors and the counts; return 0 if all were killed."""
    not_killed: list[str] = []
    counts: Counter[Verdict] = Counter()
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.closing(Copies(root, Path(folder), jobs, libraries)) as copies,
    ):
        named = by_file(mutant for mutant in mutants if not stale(mutant, root))
        for status, said in copies.map(Copy.run_tests, named):
            if status != 0:
                print(said, "Without any mutant the named tests fail already: that is to be mended first.", sep="\n")
                return 1
        for mutant, (word, reason) in zip(mutants, copies.map(lambda c, m: verdict(m, c), mutants), strict=True):
            counts[word] += 1
            line = f"{word:8}  {mutant}" + (f"\n          {reason}" if reason else "")
            print(line, flush=True)
            not_killed += [] if word == "killed" else [line]
    print("", *not_killed, ", ".join(f"{count} {word}" for word, count in counts.items()), sep="\n")
    return 1 if not_killed else 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the arguments; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--sample", type=int, metavar="N", help="so many of them, chosen at random")
    parser.add_argument("--seed", type=int, help="of the choice; by default it is another one each time")
    parser.add_argument("--only", metavar="PATTERN", help="those whose file or text it is part of (* and ? as usual)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="copies of the tree to work in at once")
    options = parser.parse_args(arguments)
    mutants = chosen(MUTANTS, options.only, options.sample, options.seed)
    if not mutants:
        parser.error(f'no mutant has "{options.only}" in its file or text')
    return judge(mutants, jobs=options.jobs)


if __name__ == "__main__":
    sys.exit(main())
