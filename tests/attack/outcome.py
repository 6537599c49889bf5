"""What an attack came to: how much was tried, what was measured, and every fault; on the terminal and as JSON."""

import json
import platform
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

FAULTS_KEPT = 50
"""Largest number of faults that are kept in words; all are counted."""


@dataclass
class Outcome:
    """What one attack came to so far; it holds where nothing failed."""

    part: str
    wanted: int
    unit: str
    """What is counted, in the plural."""
    seed: int
    tried: int = 0
    failed: int = 0
    faults: list[str] = field(default_factory=list)
    figures: dict[str, float | str] = field(default_factory=dict)
    seconds: float = 0.0
    quiet: bool = False
    _began: float = field(default_factory=time.monotonic, repr=False)
    _told: float = 0.0

    def add(self, count: int = 1) -> None:
        """Count what was tried, and print how far it is, at most every 2 seconds on a terminal and 30 elsewhere."""
        self.tried += count
        self.seconds = time.monotonic() - self._began
        every = 2.0 if sys.stderr.isatty() else 30.0
        if not self.quiet and time.monotonic() - self._told > every:
            self._told = time.monotonic()
            print(f"{self.line()}, {self.seconds:.0f} s", file=sys.stderr, flush=True)

    def fault(self, what: str) -> None:
        """Note something that must not happen."""
        self.failed += 1
        if self.failed <= FAULTS_KEPT:
            self.faults.append(what)
            if not self.quiet:
                print(f"{self.part}: {what}"[:300], file=sys.stderr, flush=True)

    def line(self) -> str:
        """Return how far it is."""
        return f"{self.part}: {self.tried:,} of {self.wanted:,} {self.unit}, {self.failed} failed"

    def end(self) -> "Outcome":
        """Note the time that it took, and that something is missing where too little was tried."""
        self.seconds = time.monotonic() - self._began
        if self.tried < self.wanted:
            self.fault(f"only {self.tried:,} of {self.wanted:,} {self.unit} were tried")
        return self


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the outcomes as a table of Markdown, with the faults in words below."""
    lines = ["| attack | tried | failed | seconds | figures |", "|---|---|---|---|---|"]
    faults: list[str] = []
    for outcome in outcomes:
        figures = "; ".join(f"{name} {_short(value)}" for name, value in outcome.figures.items())
        tried = f"{outcome.tried:,} {outcome.unit}"
        lines.append(f"| {outcome.part} | {tried} | {outcome.failed} | {outcome.seconds:.0f} | {figures} |")
        faults += [f"{outcome.part}: {fault}" for fault in outcome.faults]
    return "\n".join(lines + faults)


def write(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write the outcomes as JSON, with what they were measured on."""
    rows = [
        {name: value for name, value in asdict(o).items() if name not in ("quiet", "_began", "_told")} for o in outcomes
    ]
    machine = {"python": platform.python_version(), "machine": platform.machine(), "system": platform.system()}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"on": machine, "attacks": rows}, indent=1) + "\n")


def _short(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"
