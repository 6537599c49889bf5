"""What each variant came to on a task, in the words of a table: the page and the documents show the same."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from studio.study.report.claims import solved
from studio.study.report.results import Results, RunRow
from studio.study.report.scores import estimate, iqm

NOTHING = "–"


@dataclass(frozen=True)
class Column:
    """A column of the summary: its heading, and what it means."""

    heading: str
    meaning: str


COLUMNS = (
    Column("method", "The variant's label in the plan."),
    Column("solved at the end", "Seeds whose sampled policy ended at the study's level of success or more."),
    Column("success, sampled [%]", "Median over seeds of the success at the end, lowest and highest in brackets."),
    Column("success, mean action [%]", "The same of the deterministic policy."),
    Column("IQM [%]", "Interquartile mean of the sampled success and its 95 % interval; a failed run counts as 0."),
    Column("solved first [M steps]", "Median of the environment steps when an evaluation first reached the level."),
    Column("solved first [CPU‑s]", "The same in CPU seconds of one core."),
    Column("whole run [CPU‑s]", "Median CPU time of a run, evaluations included."),
    Column("relabelling, search [M steps]", "Mean steps of Hw-Phy outside of trajectories, in millions."),
    Column("cosine < 0 [%]", "Median share of gradient steps with a negative cosine, while φ moves."),
    Column("not ended / failed", "Runs that have not ended yet, and runs that failed."),
)  # fmt: skip


def summary(results: Results, task: str) -> list[list[str]]:
    """Return a row of words for each variant, in the order of `COLUMNS`."""
    return [_row(results, variant, results.runs_of(task, variant)) for variant in results.variants]


def _row(results: Results, variant: str, rows: Sequence[RunRow]) -> list[str]:
    ended = [row for row in rows if row.has_ended]
    failed = sum(row.status == "failed" for row in ended)
    outside = [row.relabelled_steps + row.search_steps for row in ended]
    middle = estimate([[row.score for row in ended]], iqm)
    return [
        variant,
        f"{solved(ended, results.study.level)} of {len(ended)}" if ended else NOTHING,
        spread(row.sampled_success for row in ended),
        spread(row.deterministic_success for row in ended),
        _interval(middle.value, middle.low, middle.high),
        _median((row.sampled_solved_steps for row in ended), 1e-6, 2),
        _median((row.sampled_solved_cpu_seconds for row in ended), 1, 0),
        _median((row.cpu_seconds for row in ended), 1, 0),
        f"{np.mean(outside) / 1e6:.2f}" if ended and any(outside) else NOTHING,
        _median((row.negative_share for row in ended), 100, 0),
        f"{len(rows) - len(ended)} / {failed}",
    ]


def spread(values: Iterable[float | None]) -> str:
    """Return median, lowest and highest of shares in per cent; what was not measured is left out."""
    known = [100 * value for value in values if value is not None]
    return f"{np.median(known):.0f} ({min(known):.0f}–{max(known):.0f})" if known else NOTHING


def _interval(value: float, low: float, high: float) -> str:
    if np.isnan(value):
        return NOTHING
    return f"{100 * value:.0f}" if np.isnan(low) else f"{100 * value:.0f} [{100 * low:.0f}, {100 * high:.0f}]"


def _median(values: Iterable[float | None], factor: float, digits: int) -> str:
    known = [factor * value for value in values if value is not None]
    return f"{np.median(known):.{digits}f}" if known else NOTHING
