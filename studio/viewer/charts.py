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

MOST_POINTS = 600
"""Largest number of points of a curve: twice the pixels of a chart, so that the extremes of every pixel are seen."""
_HEIGHT = 122
_ROWS_PER_SECOND = 1000
"""Number of rows for which a chart rests one second: every update resends the whole chart, so a long run is redrawn
less often."""
_WHOLE = tuple(float(digit * 10**power) for power in range(7) for digit in (1, 2, 5))
"""Distances of the marks below a chart: there is no iteration between two others."""
_LONGEST_REST = 2.0
"""Longest time that a chart rests between two updates, in seconds."""
MARK, MARK_COLOUR = "shown", "#8a94a3"
"""Name in the legend and of the scale, and colour, of the upright line at the iteration that is shown."""
_MARK_REST = 0.15
"""Shortest time between two moves of that line, in seconds: each sends the curves again."""
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
        self._curves: Curves = ()
        self._mark = -1
        self._updated = self._marked = 0.0

    def update(self, history: History, iteration: int) -> None:
        """Draw the run's data with an upright line at an iteration, unless nothing is new or the chart still rests."""
        rows = max(len(history.progress), len(history.evaluations))
        state = (history.record.id, rows, history.events[-1].time if history.events else 0.0)
        now = time.monotonic()
        rest = min(_LONGEST_REST, rows / _ROWS_PER_SECOND)
        same = self._shown is not None and self._shown[0] == state[0]
        if state == self._shown or (same and now - self._updated < rest):
            if same and iteration != self._mark and now - self._marked >= _MARK_REST:
                self._draw(iteration)
            return
        self._shown, self._updated = state, now
        self._curves = decimate(self.trace.curves(history), MOST_POINTS)
        if len(self._curves[0]) == 1:  # a line needs two ends, and uPlot a span
            x, *ys = self._curves
            self._curves = np.array([x[0], x[0] + 1.0]), *(np.repeat(y, 2) for y in ys)
        self._draw(iteration)

    def _draw(self, iteration: int) -> None:
        """Send the curves and the line, or say that there is nothing to draw."""
        self._mark, self._marked = iteration, time.monotonic()
        if not len(self._curves[0]):
            self._say(self.trace.empty)
            return
        self._note.visible = False
        curves = marked(self._curves, iteration, logarithmic=self.trace.logarithmic)
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
        if self.handle is not None:
            self.handle.visible = False
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
        drawn = [(label, colour, "y") for label, colour in zip(trace.labels, trace.colours, strict=False)]
        series += [
            viser.uplot.Series(
                label=label, stroke=colour, width=2, points=viser.uplot.Series_Points(show=False), scale=on
            )
            for label, colour, on in (*drawn, (MARK, MARK_COLOUR, MARK))
        ]
        return self._gui.add_uplot(
            curves,
            tuple(series),
            scales={
                "x": viser.uplot.Scale(time=False),
                "y": scale,
                MARK: viser.uplot.Scale(auto=False, range=(0.0, 1.0)),
            },
            axes=(
                viser.uplot.Axis(
                    label="iteration",
                    labelSize=14,
                    labelGap=0,
                    incrs=_WHOLE,
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
            padding=(4, 12, 4, 0),
            order=self._order,
        )


def decimate(curves: Curves, most: int) -> Curves:
    """Return at most `most` points that keep the least and the greatest value of every series.

    The first and the last point stay. Those between are stretches of iterations; two points at the ends of a stretch
    have the least and the greatest finite value of each series in it, in the order in which they came.
    """
    x, *ys = curves
    if len(x) <= most:
        return curves
    stretches = most // 2 - 1
    edges = np.linspace(1, len(x) - 1, stretches + 1).astype(int)
    inner = np.column_stack([x[edges[:-1]], x[edges[1:] - 1]]).ravel()
    thinned = [np.concatenate([y[:1], _extremes(y, edges), y[-1:]]) for y in ys]
    return np.concatenate([x[:1], inner, x[-1:]]), *thinned


def _extremes(y: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return (2 n,) of n stretches edges[i]:edges[i + 1] the least and the greatest finite value, the earlier first."""
    width = int(np.diff(edges).max())
    inside = np.minimum(edges[:-1, None] + np.arange(width), edges[1:, None] - 1)  # the last one repeated
    values = y[inside]
    finite = np.isfinite(values)
    places = np.stack([np.where(finite, values, np.inf).argmin(1), np.where(finite, values, -np.inf).argmax(1)], 1)
    found = np.take_along_axis(values, np.sort(places, 1), 1)
    return np.where(finite.any(axis=1, keepdims=True), found, np.nan).ravel()


def marked(curves: Curves, at: float, *, logarithmic: bool) -> Curves:
    """Return the curves and one more series, an upright line at `at` on a scale of its own from 0 to 1.

    For it points are put in where it crosses the curves, which go through them as they did without them. It has no
    gaps, because uPlot finds no limits for an axis of which a series has one: it lies below its scale elsewhere.
    """
    x, *ys = curves
    at = float(np.clip(at, x[0], x[-1]))
    place = int(np.clip(np.searchsorted(x, at), 1, len(x) - 1))
    share = (at - x[place - 1]) / max(x[place] - x[place - 1], 1e-12)
    crossed = [_between(y[place - 1], y[place], share, logarithmic) for y in ys]
    upright = np.array([-1.0, 2.0, -1.0])
    places = [place] * len(upright)
    longer = [np.insert(y, places, value) for y, value in zip(ys, crossed, strict=True)]
    return np.insert(x, places, at), *longer, np.insert(np.full(len(x), -1.0), places, upright)


def _between(before: float, after: float, share: float, logarithmic: bool) -> float:
    """Return the value that a curve has at a `share` of the way between two of its points."""
    if logarithmic:
        return float(before ** (1 - share) * after**share)
    return float((1 - share) * before + share * after)


def _equal(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> bool:
    return len(one) == len(other) and all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))
