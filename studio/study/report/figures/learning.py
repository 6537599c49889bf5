"""Success and return over environment steps, by variant and by seed."""

import textwrap
from collections.abc import Collection, Iterator, Sequence
from typing import Any

import numpy as np

from morph_core.curves import FAINT, INK
from studio.study.report.drawing import Drawing, Look, looks, new_figure
from studio.study.report.results import CurveRow, Results, chosen

POINTS = 50
"""Points of a median curve."""
MILLION = 1e6
_MEASURES = (
    ("sampled_success", "success [% of episodes]", 100),
    ("sampled_return", "return [reward]", 1),
)
_LEGEND, _HANDLE = 125, 12
"""Letters that fit into a line of a legend, and how many of them a line's sample takes."""
_PANELS = 4
"""Largest number of panels side by side."""


def learning_curves(results: Results) -> Iterator[Drawing]:
    """Yield the comparison of a task: median over seeds and the middle half of them."""
    style = looks(results.variants)
    for task in results.tasks:
        curves = {variant: _evaluated(results, task, variant) for variant in results.variants}
        drawn = {variant: runs for variant, runs in curves.items() if runs}
        if not drawn:
            continue
        columns = legend_columns(drawn)
        figure, axes = new_figure(1, 2, 3.2 + 0.2 * -(-len(drawn) // columns))
        for panel, (measure, label, factor) in zip(axes[0], _MEASURES, strict=True):
            for variant, runs in drawn.items():
                _band(panel, runs, measure, factor, style[variant], f"{variant} ({len(runs)})")
            panel.set(xlabel="environment steps [million]", ylabel=label)
            panel.margins(x=0.01)
            panel.locator_params(axis="x", nbins=6)
            panel.set_xlim(left=0)
        axes[0, 0].set_ylim(-3, 103)
        _level_line(axes[0, 0], results)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, handlelength=3.2)
        yield Drawing(
            f"learning-{task}",
            f"{task}: success and return over environment steps",
            "Evaluations of the sampled policy on Hw-Phy with the present φ. Lines: median over seeds, their number "
            "in brackets; bands: the middle half of the seeds. Dotted: the level from which a run counts as solved. A "
            "curve goes as far as at least half of its seeds have come.",
            figure,
        )


def seed_curves(results: Results) -> Iterator[Drawing]:
    """Yield a panel for each variant, with a line for each seed."""
    style = looks(results.variants)
    for task in results.tasks:
        curves = {variant: _evaluated(results, task, variant) for variant in results.variants}
        drawn = {variant: runs for variant, runs in curves.items() if runs}
        if not drawn:
            continue
        columns = min(_PANELS, len(drawn))
        figure, axes = new_figure(-(-len(drawn) // columns), columns, 2.2, sharex=True, sharey=True)
        failed = {row.run for row in results.runs if row.status == "failed"}
        for panel, (variant, runs) in zip(axes.flat, drawn.items(), strict=False):
            look = style[variant]
            for run, rows in runs.items():
                x, y = points(rows, "sampled_success", 100)
                panel.plot(x, y, color=look.colour, linestyle=look.dash, linewidth=0.9, alpha=0.75)
                if run in failed and len(x):
                    panel.plot(x[-1], y[-1], "x", color=INK, markersize=7, markeredgewidth=1.8)
            _level_line(panel, results)
            panel.set(ylim=(-3, 103))
            panel.set_title(broken(variant), loc="left")
        show_ticks_below(axes, len(drawn))
        figure.supxlabel("environment steps [million]", fontsize=9)
        figure.supylabel("success [% of episodes]", fontsize=9)
        yield Drawing(
            f"seeds-{task}",
            f"{task}: every seed",
            "Success of the sampled policy on Hw-Phy, a line for each seed. Dotted: the level from which a run counts "
            "as solved. A cross marks where a run failed.",
            figure,
        )


def legend_columns(labels: Collection[str]) -> int:
    """Return how many columns of a legend fit below a figure that is as wide as a page."""
    return max(1, min(4, len(labels), _LEGEND // (max(map(len, labels)) + _HANDLE)))


def broken(label: str, width: int = 28) -> str:
    """Return a label in lines that fit above a panel, broken behind its commas where it can be."""
    spaced = label.replace(",", ", ")
    lines = textwrap.wrap(spaced, width, max_lines=3, placeholder=" …", break_on_hyphens=False)
    return "\n".join(line.replace(", ", ",") for line in lines)


def short(label: str, longest: int = 44) -> str:
    """Return a label that fits beside a row: what is left out is left out of its middle."""
    half = (longest - 1) // 2
    return label if len(label) <= longest else f"{label[:half]}…{label[-half:]}"


def show_ticks_below(axes: Any, used: int) -> None:
    """Show the ticks' labels below the lowest used panel of each column; hide the panels after the first `used`."""
    for i, panel in enumerate(axes.flat):
        panel.tick_params(labelbottom=used - axes.shape[1] <= i)
        if i >= used:
            panel.set_axis_off()


def by_run(rows: Sequence[CurveRow]) -> dict[str, list[CurveRow]]:
    """Return the iterations of each run."""
    runs: dict[str, list[CurveRow]] = {}
    for row in rows:
        runs.setdefault(row.run, []).append(row)
    return runs


def _evaluated(results: Results, task: str, variant: str) -> dict[str, list[CurveRow]]:
    return by_run([row for row in chosen(results.curves, task, variant) if row.sampled_success is not None])


def middle_half(curves: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, ...] | None:
    """Return x, the lower quartile, the median and the upper quartile of curves, as far as half of them go."""
    known = [(x, y) for x, y in curves if len(x)]
    if not known:
        return None
    grid = np.linspace(min(x[0] for x, _ in known), max(x[-1] for x, _ in known), POINTS)
    values = np.array([np.interp(grid, x, y, left=np.nan, right=np.nan) for x, y in known])  # (seeds, POINTS)
    enough = np.isfinite(values).sum(0) >= max(1, len(known) / 2)
    return grid[enough], *np.nanpercentile(values[:, enough], [25, 50, 75], axis=0)


def points(rows: Sequence[CurveRow], measure: str, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return environment steps in millions and the measure, (n,) each, of the iterations that have it."""
    known = [(r.env_steps / MILLION, factor * value) for r in rows if (value := getattr(r, measure)) is not None]
    x, y = np.array(known).reshape(-1, 2).T
    return x, y


def _band(panel: Any, runs: dict[str, list[CurveRow]], measure: str, factor: float, look: Look, label: str) -> None:
    band = middle_half([points(rows, measure, factor) for rows in runs.values()])
    if band is None:
        return
    x, low, middle, high = band
    panel.fill_between(x, low, high, color=look.colour, alpha=0.16, linewidth=0)
    panel.plot(
        x, middle, color=look.colour, linestyle=look.dash, label=label,
        marker=look.marker, markevery=(5, 12), markersize=4.5,
    )  # fmt: skip


def _level_line(panel: Any, results: Results) -> None:
    panel.axhline(100 * results.study.level, color=FAINT, linestyle=":", linewidth=1.2, zorder=0)
