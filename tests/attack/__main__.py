"""All attacks, with small counts or with those of a release: `python -m tests.attack --full`.

Each says how far it is, all come to one table and, with `--out`, to JSON; the exit status is 1 where anything failed.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from tests.attack.api import attack_api
from tests.attack.archives import attack_archives
from tests.attack.crowds import attack_memory, attack_strangers
from tests.attack.frames import attack_frames
from tests.attack.kills import attack_kills
from tests.attack.outcome import Outcome, table, write
from tests.attack.soak import soak

Part = Literal["api", "frames", "archives", "kills", "strangers", "memory", "soak"]
SMALL: dict[str, int] = {
    "api": 300, "frames": 1500, "archives": 10, "kills": 3, "strangers": 100, "memory": 1, "soak": 15,
}  # fmt: skip
FULL: dict[str, int] = {
    "api": 10_000, "frames": 100_000, "archives": 1000, "kills": 100, "strangers": 600, "memory": 3, "soak": 3600,
}  # fmt: skip
"""How much each part tries before a release: cases, frames, archives, kills, connections, rounds, and seconds."""
STEPS_WATCHED = 1_500_000
"""Environment steps of the run that is watched while an hour passes; a shorter soak watches as long as it lasts."""
PARTS: dict[str, Callable[[int, int], Outcome]] = {
    "api": attack_api,
    "frames": attack_frames,
    "archives": attack_archives,
    "kills": attack_kills,
    "strangers": lambda connections, seed: attack_strangers(connections, seed, seconds=connections / 10),
    "memory": attack_memory,
    "soak": lambda seconds, seed: soak(seconds, STEPS_WATCHED, seed),
}


@dataclass(frozen=True)
class Attack:
    """Which attacks, and how much of each."""

    full: bool = False
    """The counts of a release, which take more than two hours; the soak alone takes one."""
    only: tuple[Part, ...] = ()
    """Parts to do, in this order; by default all."""
    count: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Number of what is tried, instead of that of the parts."""
    seed: int = 1
    """Seed of everything that is random."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write the outcome as JSON, after each part."""


def main(asked: Attack) -> int:
    """Do the attacks; return 1 where anything failed."""
    outcomes: list[Outcome] = []
    for name in asked.only or tuple(PARTS):
        count = asked.count or (FULL if asked.full else SMALL)[name]
        print(f"{name}: {count:,}, seed {asked.seed}, from {time.strftime('%H:%M:%S')}", file=sys.stderr, flush=True)
        outcomes.append(PARTS[name](count, asked.seed))
        if asked.out:
            write(asked.out, outcomes)
    print(table(outcomes))
    return int(any(outcome.failed for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Attack, description=__doc__)))
