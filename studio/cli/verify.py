"""`morph-studio verify`: check an export: one robot in every file, sound parts, and a policy as able as promised."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from studio import limits
from studio.cli.arguments import Count, UsageError, parse
from studio.cli.output import write_json

NOT_PROVED = (
    "Not proved: who made the bundle and when (its digests come with it), colours and pictures, STEP files, what the "
    "policy learned beyond its success, and what README.txt, report.html, BOM.csv, servos.json and the tables of "
    "plates say beyond pieces and their sizes."
)
"""What a bundle on which all checks agree may be wrong in all the same."""


@dataclass(frozen=True)
class VerifyArguments:
    """Read an export back and compare all its files; exit with 1 if anything disagrees."""

    bundle: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="BUNDLE")] = tyro.MISSING
    """Export to check: the zip or the folder that morph-studio export wrote."""
    episodes: Count = 128
    """Number of episodes in which the policy is run on the files; 0 leaves this out."""
    every: bool = False
    """Show every comparison instead of one line for each file."""
    json: bool = False
    """Print one JSON document and nothing else."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio verify` with these words; return the exit status, 1 if anything disagrees."""
    arguments = parse(VerifyArguments, words, "verify")
    try:
        limits.whole("--episodes", arguments.episodes, 0, limits.MAX_FINAL_EPISODES)
    except ValueError as error:
        raise UsageError(f"verify: {error}") from error
    from studio.export.apart import prove_apart
    from studio.export.archive import read_files
    from studio.export.errors import ExportError

    try:
        checks = prove_apart(read_files(arguments.bundle), episodes=arguments.episodes)
    except (ExportError, OSError) as error:
        raise UsageError(f"verify: {error}") from error
    passed = all(check.passed for check in checks)
    if arguments.json:
        write_json({"bundle": str(arguments.bundle), "passed": passed, "checks": [c.facts for c in checks]})
    else:
        _print(checks, arguments.every)
    return 0 if passed else 1


def _print(checks: Sequence, every: bool) -> None:
    from rich.table import Table
    from rich.text import Text

    from studio.cli.terminal import make_console

    table = Table(box=None, pad_edge=False)
    for heading in ("", "file", "compared", "largest difference", "allowed"):
        table.add_column(heading, overflow="fold")
    for subject, group in _grouped(checks).items():
        failed = [check for check in group if not check.passed]
        if failed or every:
            rows = group if every else failed
            for check in rows:
                mark = Text("ok", "green") if check.passed else Text("FAILS", "bold red")
                what = check.name.removeprefix(f"{subject}: ") + (f" ({check.detail})" if check.detail else "")
                table.add_row(mark, Text(subject), Text(what), f"{check.worst:.2g}", f"{check.allowed:.2g}")
        else:
            said = next((check.detail for check in group if len(group) == 1 and check.detail), "")
            worst = max(group, key=lambda check: check.worst / max(check.allowed, 1e-300))
            table.add_row(
                Text("ok", "green"), Text(subject), Text(said or f"{len(group)} comparisons"), f"{worst.worst:.2g}",
                f"{worst.allowed:.2g}",
            )  # fmt: skip
    console = make_console()
    console.print(table)
    failed = sum(not check.passed for check in checks)
    console.print(Text(f"{failed} of {len(checks)} checks fail" if failed else f"all {len(checks)} checks agree"))
    console.print(Text(NOT_PROVED, "dim"))


def _grouped(checks: Sequence) -> dict[str, list]:
    groups: dict[str, list] = {}
    for check in checks:
        groups.setdefault(check.name.split(": ")[0], []).append(check)
    return groups
