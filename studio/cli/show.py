"""`morph-studio show`: write one HTML file in which an exported hand runs live, without a network."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from studio.cli.arguments import RunName, RunsArguments, parse
from studio.cli.choice import check_design, open_run
from studio.cli.export import DesignName
from studio.cli.output import complain
from studio.cli.pages import check_place, write_page


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
    from studio.export.errors import ExportError
    from studio.show.page import build_page

    history = open_run(arguments.runs, arguments.run)
    check_design(history, arguments.design)
    check_place(arguments.out, "show")
    try:
        page = build_page(history, arguments.design)
    except ExportError as error:
        complain(f"morph-studio: show: {error}")
        return 1
    return write_page(page, arguments.out, "show")
