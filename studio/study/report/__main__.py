"""Process entry: write the report of a study into another folder, without PNG, after the trainers' turn."""

import os
import sys
from pathlib import Path

from studio.study.plan import StudyError
from studio.study.report import check_extra

_NICENESS = 10
"""Beside the trainers of a study, whose niceness is 5, it gets a quarter of a core; at 19 it came to no end there."""


def main(directory: str, into: str) -> int:
    """Write the report and return the exit status; what is wrong stands in the last line of stderr."""
    os.nice(_NICENESS)
    try:
        check_extra()
        from studio.study.report.write import write_report

        write_report(Path(directory), Path(into), pixels=False)
    except StudyError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
