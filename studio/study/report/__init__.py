"""The report of a study, made from its run folders at any time: tables, figures, the paper's claims, one page."""

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

from studio.study.plan import StudyError

if TYPE_CHECKING:
    from studio.study.report.results import Results

RUNS = "runs.csv"
"""Name of the table by which a report's folder is known."""
NEEDED = ("jinja2", "matplotlib", "pyarrow", "scipy")


def write_report(directory: Path) -> Path:
    """Write the report of a study into its folder `report`, and return the path of report.html.

    Raise StudyError if the folder holds no study, or if what the report is made with is not installed.
    """
    check_extra()
    if (directory / RUNS).is_file():
        raise StudyError(f"{directory} holds a report, without the runs of its study: give the folder of the study")
    from studio.study.report.write import write_report as write

    return write(directory)


def write_tables_into(directory: Path, document: Path) -> int:
    """Write the tables of a study into the places that a Markdown document has for them; return how many.

    `directory` is the study's, or that of its report. Raise StudyError if there is no study or no place.
    """
    results = results_at(directory)
    from studio.study.report.markdown import write_into

    return write_into(document, directory.resolve().name, results)


def results_at(directory: Path) -> "Results":
    """Return what the runs of a study came to; `directory` is the study's, or that of its report.

    Raise StudyError if there is no study, or if what a report is made with is not installed.
    """
    check_extra()
    from studio.study.report.results import read_results
    from studio.study.report.tables import read_tables

    return read_tables(directory) if (directory / RUNS).is_file() else read_results(directory)


def check_extra() -> None:
    """Raise StudyError that names the extra if a package is missing that reports are made with."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise StudyError(f'a report needs {", ".join(missing)}: pip install "morph-studio[study]"')
