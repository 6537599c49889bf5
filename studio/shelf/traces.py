"""Traces of several runs on one axis, and for each method their mean with its interval."""

from collections.abc import Sequence

import msgspec
import numpy as np

from morph_core.protocol import Evaluation, Parameter, RunRecord

MOST_RUNS = 100
"""Largest number of runs that are drawn at once."""
CONFIDENCE = 0.95
RESAMPLES = 1000
_GRID = 101
"""Number of places along the axis at which a mean is taken."""
_POINTS, _FEWEST_POINTS, _MOST_POINTS = 4000, 20, 400
"""Number of points of all traces together, and bounds for a single one."""
_MEASURES = ("sampled_success", "sampled_return")


class Trace(msgspec.Struct, frozen=True, kw_only=True):
    """The evaluations of one run on Hw-Phy, thinned so that the highest and the lowest of each stretch stay."""

    run: str
    method: str
    task: str
    seed: int
    parameters: list[Parameter]
    iteration: list[int]
    env_steps: list[int]
    success: list[float]
    episode_return: list[float]
    phi: list[list[float]]


class Curve(msgspec.Struct, frozen=True, kw_only=True):
    """The mean of several runs, and the interval of that mean: lists of equal length."""

    mean: list[float]
    low: list[float]
    high: list[float]


class Mean(msgspec.Struct, frozen=True, kw_only=True):
    """The mean over the runs of one method on one task, where all of them have been evaluated."""

    method: str
    task: str
    runs: int
    env_steps: list[float]
    success: Curve
    episode_return: Curve


class Overlay(msgspec.Struct, frozen=True, kw_only=True):
    """Traces of several runs, and the means of those that share a task and a method."""

    traces: list[Trace]
    means: list[Mean]
    confidence: float = CONFIDENCE


def overlay(runs: Sequence[tuple[str, RunRecord, list[Evaluation]]]) -> Overlay:
    """Return what is drawn of these runs: name, record and evaluations of each."""
    groups: dict[tuple[str, str], list[list[Evaluation]]] = {}
    for _, record, evaluations in runs:
        if len(evaluations) > 1:
            groups.setdefault((record.task, record.method), []).append(evaluations)
    means = [_mean(task, method, members) for (task, method), members in groups.items() if len(members) > 1]
    limit = int(np.clip(_POINTS // max(1, len(runs)), _FEWEST_POINTS, _MOST_POINTS))
    traces = [_trace(name, record, thinned(evaluations, limit)) for name, record, evaluations in runs]
    return Overlay(traces=traces, means=[mean for mean in means if mean is not None])


def thinned(evaluations: Sequence[Evaluation], limit: int) -> list[Evaluation]:
    """Return about `limit` evaluations: the first, the last, and of each stretch those with the extremes."""
    if len(evaluations) <= limit:
        return list(evaluations)
    values = np.array([[getattr(e, measure) for measure in _MEASURES] for e in evaluations])
    kept = {0, len(evaluations) - 1}
    for stretch in np.array_split(np.arange(len(evaluations)), max(1, limit // (2 * len(_MEASURES)))):
        kept |= {*stretch[values[stretch].argmin(0)].tolist(), *stretch[values[stretch].argmax(0)].tolist()}
    return [evaluations[i] for i in sorted(kept)]


def _trace(name: str, record: RunRecord, evaluations: Sequence[Evaluation]) -> Trace:
    return Trace(
        run=name,
        method=record.method,
        task=record.task,
        seed=record.seed,
        parameters=record.parameters,
        iteration=[e.iteration for e in evaluations],
        env_steps=[e.env_steps for e in evaluations],
        success=[e.sampled_success for e in evaluations],
        episode_return=[e.sampled_return for e in evaluations],
        phi=[e.phi for e in evaluations],
    )


def _mean(task: str, method: str, runs: Sequence[Sequence[Evaluation]]) -> Mean | None:
    """Return the mean of at least two runs; None if there is no stretch that all of them have."""
    begin, end = max(run[0].env_steps for run in runs), min(run[-1].env_steps for run in runs)
    if begin >= end:
        return None
    grid = np.linspace(begin, end, _GRID)
    success, returns = (
        np.array([np.interp(grid, [e.env_steps for e in run], [getattr(e, measure) for e in run]) for run in runs])
        for measure in _MEASURES
    )
    return Mean(
        task=task,
        method=method,
        runs=len(runs),
        env_steps=grid.tolist(),
        success=_curve(success),
        episode_return=_curve(returns),
    )


def _curve(values: np.ndarray) -> Curve:
    """Return the mean of runs (n, grid) with its percentile interval by the bootstrap over runs."""
    drawn = np.random.default_rng(0).integers(0, len(values), (RESAMPLES, len(values)))
    weights = np.stack([np.bincount(row, minlength=len(values)) for row in drawn]) / len(values)
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(weights @ values, [tail, 1 - tail], axis=0)
    return Curve(mean=values.mean(0).tolist(), low=low.tolist(), high=high.tolist())
