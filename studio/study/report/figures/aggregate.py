"""Aggregate scores with intervals, and how probably one variant does better than another."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from morph_core.curves import FAINT
from studio.study.report.drawing import Drawing, looks, new_figure
from studio.study.report.figures.learning import broken, short
from studio.study.report.results import Results
from studio.study.report.scores import AGGREGATES, Estimate, Strata, aggregates, improvement


def scores_of(results: Results, tasks: list[str]) -> dict[str, Strata]:
    """Return for each variant its scores on these tasks; variants that have not ended a run on each are left out."""
    strata = {v: [[row.score for row in results.ended(task, v)] for task in tasks] for v in results.variants}
    return {variant: scores for variant, scores in strata.items() if scores and all(scores)}


def aggregate_scores(results: Results) -> Iterator[Drawing]:
    """Yield the aggregates of each task, and of all tasks together where there are several."""
    groups = [[task] for task in results.tasks]
    for tasks in [*groups, *([results.tasks] if len(groups) > 1 else [])]:
        strata = scores_of(results, tasks)
        if strata:
            yield _aggregates(results, "-".join(tasks) if len(tasks) == 1 else "all", tasks, strata)


def _aggregates(results: Results, name: str, tasks: list[str], strata: dict[str, Strata]) -> Drawing:
    style, reference = looks(results.variants), next(iter(strata))
    figure, axes = new_figure(1, len(AGGREGATES) + 1, 0.9 + 0.3 * len(strata), sharey=True)
    for height, (variant, scores) in enumerate(strata.items()):
        estimates = [*aggregates(scores).values(), improvement(strata[reference], scores)]
        for panel, estimate in zip(axes[0], estimates, strict=True):
            if panel is not axes[0, -1] or variant != reference:
                _interval(panel, height, estimate, style[variant].colour, style[variant].marker)
    for panel, title in zip(axes[0], (*AGGREGATES, f"P({broken(reference, 16)} > …)"), strict=True):
        panel.set(xlim=(-0.04, 1.04), xticks=[0, 0.5, 1])
        panel.set_title(title)
        panel.grid(axis="y", visible=False)
    axes[0, -1].axvline(0.5, color=FAINT, linestyle=":", linewidth=1.2)
    axes[0, 0].set_yticks(range(len(strata)), [short(variant) for variant in strata])
    axes[0, 0].invert_yaxis()
    figure.supxlabel(
        "success of the sampled policy at the end [share of episodes]; last panel: probability", fontsize=9
    )
    words = tasks[0] if len(tasks) == 1 else "all tasks"
    return Drawing(
        f"aggregate-{name}",
        f"{words}: aggregate scores",
        "Interquartile mean, median, mean and optimality gap (smaller is better) of the success at the end over "
        "seeds, with 95 % intervals by stratified bootstrap; a run that failed counts as 0. The last panel: the "
        f"probability that a run of {reference} ends with more success than one of the row's variant, ties counted "
        "half.",
        figure,
    )


def _interval(panel: Any, height: int, estimate: Estimate, colour: str, marker: str) -> None:
    if np.isfinite(estimate.low):
        panel.plot([estimate.low, estimate.high], [height, height], color=colour, linewidth=5, alpha=0.35)
    panel.plot(estimate.value, height, marker, color=colour, markersize=6)
