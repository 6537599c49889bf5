"""A bundle proved in a process of its own, with limits of time and memory: what its files ask for is not known before.

It is started as `python -P -m studio.export.apart FOLDER EPISODES SECONDS BYTES`, and writes its checks to standard
output as JSON.
"""

import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import msgspec

import studio
from studio.export.archive import read_files, unpack
from studio.export.check import Check
from studio.export.proof import prove

READING_SECONDS = 60
"""CPU time in which the files of a bundle are read and compared; it takes a few seconds."""
EPISODE_SECONDS = 10
"""CPU time that is added for each episode of the policy."""
WALL_FACTOR = 5
"""Factor by which a proof may take longer than its CPU time, on a machine that does other things as well."""
MEMORY_BYTES = 4 << 30


class _Told(msgspec.Struct, frozen=True):
    """A check as it is told by the process; JSON knows no infinity, for which `worst` is None."""

    name: str
    worst: float | None
    allowed: float
    detail: str

    @property
    def check(self) -> Check:
        return Check(self.name, math.inf if self.worst is None else self.worst, self.allowed, self.detail)


def prove_apart(
    files: Mapping[str, bytes], *, episodes: int, seconds: int = READING_SECONDS, memory: int = MEMORY_BYTES
) -> list[Check]:
    """Check a bundle's files as `prove` does, in a process that ends after `seconds` of CPU time and more for episodes,
    and that gets no more than `memory` bytes of address space.

    Whatever happens to that process is a failed check, not an exception; OSError where the files can't be laid out.
    """
    seconds += EPISODE_SECONDS * episodes
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        unpack(files, folder)
        try:
            done = subprocess.run(
                [sys.executable, "-P", "-m", "studio.export.apart", folder, *map(str, (episodes, seconds, memory))],
                capture_output=True, timeout=WALL_FACTOR * seconds, cwd=folder, env=environment(), check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return [Check("the bundle", math.inf, 0.0, f"not read within {WALL_FACTOR * seconds} s: given up")]
    try:
        return [told.check for told in msgspec.json.decode(done.stdout, type=list[_Told])]
    except (ValueError, RecursionError):
        return [Check("the bundle", math.inf, 0.0, _why(done.returncode, done.stderr, seconds))]


def environment() -> dict[str, str]:
    """Return the environment of a process that runs this very code: without the token, and with one thread for BLAS."""
    code = str(Path(studio.__file__).resolve().parents[1])
    others = {name: value for name, value in os.environ.items() if name != "MORPH_TOKEN"}
    paths = [code, *filter(None, [others.get("PYTHONPATH")])]
    return others | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def _why(code: int, said: bytes, seconds: int) -> str:
    """Say why the process that reads a bundle gave no answer."""
    if code == -signal.SIGXCPU:
        return f"reading it takes more than {seconds} s of computing: given up"
    if code < 0:
        return f"a reader was ended by signal {-code} over it"
    last = said.decode("utf-8", "replace").strip().splitlines()[-1:]
    return f"it can't be read: {last[0][:300] if last else f'exit status {code}'}"


def main() -> int:
    """Prove the bundle that is named by the words, under limits; return the exit status."""
    folder, (episodes, seconds, memory) = Path(sys.argv[1]), map(int, sys.argv[2:])
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    told = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what readers print is no answer
    checks = prove(read_files(folder), episodes=episodes)
    facts = [
        _Told(check.name, check.worst if math.isfinite(check.worst) else None, check.allowed, check.detail)
        for check in checks
    ]
    told.write(msgspec.json.encode(facts))
    told.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
