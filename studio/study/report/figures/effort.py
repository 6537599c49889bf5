"""What runs cost: the time to solve, CPU time in all, and steps of simulation by what they were for."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from morph_core.curves import FAINT, INK
from studio.study.report.drawing import Drawing, Look, looks, new_figure
from studio.study.report.figures.learning import MILLION, short
from studio.study.report.results import Results, RunRow

_SPENT = (
    ("env_steps", "trajectories", 1.0),
    ("relabelled_steps", "relabelling and the proxy's fit", 0.55),
    ("search_steps", "search for φ", 0.25),
)
"""Kinds of steps, and how opaque the variant's colour is in their bar."""


def time_to_solve(results: Results) -> Iterator[Drawing]:
    """Yield for each task when each seed first reached the level, in steps and in CPU seconds."""
    style = looks(results.variants)
    for task in results.tasks:
        drawn = {v: rows for v in results.variants if (rows := results.ended(task, v))}
        if not drawn:
            continue
        figure, axes = new_figure(1, 2, 0.9 + 0.32 * len(drawn), sharey=True)
        for panel, name, factor in (
            (axes[0, 0], "sampled_solved_steps", 1 / MILLION),
            (axes[0, 1], "sampled_solved_cpu_seconds", 1.0),
        ):
            for height, (variant, rows) in enumerate(drawn.items()):
                _dots(panel, height, [v * factor for r in rows if (v := getattr(r, name)) is not None], style[variant])
            panel.grid(axis="y", visible=False)
        longest = max((row.cpu_seconds for rows in drawn.values() for row in rows), default=0)
        axes[0, 0].set_xlim(0, 1.03 * results.study.env_steps / MILLION)
        axes[0, 1].set_xlim(0, 1.03 * max(longest, 1))
        axes[0, 0].set_xlabel("environment steps [million]")
        axes[0, 1].set_xlabel("CPU time [s of one core]")
        labels = [f"{short(v)}  {_solved(rows)} of {len(rows)}" for v, rows in drawn.items()]
        axes[0, 0].set_yticks(range(len(drawn)), labels)
        axes[0, 0].set_ylim(len(drawn) - 0.5, -0.5)
        yield Drawing(
            f"time-{task}",
            f"{task}: time to solve",
            f"When the sampled policy first succeeded in {100 * results.study.level:g} % of an evaluation's episodes: "
            "a mark for each seed that did, the median of these as a bar, and beside the name how many did. The axes "
            "end with the budget and with the longest run.",
            figure,
        )


def _solved(rows: list[RunRow]) -> int:
    return sum(row.sampled_solved_steps is not None for row in rows)


def spent(results: Results) -> Iterator[Drawing]:
    """Yield for each task the CPU time of each seed, and the mean number of steps by what they were for."""
    from matplotlib.patches import Patch

    style = looks(results.variants)
    for task in results.tasks:
        drawn = {v: rows for v in results.variants if (rows := results.ended(task, v))}
        if not drawn:
            continue
        figure, axes = new_figure(1, 2, 1.2 + 0.32 * len(drawn), sharey=True)
        for height, (variant, rows) in enumerate(drawn.items()):
            _dots(axes[0, 0], height, [row.cpu_seconds for row in rows], style[variant])
        left, colours = np.zeros(len(drawn)), [style[variant].colour for variant in drawn]
        for name, _, alpha in _SPENT:
            steps = np.array([np.mean([getattr(row, name) for row in rows]) for rows in drawn.values()]) / MILLION
            axes[0, 1].barh(range(len(drawn)), steps, 0.6, left, color=colours, alpha=alpha)
            left += steps
        for panel in axes[0]:
            panel.grid(axis="y", visible=False)
            panel.set_xlim(left=0)
        axes[0, 0].set_yticks(range(len(drawn)), [short(variant) for variant in drawn])
        axes[0, 0].set_ylim(len(drawn) - 0.5, -0.5)
        axes[0, 0].set_xlabel("CPU time of a run [s of one core]")
        axes[0, 1].set_xlabel("steps of simulation, mean over seeds [million]")
        kinds = [Patch(facecolor=INK, alpha=alpha, label=label) for _, label, alpha in _SPENT]
        figure.legend(handles=kinds, loc="outside lower right", ncols=3)
        yield Drawing(
            f"cost-{task}",
            f"{task}: what a run costs",
            "Left: CPU time of each seed, evaluations included, median as a bar. Right: steps by what they were for; "
            "the budget counts those of trajectories alone.",
            figure,
        )


def _dots(panel: Any, height: int, values: list[float], look: Look) -> None:
    if not values:
        return
    spread = np.linspace(-0.16, 0.16, len(values)) if len(values) > 1 else np.zeros(1)
    panel.plot(values, height + spread, look.marker, color=look.colour, markersize=4.5, alpha=0.8, linestyle="none")
    panel.plot([np.median(values)] * 2, [height - 0.32, height + 0.32], color=INK, linewidth=1.8)
    panel.axhline(height + 0.5, color=FAINT, linewidth=0.4, alpha=0.4)
