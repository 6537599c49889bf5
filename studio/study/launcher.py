"""What a launcher is: whatever gives the runs of a study their trainers, on this machine or on a cluster."""

import shlex
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import msgspec

from morph_core import inside
from morph_core.run_folder import LAUNCH, SMALL_BYTES


@dataclass(frozen=True)
class Place:
    """Where a launcher has a run, as it knows it."""

    where: str = ""
    """Words for where its trainer works, such as "slot 2 of this machine"; empty while there is none."""
    why: str = ""
    """Words for why it waits, or why it was given up; empty where there is nothing to say."""
    given_up: bool = False
    """Whether the launcher will start it no more by itself."""


class Launcher(ABC):
    """Gives runs their trainers. The run folders are the truth of what is done; a launcher is asked only where a run
    is and why it waits. `directory` is the study's folder, `runs` are names of run folders in it.
    """

    name: ClassVar[str]
    """Name that chooses the launcher on the command line."""
    stays: ClassVar[bool]
    """Whether the runs go on when the process that submitted them ends."""

    slots: int
    """Number of runs at a time."""

    def check(self) -> None:
        """Raise ValueError with the reason, and what to do, where this launcher can't be used. Nothing is written."""
        return

    @abstractmethod
    def submit(self, directory: Path, runs: Sequence[str]) -> None:
        """Take on runs that are not finished. A run that is taken on already stays as it is."""

    def tend(self, directory: Path) -> None:
        """Do what has to be done again and again; called about twice a second while the runs are followed."""
        return

    @abstractmethod
    def states(self, directory: Path, runs: Sequence[str]) -> Mapping[str, Place]:
        """Return what is known of these runs; one that is not known is left out."""

    @abstractmethod
    def cancel(self, directory: Path, runs: Sequence[str]) -> None:
        """Let runs start no more, and stop their trainers, which save a checkpoint."""

    @abstractmethod
    def requeue(self, directory: Path, runs: Sequence[str]) -> None:
        """Queue runs once more that were cancelled or given up."""

    def leave(self, directory: Path, at_once: bool = False) -> str:
        """Begin to end what can't go on without this process, and return a sentence on what becomes of the runs."""
        return "the runs go on without this process"

    def working(self, directory: Path) -> int:
        """Return how many trainers can't go on without this process."""
        return 0


def launcher_of(path: Path) -> str:
    """Return the name of the launcher that has a run in its hands; empty for none."""
    try:
        found = msgspec.json.decode(inside.read(path, LAUNCH, SMALL_BYTES), type=dict[str, object])
    except (OSError, ValueError, RecursionError):
        return ""
    return str(found.get("launcher", ""))


def check_hands(directory: Path, runs: Sequence[str], launcher: str) -> None:
    """Raise ValueError that says what is allowed where a run is in the hands of another launcher than this one."""
    for run in runs:
        if (other := launcher_of(directory / run)) not in ("", launcher):
            raise ValueError(
                f"{run} is in the hands of the launcher {other}: go on with --launcher {other}, or cancel it first: "
                f"morph-studio study --cancel {shlex.quote(str(directory))}"
            )
