"""`morph-studio export`: write a design as MJCF and URDF that agree with each other."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from studio.cli.arguments import RunName, RunsArguments, UsageError, parse
from studio.cli.choice import check_design, open_run

DesignName = Annotated[str, tyro.conf.arg(metavar="best|latest|ITERATION")]


@dataclass(frozen=True)
class ExportArguments(RunsArguments):
    """Write a design as MJCF and URDF, with where it comes from; the files are read back and compared first."""

    run: tyro.conf.Positional[RunName] = tyro.MISSING
    """Name of a run, or the path of its folder."""
    design: DesignName = "best"
    """Which design: the best evaluated one, the latest one, or that of an iteration (0 is the initial one)."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="PATH.zip|DIR")] = None
    """Where to; without it into the exports of the run."""
    formats: Annotated[tuple[str, ...], tyro.conf.arg(metavar="mjcf|urdf")] = ("mjcf", "urdf")
    """What to write; stl, 3mf and glb are to come."""


def main(words: Sequence[str]) -> int:
    arguments = parse(ExportArguments, words, "export")
    from studio.export.bundle import bundle_name, check_formats, write_bundle
    from studio.export.errors import ExportError

    history = open_run(arguments.runs, arguments.run)
    check_design(history, arguments.design)
    try:
        check_formats(arguments.formats)
    except ExportError as error:
        raise UsageError(f"export: {error}") from error
    out = arguments.out or history.folder.exports / bundle_name(history, arguments.design)
    try:
        written = write_bundle(history, arguments.design, out, arguments.formats)
    except ExportError as error:
        print(f"morph-studio: export: {error}", file=sys.stderr)  # noqa: T201
        return 1
    print(written)  # noqa: T201
    return 0
