"""The traces: how return, success, gradients, divergence and phi went, iteration by iteration."""

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import viser
import viser.uplot

from morph_core.history import History
from morph_core.tasks import make_task
from studio.viewer import wording

MOST_POINTS = 2000
SERIES_COLOURS = ("#0f7dc2", "#e07b00", "#17a673", "#c2459b", "#8a6be0", "#c9a400", "#5aa9e6", "#d0342c", "#7a828e")
"""Told apart on white and on black; the first ones also by most colour-blind people."""
_HEIGHT = 118
_ROWS_PER_SECOND = 1000
"""Every update resends a whole chart: long runs are redrawn less often, ..."""
_LONGEST_REST = 2.0
"""... but at least once in so many seconds."""
_FONT = "11px system-ui, sans-serif"
_LOG = 3
"""uPlot's number of a logarithmic scale."""

Curves = tuple[np.ndarray, ...]
"""x (N,), then one y (N,) for each series; NaN where a series has no value."""


@dataclass(frozen=True)
class Trace:
    """One chart: its words, and what it shows of a run."""

    title: str
    axis: str
    labels: tuple[str, ...]
    curves: Callable[[History], Curves]
    empty: str
    """What to say while there is nothing to show."""
    bounds: tuple[float, float] | None = None
    """Fixed limits of y; else it fits itself."""
    logarithmic: bool = False
    colours: tuple[str, ...] = SERIES_COLOURS


class TracesPanel:
    """A column of charts in `tab`."""

    def __init__(self, gui: viser.GuiApi, tab: viser.GuiTabHandle) -> None:
        self._gui = gui
        self._tab = tab
        self._charts: list[_Chart] = []
        self._parameters: tuple[str, ...] = ()
        with self._tab:
            self.note = gui.add_html("", order=0)
        self._charts = [_Chart(gui, self._tab, trace, order) for order, trace in _TRACES.items()]
        self.clear("no data yet: press Start")

    @property
    def charts(self) -> dict[str, viser.GuiUplotHandle]:
        """The charts that have been made, by title."""
        return {chart.trace.title: chart.handle for chart in self._charts if chart.handle is not None}

    def clear(self, sentence: str) -> None:
        """Show no run, and say why."""
        self.note.content = wording.paragraph(wording.dim(wording.text(sentence)))
        self.note.visible = True
        for chart in self._charts:
            chart.hide()

    def update(self, history: History) -> None:
        """Show a run."""
        self.note.visible = False
        names = tuple(history.design_space.names)
        if names != self._parameters:
            self._parameters = names
            for chart in self._charts[len(_TRACES) :]:
                chart.remove()
            self._charts = [
                *self._charts[: len(_TRACES)],
                _Chart(self._gui, self._tab, _phi_trace(history), _PHI_ORDER),
                _Chart(self._gui, self._tab, _share_trace(history), _SHARE_ORDER),
            ]
        for chart in self._charts:
            chart.update(history)


class _Chart:
    """One chart, made when there is something to show: uPlot never recovers from an empty start."""

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
        self._note.visible = False
        if self.handle is not None:
            self.handle.visible = False
        self._shown = None

    def remove(self) -> None:
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
    """Return at most `most` points: of each stretch of iterations the last value of every series."""
    x = curves[0]
    if len(x) <= most:
        return curves
    edges = np.linspace(0, len(x), most + 1).astype(int)
    return (x[edges[1:] - 1], *(_last_finite(y, edges) for y in curves[1:]))


def _last_finite(y: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return for each stretch edges[i]:edges[i + 1] the last finite value of y, or NaN."""
    last = np.maximum.accumulate(np.where(np.isfinite(y), np.arange(len(y)), -1))[edges[1:] - 1]
    return np.where(last >= edges[:-1], y[last], np.nan)


def _returns(history: History) -> Curves:
    return _columns(history.evaluations, "iteration", "sampled_return", "deterministic_return")


def _successes(history: History) -> Curves:
    x, *shares = _columns(history.evaluations, "iteration", "sampled_success", "deterministic_success")
    return x, *(100 * share for share in shares)


def _cosines(history: History) -> Curves:
    return _columns(history.progress, "iteration", "cosine", "cosine_negative")


def _divergences(history: History) -> Curves:
    x, *distances = _columns(history.progress, "iteration", "divergence", "search_cost")
    return x, *(np.where(d > 0, d, np.nan) for d in distances)


def _columns(rows: Sequence[object], *names: str) -> Curves:
    """Return the fields of the rows as columns, without rows in which none of the values is defined."""
    table = np.array([[_number(getattr(row, name)) for name in names] for row in rows]).reshape(-1, len(names))
    defined = np.isfinite(table[:, 1:]).any(1)
    return tuple(table[defined].T)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else np.nan


def _phi_trace(history: History) -> Trace:
    """Return the chart of phi, in the colours that the parameters' parts have in the scene."""
    space = history.design_space
    units = {p.unit for p in space.parameters}
    names = tuple(_plain(name) for name in space.names)
    several = len(units) > 1
    labels = tuple(f"{n} [{p.unit}]" if several else n for n, p in zip(names, space.parameters, strict=True))
    return Trace(
        title="Design φ",
        axis="φ" if several else f"φ [{_plain(units.pop())}]",
        labels=labels,
        curves=_phis,
        empty="",
        colours=_parameter_colours(history),
    )


def _share_trace(history: History) -> Trace:
    """Return the chart of the cosine along what each design parameter moves."""
    return Trace(
        title="Agreement by design parameter",
        axis="cosine",
        labels=tuple(_plain(name) for name in history.design_space.names),
        curves=_shares,
        empty="needs a method with a proxy, and a differentiable Hw-Phy",
        bounds=(-1.05, 1.05),
        colours=_parameter_colours(history),
    )


def _shares(history: History) -> Curves:
    count = len(history.design_space)
    rows = [p for p in history.progress if p.cosine_by_parameter and len(p.cosine_by_parameter) == count]
    shares = np.array([[_number(share) for share in p.cosine_by_parameter or ()] for p in rows]).reshape(-1, count)
    return np.array([float(p.iteration) for p in rows]), *shares.T


def _phis(history: History) -> Curves:
    """Return phi by iteration; iteration 0 is the initial design."""
    rows = [p for p in history.progress if len(p.phi) == len(history.design_space)]
    x = np.array([0.0, *(p.iteration for p in rows)])
    phi = np.array([history.initial_phi, *(p.phi for p in rows)], dtype=float)
    return x, *phi.T


def _parameter_colours(history: History) -> tuple[str, ...]:
    """Return a colour for each parameter: that of the part of the design that bears its name, where there is one."""
    try:
        model = make_task(history.record.task, history.record.task_options).spec(history.initial_phi).compile()
        parts = {model.geom(i).name: 255 * model.geom_rgba[i, :3] for i in range(model.ngeom)}
    except ValueError:  # a task of another version: its traces are still worth seeing
        parts = {}
    colours = {name: f"rgb({r:.0f}, {g:.0f}, {b:.0f})" for name, (r, g, b) in parts.items()}
    names = history.design_space.names
    return tuple(colours.get(name, SERIES_COLOURS[i % len(SERIES_COLOURS)]) for i, name in enumerate(names))


def _plain(name: str) -> str:
    """Return a name of a file without what HTML could take for a tag."""
    return re.sub(r"[<>&\"']", "", name)[:40]


def _equal(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> bool:
    return len(one) == len(other) and all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))


_PHI_ORDER, _SHARE_ORDER = 20, 45
_TRACES = {
    30: Trace("Return on Hw-Phy", "return", ("sampled", "deterministic"), _returns, "waiting for the first evaluation"),
    10: Trace(
        "Success on Hw-Phy", "episodes [%]", ("sampled", "deterministic"), _successes,
        "waiting for the first evaluation", bounds=(-3.0, 103.0),
    ),
    40: Trace(
        "Agreement of g_task and g_hw", "cosine, share", ("cosine", "share of negative steps"),
        _cosines, "not measured so far by this method", bounds=(-1.05, 1.05),
    ),
    50: Trace(
        "Proxy against Hw-Phy", "mean squared distance [m²]", ("divergence of the proxy", "search cost"), _divergences,
        "not measured so far by this method", logarithmic=True, colours=("#8a6be0", "#c9a400"),
    ),
}  # fmt: skip
