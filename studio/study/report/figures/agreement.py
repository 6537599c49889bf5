"""Whether the task and the hardware agree: the cosine of both gradients; the proxy's loss and the search cost."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from morph_core.curves import FAINT, INK
from studio.study.report.claims import NEGATIVE_SHARE
from studio.study.report.drawing import Drawing, looks, new_figure
from studio.study.report.figures.learning import broken, by_run, middle_half, points
from studio.study.report.results import CurveRow, Results, chosen

_PANELS = 4
_ENDS = 1e-9
_TWO_DECADES = 100


def cosines(results: Results) -> Iterator[Drawing]:
    """Yield for each task a column of two panels for each variant with a proxy: the cosine, and its negative share."""
    style = looks(results.variants)
    for task in results.tasks:
        drawn = _variants_with(results, task, "cosine_negative")
        for number, part in enumerate(_parts(drawn)):
            figure, axes = new_figure(2, len(part), 1.9, max(5.0, 2.4 * len(part)), sharex="col", sharey="row")
            for (upper, lower), variant in zip(axes.T, part, strict=True):
                rows = chosen(results.curves, task, variant)
                _spread(upper, rows, "cosine", style[variant].colour)
                _spread(lower, rows, "cosine_negative", style[variant].colour, 100)
                upper.axhline(0, color=FAINT, linewidth=1)
                upper.set_title(broken(variant, 26), loc="left")
                lower.axhline(100 * NEGATIVE_SHARE, color=FAINT, linestyle=":", linewidth=1.4)
                upper.set_ylim(-1.05, 1.05)
                lower.set_ylim(-3, 103)
            axes[0, 0].set_ylabel("cosine of g_task, g_hw")
            axes[1, 0].set_ylabel("negative [% of steps]")
            for panel in axes.flat:
                panel.locator_params(axis="x", nbins=4)
            figure.supxlabel("environment steps [million]", fontsize=9)
            yield Drawing(
                _numbered(f"cosine-{task}", number),
                f"{task}: cosine of both gradients",
                "Above: the mean cosine over ψ of an iteration's gradient steps; below: the share of these steps in "
                "which it is negative. Lines: median over seeds; bands: the middle half. Dotted: the paper's 64 % "
                "(mouse).",
                figure,
            )


def losses(results: Results) -> Iterator[Drawing]:
    """Yield for each task a panel for each variant with a proxy: its loss and the search cost."""
    style = looks(results.variants)
    for task in results.tasks:
        drawn = _variants_with(results, task, "divergence")
        for number, part in enumerate(_parts(drawn)):
            figure, axes = new_figure(1, len(part), 2.6, max(5.0, 2.4 * len(part)), sharex=True)
            for panel, variant in zip(axes[0], part, strict=True):
                rows = chosen(results.curves, task, variant)
                _spread(panel, rows, "divergence", style[variant].colour, log=True)
                _spread(panel, rows, "search_cost", INK, dash=(0, (5, 2)), log=True)
                _logarithmic(panel)
                panel.set_title(broken(variant, 26), loc="left")
            axes[0, 0].set_ylabel("mean squared distance")
            for panel in axes.flat:
                panel.locator_params(axis="x", nbins=4)
            figure.supxlabel("environment steps [million]", fontsize=9)
            yield Drawing(
                _numbered(f"loss-{task}", number),
                f"{task}: loss of the proxy and search cost",
                "Solid: the loss of the proxy D, the divergence of Hw-Phy with the present φ from the proxy. Dashed: "
                "the search cost, that of the design found from the relabelled data. Both are in the metric of the "
                "variant: only shapes compare across panels. Lines: median over seeds; bands: the middle half.",
                figure,
            )


def _logarithmic(panel: Any) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    panel.set_yscale("log")
    low, high = panel.get_ylim()
    panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < _TWO_DECADES * low else (1,), numticks=8))
    panel.yaxis.set_minor_locator(NullLocator())
    panel.yaxis.set_major_formatter("{x:g}")


def _variants_with(results: Results, task: str, measure: str) -> list[str]:
    return [
        variant
        for variant in results.variants
        if any(getattr(row, measure) is not None for row in chosen(results.curves, task, variant))
    ]


def _parts(variants: list[str]) -> Iterator[list[str]]:
    for start in range(0, len(variants), _PANELS):
        yield variants[start : start + _PANELS]


def _numbered(name: str, number: int) -> str:
    return f"{name}-{number + 1}" if number else name


def _spread(
    panel: Any, rows: Sequence[CurveRow], measure: str, colour: str, factor: float = 1, dash: object = "-",
    log: bool = False,
) -> None:  # fmt: skip
    """Draw the median over runs and the middle half; on a logarithmic axis nothing falls below `_ENDS`."""
    band = middle_half([points(some, measure, factor) for some in by_run(rows).values()])
    if band is None:
        return
    x, low, middle, high = band
    if log:
        low, middle, high = (np.maximum(part, _ENDS) for part in (low, middle, high))
    panel.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)
    panel.plot(x, middle, color=colour, linestyle=dash)
