"""Every seed's phi against its box."""

from collections.abc import Iterator
from typing import Any

from morph_core.curves import FAINT, INK
from studio.study.report.drawing import Drawing, Look, looks, new_figure
from studio.study.report.figures.learning import broken, show_ticks_below
from studio.study.report.results import DesignRow, Results, chosen

_PANELS = 3


def phi_of_seeds(results: Results) -> Iterator[Drawing]:
    """Yield for each task and unit a panel for each variant that moves phi."""
    for task in results.tasks:
        for unit in dict.fromkeys(row.unit for row in results.designs if row.task == task):
            rows = [row for row in results.designs if row.task == task and row.unit == unit]
            yield _panels(results, task, unit, rows)


def _panels(results: Results, task: str, unit: str, rows: list[DesignRow]) -> Drawing:
    style = looks(results.variants)
    drawn = [variant for variant in results.variants if chosen(rows, task, variant)]
    columns = min(_PANELS, len(drawn))
    figure, axes = new_figure(-(-len(drawn) // columns), columns, 2.2, sharex=True, sharey=True)
    names = list(dict.fromkeys(row.parameter for row in rows))
    arrived = {row.run for row in results.runs if row.ends_at(results.study.level)}
    for panel, variant in zip(axes.flat, drawn, strict=False):
        _panel(panel, chosen(rows, task, variant), names, arrived, style[variant])
        panel.set_title(broken(variant, 36), loc="left")
    show_ticks_below(axes, len(drawn))
    figure.supylabel(f"φ [{unit}]", fontsize=9)
    return Drawing(
        f"phi-{task}-{unit}",
        f"{task}: φ of every seed against its box, in {unit}",
        "Grey: the box of each design parameter; the bar across it: where it starts; a mark for each seed where it "
        "ends, filled if the run ended at the study's level or above, hollow if not.",
        figure,
    )


def _panel(panel: Any, rows: list[DesignRow], names: list[str], arrived: set[str], look: Look) -> None:
    for place, name in enumerate(names):
        some = [row for row in rows if row.parameter == name]
        if not some:
            continue
        panel.bar(place, some[0].hi - some[0].lo, 0.72, some[0].lo, color=FAINT, alpha=0.18, linewidth=0)
        panel.plot([place - 0.36, place + 0.36], [some[0].initial] * 2, color=INK, linewidth=1.6)
        marks = [(place + 0.5 * ((i + 0.5) / len(some) - 0.5), row) for i, row in enumerate(some)]
        for face, filled in ((look.colour, True), ("none", False)):
            of_these = [(x, row.final) for x, row in marks if (row.run in arrived) == filled]
            if of_these:
                x, y = zip(*of_these, strict=True)
                panel.plot(x, y, look.marker, markersize=4, color=look.colour, markerfacecolor=face, markeredgewidth=1)
    panel.set_xticks(range(len(names)), [name.replace("_", " ") for name in names], rotation=35, ha="right")
    panel.grid(axis="x", visible=False)
