"""A chart of the traces: made once there is something to show, redrawn seldom where a run is long."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import viser
import viser.uplot

from morph_core.history import History
from studio.viewer import wording
from studio.viewer.parts import COLOURS

MOST_POINTS = 2000
_HEIGHT = 118
_ROWS_PER_SECOND = 1000
"""Number of rows for which a chart rests one second: every update resends the whole chart, so a long run is redrawn
less often."""
_LONGEST_REST = 2.0
"""Longest time that a chart rests between two updates, in seconds."""
_FONT = "11px system-ui, sans-serif"
_LOG = 3
"""Number by which uPlot knows a logarithmic scale."""

Curves = tuple[np.ndarray, ...]
"""Data of a chart: x (N,), then one y (N,) for each series; NaN where a series has no value."""


@dataclass(frozen=True)
class Trace:
    """Description of a chart: its title, labels and colours, and how its curves are taken from a run."""

    title: str
    axis: str
    labels: tuple[str, ...]
    curves: Callable[[History], Curves]
    empty: str = ""
    """Sentence to show while there is nothing to draw."""
    bounds: tuple[float, float] | None = None
    """Fixed limits of the y axis; without them it fits the data."""
    logarithmic: bool = False
    colours: tuple[str, ...] = COLOURS

    @property
    def frame(self) -> tuple[object, ...]:
        """Return everything that asks for another chart when it changes; new data alone does not."""
        return self.title, self.axis, self.labels, self.bounds, self.logarithmic, self.colours


class Chart:
    """One chart of the column. It is made once it has data, because uPlot never recovers from an empty start."""

    def __init__(self, gui: viser.GuiApi, tab: viser.GuiTabHandle, trace: Trace, order: int) -> None:
        self._gui = gui
        self._tab = tab
        self.trace = trace
        self.handle: viser.GuiUplotHandle | None = None
        with tab:
            self._note = gui.add_html("", order=order, visible=False)
        self._order = order
        self._shown: tuple[str, int, float] | None = None
        self._updated = 0.0

    def update(self, history: History) -> None:
        """Draw the run's data, unless nothing is new or the chart still rests."""
        rows = max(len(history.progress), len(history.evaluations))
        state = (history.record.id, rows, history.events[-1].time if history.events else 0.0)
        now = time.monotonic()
        rest = min(_LONGEST_REST, rows / _ROWS_PER_SECOND)
        if state == self._shown or (self._shown and self._shown[0] == state[0] and now - self._updated < rest):
            return
        self._shown, self._updated = state, now
        curves = decimate(self.trace.curves(history), MOST_POINTS)
        if not len(curves[0]):
            self._say(self.trace.empty)
            return
        self._note.visible = False
        if len(curves[0]) == 1:  # a line needs two ends, and uPlot a span
            curves = tuple(np.repeat(c, 2) if i else np.array([c[0], c[0] + 1.0]) for i, c in enumerate(curves))
        if self.handle is None:
            with self._tab:
                self.handle = self._make(curves)
        elif not _equal(self.handle.data, curves):
            self.handle.data = curves
        self.handle.visible = True

    def hide(self) -> None:
        """Take the chart and its note out of sight."""
        self._note.visible = False
        if self.handle is not None:
            self.handle.visible = False
        self._shown = None

    def remove(self) -> None:
        """Delete the chart and its note from the page."""
        self._note.remove()
        if self.handle is not None:
            self.handle.remove()

    def _say(self, sentence: str) -> None:
        self.hide()
        self._note.content = wording.paragraph(f"<b>{wording.text(self.trace.title)}</b><br>{wording.dim(sentence)}")
        self._note.visible = True

    def _make(self, curves: Curves) -> viser.GuiUplotHandle:
        trace = self.trace
        scale = viser.uplot.Scale(auto=True)
        if trace.bounds:
            scale = viser.uplot.Scale(auto=False, range=trace.bounds)
        elif trace.logarithmic:
            scale = viser.uplot.Scale(auto=True, distr=_LOG, log=10)
        series = [viser.uplot.Series(label="iteration")]
        series += [
            viser.uplot.Series(
                label=label, stroke=colour, width=2, points=viser.uplot.Series_Points(show=False), scale="y"
            )
            for label, colour in zip(trace.labels, trace.colours, strict=False)
        ]
        return self._gui.add_uplot(
            curves,
            tuple(series),
            scales={"x": viser.uplot.Scale(time=False), "y": scale},
            axes=(
                viser.uplot.Axis(
                    label="iteration",
                    labelSize=14,
                    labelGap=0,
                    size=22,
                    gap=2,
                    space=40,
                    font=_FONT,
                    labelFont=_FONT,
                    ticks=viser.uplot.Axis_Ticks(size=4),
                ),
                viser.uplot.Axis(
                    scale="y",
                    label=trace.axis,
                    labelSize=16,
                    labelGap=0,
                    size=38,
                    gap=2,
                    space=22,
                    font=_FONT,
                    labelFont=_FONT,
                    ticks=viser.uplot.Axis_Ticks(size=4),
                ),
            ),
            legend=viser.uplot.Legend(show=True, live=True),
            title=trace.title,
            height=_HEIGHT,
            padding=(4, 12, 0, 0),
            order=self._order,
        )


def decimate(curves: Curves, most: int) -> Curves:
    """Return at most `most` points: the last finite value of every series in each stretch of iterations."""
    x = curves[0]
    if len(x) <= most:
        return curves
    edges = np.linspace(0, len(x), most + 1).astype(int)
    return (x[edges[1:] - 1], *(_last_finite(y, edges) for y in curves[1:]))


def _last_finite(y: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return for each stretch edges[i]:edges[i + 1] the last finite value of y, or NaN."""
    last = np.maximum.accumulate(np.where(np.isfinite(y), np.arange(len(y)), -1))[edges[1:] - 1]
    return np.where(last >= edges[:-1], y[last], np.nan)


def _equal(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> bool:
    return len(one) == len(other) and all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))
