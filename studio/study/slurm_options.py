"""What Slurm is asked for, each with what is allowed: partition, time limit, account, features, memory, cap."""

import re
from dataclasses import dataclass
from typing import Annotated

import tyro

MOST_AT_ONCE = 1000
"""Largest cap that can be asked for."""
SHORTEST_LIMIT = 300
"""Smallest time limit in seconds: Slurm may warn a minute early, and a trainer needs time to load and to learn."""
WARNING_SECONDS = 120
"""Seconds before the time limit at which a trainer is told to save; a quarter of the limit if that is shorter."""


@dataclass(frozen=True)
class SlurmOptions:
    """What Slurm is asked for; what is not given, the cluster's own defaults decide."""

    partition: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Slurm partition to run in; by default the cluster's."""
    time: Annotated[str | None, tyro.conf.arg(metavar="LIMIT")] = None
    """Time limit of a task as Slurm writes it (90, 12:00:00, 2-00:00:00); a run that reaches it is queued once more."""
    account: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Slurm account that is charged; by default the user's."""
    constraint: Annotated[str | None, tyro.conf.arg(metavar="FEATURES")] = None
    """Features that a node must have, such as avx512: bitwise resumption needs one kind of processor."""
    mem: Annotated[str, tyro.conf.arg(metavar="SIZE")] = "2G"
    """Memory of a task, as a number with K, M, G or T; 0 for all that a node has."""
    parallel: Annotated[int, tyro.conf.arg(metavar="N")] = 32
    """Largest number of runs at once."""

    def __post_init__(self) -> None:
        """Raise ValueError that says what is allowed."""
        for name in ("partition", "account", "constraint"):
            value = getattr(self, name)
            if value is not None and not (value.isprintable() and value.strip() and len(value) <= 200):
                raise ValueError(f"{name} must be printable, not empty and at most 200 characters long")
        if self.time is not None:
            seconds_of(self.time)
        if not re.fullmatch(r"\d{1,9}[KMGT]?", self.mem):
            raise ValueError(f'mem must be a number with K, M, G or T, such as 2G, not "{self.mem[:40]}"')
        if not 1 <= self.parallel <= MOST_AT_ONCE:
            raise ValueError(f"parallel must be a whole number from 1 to {MOST_AT_ONCE}, not {self.parallel}")

    def words(self) -> list[str]:
        """Return the options of sbatch."""
        given = {name: getattr(self, name) for name in ("partition", "time", "account", "constraint", "mem")}
        warning = WARNING_SECONDS if self.time is None else min(WARNING_SECONDS, seconds_of(self.time) // 4)
        # B: to the job script alone, which then tells the trainer; without it every process of the job gets the signal.
        return [f"--{name}={value}" for name, value in given.items() if value is not None] + [
            f"--signal=B:USR1@{warning}"
        ]


_TIME = re.compile(
    r"(?:(?P<days>\d{1,4})-(?P<dh>\d{1,2})(?::(?P<dm>\d{1,2})(?::(?P<ds>\d{1,2}))?)?"
    r"|(?:(?P<h>\d{1,5}):)?(?P<m>\d{1,6}):(?P<s>\d{1,2})|(?P<minutes>\d{1,6}))"
)


def seconds_of(limit: str) -> int:
    """Return a time limit in seconds; ValueError that says what is allowed if it can't be read or is too short."""
    match = _TIME.fullmatch(limit)
    part = {name: int(text) for name, text in match.groupdict(default="0").items()} if match else {}
    seconds = sum(
        part.get(name, 0) * unit
        for unit, names in ((86400, ("days",)), (3600, ("dh", "h")), (60, ("dm", "m", "minutes")), (1, ("ds", "s")))
        for name in names
    )
    if seconds < SHORTEST_LIMIT:
        raise ValueError(
            "time must be at least 5 minutes, as MINUTES, HOURS:MINUTES:SECONDS or DAYS-HOURS:MINUTES:SECONDS, "
            f'not "{limit[:40]}"'
        )
    return seconds
