"""The traces: how return, success, gradients, divergence and phi went, iteration by iteration."""

import functools
import json
import re
from collections.abc import Sequence

import numpy as np
import viser

from morph_core.catalogue import make_task
from morph_core.history import History
from studio.viewer import wording
from studio.viewer.change import change_table
from studio.viewer.charts import Chart, Curves, Trace
from studio.viewer.parts import COLOURS, Quantity, quantities_of

_FIRST_OF_PHI, _MOST_QUANTITIES = 20, 9
"""Place of the first chart of phi in the column, and the largest number of charts of phi."""


class TracesPanel:
    """A table of the design's change, and a column of charts below it, in one tab."""

    def __init__(self, gui: viser.GuiApi, tab: viser.GuiTabHandle) -> None:
        self._gui = gui
        self._tab = tab
        self._charts: dict[int, Chart] = {}
        self._told: tuple[object, ...] = ()
        with self._tab:
            self.note = gui.add_html("", order=0)
            self.change = gui.add_html("", order=_FIRST_OF_PHI - 5)
        self.clear("no data yet: press Start")

    @property
    def charts(self) -> dict[str, viser.GuiUplotHandle]:
        """Return the handles of the charts that have been made, by title."""
        return {chart.trace.title: chart.handle for chart in self._charts.values() if chart.handle is not None}

    def clear(self, sentence: str) -> None:
        """Show no run, and `sentence` as the reason."""
        self.note.content = wording.paragraph(wording.dim(wording.text(sentence)))
        self.note.visible = True
        self.change.visible = False
        for chart in self._charts.values():
            chart.hide()

    def update(self, history: History, iteration: int, phi: np.ndarray) -> None:
        """Show a run, and how far the design `phi` (d,) of an iteration has come."""
        self.note.visible = False
        told = history.record.id, iteration, phi.tobytes()
        if told != self._told:
            self._told = told
            heading = f"<b>Design φ of iteration {iteration}, against the initial one</b>"
            self.change.content = wording.paragraph(heading) + change_table(history, phi)
        self.change.visible = True
        traces = _traces_of(history)
        for order in [order for order, c in self._charts.items() if _frame(traces.get(order)) != _frame(c.trace)]:
            self._charts.pop(order).remove()
        for order, trace in traces.items():
            if order not in self._charts:
                self._charts[order] = Chart(self._gui, self._tab, trace, order)
            self._charts[order].update(history, iteration)


def _frame(trace: Trace | None) -> object:
    return trace and trace.frame


def _traces_of(history: History) -> dict[int, Trace]:
    """Return the charts of a run, by their place in the column."""
    quantities = quantities_of(history)
    milestones = tuple(history.evaluations[-1].milestones) if history.evaluations else ()
    single = len(quantities) == 1
    return {
        10: Trace(
            "Success on Hw-Phy", "episodes [%]", ("sampled", "deterministic", *map(_plain, milestones)),
            lambda history: _successes(history, milestones), "waiting for the first evaluation", bounds=(-3.0, 103.0),
        ),
        **{_FIRST_OF_PHI + i: _phi_trace(quantity, single) for i, quantity in enumerate(quantities[:_MOST_QUANTITIES])},
        30: Trace(
            "Return on Hw-Phy", "return", ("sampled", "deterministic"), _returns, "waiting for the first evaluation"
        ),
        40: Trace(
            "Agreement of g_task and g_hw", "cosine, share", ("cosine", "share of negative steps"),
            _cosines, "not measured so far by this method", bounds=(-1.05, 1.05),
        ),
        45: Trace(
            "Agreement by design parameter", "cosine", tuple(_plain(name) for name in history.design_space.names),
            _shares, "needs a method with a proxy, and a differentiable Hw-Phy", bounds=(-1.05, 1.05),
            colours=_colours(quantities),
        ),
        50: Trace(
            "Proxy against Hw-Phy: mean squared distance",
            _unit_of_divergence(history.record.task, json.dumps(history.record.task_options, sort_keys=True)),
            ("divergence of the proxy", "search cost"), _divergences, "not measured so far by this method",
            logarithmic=True, colours=("#8a6be0", "#c9a400"),
        ),
    }  # fmt: skip


def _phi_trace(quantity: Quantity, single: bool) -> Trace:
    """Return the chart of one quantity of phi, in the colours that the parts have in the scene."""
    parts = [entry.part.rpartition(" ") for entry in quantity.entries]
    (kind, *others), numbers = {kind for kind, _, _ in parts}, tuple(_plain(number) for _, _, number in parts)
    numbered = kind != "" and not others and all(number.isdigit() for number in numbers)
    short = numbered and not single  # several charts share the column: one line of legend each
    title = f"Design φ: {_plain(quantity.name)}" + (f" by {_plain(kind)}" if short else "")
    return Trace(
        title="Design φ" if single else title,
        axis=f"φ [{_plain(quantity.unit.name)}]",
        labels=numbers if short else tuple(_plain(entry.part) for entry in quantity.entries),
        curves=lambda history: _phis(history, quantity),
        colours=tuple(entry.colour for entry in quantity.entries),
    )


@functools.lru_cache(maxsize=64)
def _unit_of_divergence(task: str, options: str) -> str:
    """Return the unit of D in brackets; z without a single unit is measured in typical steps of each component.

    `options` of the task are JSON.
    """
    try:
        unit = make_task(task, json.loads(options)).z_unit
    except (ValueError, TypeError):  # a task of another version
        return ""
    return f"[{unit}²]" if unit else "[typical step²]"


def _returns(history: History) -> Curves:
    return _columns(history.evaluations, "iteration", "sampled_return", "deterministic_return")


def _successes(history: History, milestones: Sequence[str]) -> Curves:
    """Return the shares of episodes in percent: both policies' success, then the milestones."""
    rows = history.evaluations
    x = np.array([float(e.iteration) for e in rows])
    shares = [
        [e.sampled_success, e.deterministic_success, *(e.milestones.get(name, np.nan) for name in milestones)]
        for e in rows
    ]
    return x, *(100 * np.array(shares, float).reshape(-1, 2 + len(milestones)).T)


def _cosines(history: History) -> Curves:
    return _columns(history.progress, "iteration", "cosine", "cosine_negative")


def _divergences(history: History) -> Curves:
    """Return divergence and search cost without zeros, which a logarithmic axis can't show. A cost stays until the next
    search."""
    x, *columns = _columns(history.progress, "iteration", "divergence", "search_cost")
    divergence, cost = (np.where(d > 0, d, np.nan) for d in columns)
    latest = np.maximum.accumulate(np.where(np.isfinite(cost), np.arange(len(cost)), -1))
    return x, divergence, np.where(latest >= 0, cost[latest], np.nan)


def _columns(rows: Sequence[object], *names: str) -> Curves:
    """Return the fields of the rows as columns, without rows in which none of the values is defined."""
    table = np.array([[_number(getattr(row, name)) for name in names] for row in rows]).reshape(-1, len(names))
    defined = np.isfinite(table[:, 1:]).any(1)
    return tuple(table[defined].T)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else np.nan


def _shares(history: History) -> Curves:
    count = len(history.design_space)
    rows = [p for p in history.progress if p.cosine_by_parameter and len(p.cosine_by_parameter) == count]
    shares = np.array([[_number(share) for share in p.cosine_by_parameter or ()] for p in rows]).reshape(-1, count)
    return np.array([float(p.iteration) for p in rows]), *shares.T


def _phis(history: History, quantity: Quantity) -> Curves:
    """Return a quantity of phi by iteration, in the unit in which it is shown; the first is of the initial design."""
    rows = [p for p in history.progress if len(p.phi) == len(history.design_space)]
    x = np.array([float(history.begins_at), *(p.iteration for p in rows)])
    phi = np.array([history.initial_phi, *(p.phi for p in rows)], dtype=float)
    return x, *(phi[:, entry.index] * quantity.unit.factor for entry in quantity.entries)


def _colours(quantities: Sequence[Quantity]) -> tuple[str, ...]:
    """Return a colour for each parameter: that of its part, if no part has several parameters."""
    if len(quantities) == 1:
        return tuple(entry.colour for entry in quantities[0].entries)
    return COLOURS


def _plain(name: str) -> str:
    """Return a name that comes from a file, without the characters that HTML could take for a tag."""
    return re.sub(r"[<>&\"']", "", name)[:40]
