"""Aggregate scores with intervals by the stratified bootstrap, which SciPy resamples.

The method is that of Agarwal et al. 2021 ("Deep RL at the Edge of the Statistical Precipice"), and of rliable.

A stratum is a task: its seeds are resampled on their own. A score is the share of the final episodes in which the
sampled policy reached the goal, so it lies in [0, 1] without any normalisation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

RESAMPLES = 5000
CONFIDENCE = 0.95
AGGREGATES = ("IQM", "median", "mean", "optimality gap")

Strata = Sequence[Sequence[float]]
"""Scores of one variant: for each task those of its seeds."""


@dataclass(frozen=True)
class Estimate:
    """A number and the interval in which it lies with the confidence of `CONFIDENCE`; NaN where nothing is known."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}]"


def aggregates(strata: Strata) -> dict[str, Estimate]:
    """Return the four aggregates by name."""
    functions = dict(zip(AGGREGATES, (iqm, median, mean, optimality_gap), strict=True))
    return {name: estimate(strata, function) for name, function in functions.items()}


def iqm(*tasks: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean of the middle half of all runs."""
    return stats.trim_mean(np.concatenate(tasks, axis), 0.25, axis)


def median(*tasks: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the median over tasks of the mean over seeds; with a single task, the median over its seeds."""
    if len(tasks) == 1:
        return np.median(tasks[0], axis)
    return np.median([scores.mean(axis) for scores in tasks], axis=0)


def mean(*tasks: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean over tasks of the mean over seeds."""
    return np.mean([scores.mean(axis) for scores in tasks], axis=0)


def optimality_gap(*tasks: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return by how much all runs together fall short of success in every episode."""
    return 1 - np.concatenate(tasks, axis).mean(axis)


def improvement(ours: Strata, theirs: Strata) -> Estimate:
    """Return the probability that a run of the first variant scores higher than one of the second; ties count half."""
    count = len(ours)
    if count != len(theirs):
        raise ValueError("both variants need scores on the same tasks")

    def probability(*both: np.ndarray, axis: int = -1) -> np.ndarray:
        del axis  # SciPy puts the runs last
        return np.mean([_larger(x, y) for x, y in zip(both[:count], both[count:], strict=True)], axis=0)

    return estimate([*ours, *theirs], probability)


def _larger(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the share of all pairs in which x (..., n) is larger than y (..., m), as Mann and Whitney."""
    pairs = x[..., :, None], y[..., None, :]
    return ((pairs[0] > pairs[1]) + 0.5 * (pairs[0] == pairs[1])).mean((-2, -1))


def estimate(strata: Strata, function: Callable[..., np.ndarray]) -> Estimate:
    """Return a function of the strata with its percentile interval."""
    tasks = [np.asarray(scores, float) for scores in strata]
    if not tasks or min(len(scores) for scores in tasks) == 0:
        return Estimate(np.nan, np.nan, np.nan)
    value = float(function(*tasks))
    if min(len(scores) for scores in tasks) < 2:
        return Estimate(value, np.nan, np.nan)
    drawn = stats.bootstrap(
        tasks, function, n_resamples=RESAMPLES, confidence_level=CONFIDENCE, method="percentile", paired=False,
        vectorized=True, rng=np.random.default_rng(0),
    )  # fmt: skip
    return Estimate(value, float(drawn.confidence_interval.low), float(drawn.confidence_interval.high))
