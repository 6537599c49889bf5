"""Tables of a study in a document: each stands between two markers, and the command that is named there writes it.

    <!-- study NAME: summary TASK -->
    <!-- study NAME: claims -->
    <!-- end of table -->

NAME is that of the study's folder.
"""

import re
from collections.abc import Iterable
from pathlib import Path

from morph_core import durable
from studio.study.plan import StudyError
from studio.study.report.claims import CLAIMS
from studio.study.report.results import Results
from studio.study.report.summary import COLUMNS, summary

_END = "<!-- end of table -->"
_TABLE = re.compile(
    r"(?P<begin>^<!-- study (?P<name>\S+): (?P<what>summary|claims)(?: (?P<task>\S+))? -->\n)(?P<table>.*?)"
    rf"^{re.escape(_END)}$",
    re.MULTILINE | re.DOTALL,
)


def write_into(document: Path, name: str, results: Results) -> int:
    """Write the tables of the study `name` into a document; return how many there are.

    Raise StudyError where the document can't be read or has no place for them.
    """
    try:
        text = document.read_text(encoding="utf-8")
    except OSError as error:
        raise StudyError(f"{document} can't be read: {error.strerror or error}") from error
    filled, count = fill(text, name, results)
    if not count:
        raise StudyError(
            f'{document} has no place for tables of the study {name}: write the lines "<!-- study {name}: summary '
            f'{results.tasks[0]} -->" or "<!-- study {name}: claims -->", and below each "{_END}"'
        )
    durable.write_file(durable.where_written(document), filled.encode())
    return count


def fill(text: str, name: str, results: Results) -> tuple[str, int]:
    """Return a document with its tables of the study `name` as they are now, and how many there are."""
    count = 0

    def table(found: re.Match[str]) -> str:
        nonlocal count
        if found["name"] != name:
            return found[0]
        count += 1
        if found["what"] == "claims":
            return f"{found['begin']}{claims_table(results)}{_END}"
        task = found["task"] or results.tasks[0]
        if task not in results.tasks:
            raise StudyError(f'the study {name} has no task "{task}"; choose from: {", ".join(results.tasks)}')
        return f"{found['begin']}{summary_table(results, task)}{_END}"

    return _TABLE.sub(table, text), count


def summary_table(results: Results, task: str) -> str:
    """Return the summary of a task as a Markdown table."""
    return _table([column.heading for column in COLUMNS], summary(results, task))


def claims_table(results: Results) -> str:
    """Return what the study says of the paper's claims as a Markdown table."""
    rows = [
        ["" if i else claim.statement, finding.verdict, finding.subject, finding.measured, str(finding.seeds)]
        for claim in CLAIMS
        for i, finding in enumerate(claim.findings(results))
    ]
    return _table(["the paper's claim", "here", "task: variants", "by how much", "seeds"], rows)


def _table(headings: list[str], rows: Iterable[list[str]]) -> str:
    return "".join(_line(cells) for cells in [headings, ["---"] * len(headings), *rows])


def _line(cells: list[str]) -> str:
    escaped = (cell.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;") for cell in cells)
    return f"| {' | '.join(escaped)} |\n"
