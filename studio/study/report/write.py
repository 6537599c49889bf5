"""The whole report: read the runs, write tables, figures and the page."""

from collections.abc import Iterator
from pathlib import Path

from morph_core import durable
from studio.study.report.drawing import Drawing, save
from studio.study.report.figures import aggregate, agreement, designs, effort, learning, robots
from studio.study.report.page import page
from studio.study.report.results import Results, read_results
from studio.study.report.tables import write_tables

PAGE = "report.html"


def write_report(directory: Path, into: Path | None = None, *, pixels: bool = True) -> Path:
    """Write the report of a study as it is now and return the path of its page.

    It goes to the folder `report` of the study, or to `into`; without `pixels`, no PNG is written. Raise StudyError if
    the folder holds no study.
    """
    results = read_results(directory)
    folder = into or directory / "report"
    write_tables(results, folder)
    drawn = [(d, save(d, folder / "figures", pixels=pixels)) for d in drawings(results, directory)]
    durable.write_file(folder / PAGE, page(results, drawn, directory).encode())
    return folder / PAGE


def drawings(results: Results, directory: Path) -> Iterator[Drawing]:
    """Yield every figure for which the runs have data."""
    yield from learning.learning_curves(results)
    yield from aggregate.aggregate_scores(results)
    yield from learning.seed_curves(results)
    yield from effort.time_to_solve(results)
    yield from effort.spent(results)
    yield from robots.before_and_after(results, directory)
    yield from designs.phi_of_seeds(results)
    yield from agreement.cosines(results)
    yield from agreement.losses(results)
