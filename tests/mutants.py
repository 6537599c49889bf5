"""Does a test fail where a line is wrong? `python -m tests.mutants` breaks them one by one, in a copy of the tree.

A survivor is a line that no test holds. The list is in `tests/mutations.py`; to be run as a whole before a release.
"""

import argparse
import contextlib
import fnmatch
import os
import queue
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

from tests.mutations import MUTANTS, Mutant

ROOT = Path(__file__).parents[1]
SECONDS = 300
"""A run of tests that takes longer hangs: that is noticed, too."""
NOT_COPIED = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "dist", "typings")

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


def run_tests(tree: Path, tests: Sequence[str]) -> tuple[int | None, str]:
    """Return pytest's exit status in a tree, None where it hangs, and what it said."""
    environment = os.environ | {
        "PYTHONPATH": str(tree),
        "PYTHONDONTWRITEBYTECODE": "1",  # the time and size of a source may be those of the mutant before
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # they take longer to load than most of these tests to run
        "OMP_NUM_THREADS": "1",
    }
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-o",
        "addopts=",
        "-p",
        "no:cacheprovider",
        "-p",
        "pytest_timeout",
        *tests,
    ]
    try:
        ended = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return None, f"not done after {SECONDS} s"
    return ended.returncode, ended.stdout


def verdict(mutant: Mutant, tree: Path) -> tuple[Verdict, str]:
    """Return what becomes of a mutant in a copy of the tree, which is left as it was."""
    if reason := stale(mutant, tree):
        return "STALE", reason
    file = tree / mutant.file
    text = file.read_text()
    file.write_text(text.replace(mutant.old, mutant.new))
    try:
        status, said = run_tests(tree, mutant.tests)
    finally:
        file.write_text(text)
    if status == 0:
        return "SURVIVED", ""
    return ("killed", "") if status in (1, None) else ("BROKEN", said.strip().rpartition("\n")[2])


@contextlib.contextmanager
def copies(root: Path, count: int) -> Iterator["queue.SimpleQueue[Path]"]:
    """Give copies of the tree, to be taken and put back."""
    trees: queue.SimpleQueue[Path] = queue.SimpleQueue()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(count):
            trees.put(shutil.copytree(root, Path(folder) / str(number), ignore=NOT_COPIED))
        yield trees


def chosen(mutants: Sequence[Mutant], only: str | None, sample: int | None, seed: int | None) -> list[Mutant]:
    """Return the mutants whose file, text or tests fit the pattern, or a random sample of them."""
    fitting = [m for m in mutants if only is None or any(fnmatch.fnmatch(t, f"*{only}*") for t in (m.file, m.old))]
    return fitting if sample is None else random.Random(seed).sample(fitting, min(sample, len(fitting)))


def judge(mutants: Sequence[Mutant], root: Path = ROOT, jobs: int = 1) -> int:
    """Print what becomes of each mutant, then the survivors and the counts; return 0 if all were killed."""
    not_killed: list[str] = []
    counts: Counter[Verdict] = Counter()
    with copies(root, jobs) as trees, ThreadPoolExecutor(jobs) as pool:

        def ask(mutant: Mutant) -> tuple[Verdict, str]:
            tree = trees.get()
            try:
                return verdict(mutant, tree)
            finally:
                trees.put(tree)

        first = trees.get()
        named = sorted({test for m in mutants if not stale(m, first) for test in m.tests})
        status, said = run_tests(first, named) if named else (0, "")
        trees.put(first)
        if status != 0:
            print(said, "Without any mutant the named tests fail already: that is to be mended first.", sep="\n")
            return 1
        for mutant, (word, reason) in zip(mutants, pool.map(ask, mutants), strict=True):
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
