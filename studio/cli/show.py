"""`morph-studio show`: write one HTML file in which an exported hand runs live, without a network."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from studio.cli.arguments import RunName, RunsArguments, UsageError, parse
from studio.cli.choice import check_design, open_run
from studio.cli.export import DesignName


@dataclass(frozen=True)
class ShowArguments(RunsArguments):
    """Write one HTML file that opens from disk: MuJoCo, the hand and its policy, live, without a network."""

    run: tyro.conf.Positional[RunName] = tyro.MISSING
    """Name of a run, or the path of its folder."""
    design: DesignName = "best"
    """Design to show: the best evaluated one, the latest one, or that of an iteration (0 is the initial one)."""
    out: Annotated[Path, tyro.conf.arg(metavar="PATH.html")] = Path("hand.html")
    """File to write; one that is there is replaced."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio show` with these words; return the exit status."""
    arguments = parse(ShowArguments, words, "show")
    from morph_core.durable import write_file
    from studio.export.errors import ExportError
    from studio.show.page import build_page

    history = open_run(arguments.runs, arguments.run)
    check_design(history, arguments.design)
    if not arguments.out.parent.is_dir():
        raise UsageError(f"show: there is no folder {arguments.out.parent} to write into")
    try:
        page = build_page(history, arguments.design)
    except ExportError as error:
        print(f"morph-studio: show: {error}", file=sys.stderr)  # noqa: T201
        return 1
    try:
        write_file(arguments.out, page.content)
    except OSError as error:
        reason = error.strerror or error
        print(f"morph-studio: show: can't write {arguments.out}: {reason}", file=sys.stderr)  # noqa: T201
        return 1
    if page.missing:
        print(f"morph-studio: show: {page.missing}", file=sys.stderr)  # noqa: T201
    print(arguments.out)  # noqa: T201
    return 0
