"""The what-if panel: sliders move the body at once, and the policy of the shown iteration is tried on it."""

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol

import msgspec
import numpy as np
import viser

from morph_core.history import History
from morph_core.protocol import Parameter
from studio.cancellation import Cancellation
from studio.evaluator import EvaluatorError
from studio.viewer import wording
from studio.viewer.curves import Scale, curves_of, legend_of_curves, scale_of
from studio.viewer.newest import Newest
from studio.viewer.once import once
from studio.viewer.outcome import outcome_table
from studio.viewer.parts import Unit, quantities_of, unit_of
from studio.viewer.view import Remembered
from studio.what_if import POLICIES, SweepPoint, WhatIf, Wish

EPISODES, SWEEP_EPISODES = 128, 32
"""Numbers of episodes of an evaluation, and at each value of a sweep."""
_REST = 0.12
"""Seconds for which the sliders have to rest before the policy is tried."""
Refuse = Callable[[str, viser.ClientHandle | None], None]


class Answers(Protocol):
    """What the panel needs of whoever evaluates designs."""

    def warm_up(self) -> None:
        """Make sure that the first answer is quick."""
        ...

    def evaluate(
        self,
        history: History,
        wish: Wish,
        cancellation: Cancellation,
        on_played: Callable[[bytes], None] | None = None,
    ) -> WhatIf:
        """Return how good the policy is on a design; `on_played` is handed an episode of it first."""
        ...

    def sweep(self, history: History, wish: Wish, cancellation: Cancellation) -> Iterator[SweepPoint]:
        """Yield the points of a sweep along each parameter."""
        ...


@dataclass(frozen=True)
class _Row:
    """The inputs of one parameter."""

    parameter: Parameter
    unit: Unit
    slider: viser.GuiSliderHandle[float]
    curves: viser.GuiHtmlHandle


class WhatIfPanel:
    """A slider for each design parameter, and what the policy comes to on the design that they make."""

    def __init__(
        self,
        gui: viser.GuiApi,
        *,
        answers: Answers,
        on_open: Callable[[], None],
        on_change: Callable[[], None],
        on_inject: Callable[[Callable[[], list[float]], viser.ClientHandle | None], None],
        on_branch: Callable[[int, list[float], viser.ClientHandle | None], None],
        on_export: Callable[[int, list[float], viser.ClientHandle], None],
        on_refusal: Refuse,
        turn: AbstractContextManager[object],
    ) -> None:
        """Make the panel.

        `on_open` is called when somebody begins to change a design, `on_change` whenever another body or episode is to
        be shown; the other callbacks do what the buttons say, and refuse by ValueError. `turn` is held, re-entrantly,
        by whoever calls `update`: what people do waits meanwhile, so that sliders and design are of one run.
        """
        self._gui = gui
        self._turn = turn
        self._answers = answers
        self._on_open, self._on_change, self._on_refusal = on_open, on_change, on_refusal
        self._history: History | None = None
        self._iteration = 0
        self._recorded = np.zeros(0)
        self._phi = np.zeros(0)
        self._rows: list[_Row] = []
        self._slots: list[viser.GuiFolderHandle] = []
        self._names: tuple[str, ...] = ()
        self._swept: tuple[np.ndarray, list[SweepPoint]] = np.zeros(0), []
        """The design (d,) through which the last sweep goes, and its points so far."""
        self._before: WhatIf | None = None
        """What the policy came to on the recorded design."""
        self._lock = threading.Lock()
        self.episode: bytes | None = None
        """Episode of the policy on the changed design, as npz; None until there is one."""
        self.open = False
        """Whether a design is being changed."""
        self.found: WhatIf | None = None
        """What the policy came to on the design of the sliders; None until that is known."""
        self.note = gui.add_html("")
        self.begin = gui.add_button(
            "Change this body…", icon=viser.Icon.ADJUSTMENTS, color="blue",
            hint="Move the design by hand and see at once what its policy makes of it; the run goes on as it is",
        )  # fmt: skip
        self.result = gui.add_html("", visible=False)
        self.policy = gui.add_dropdown(
            "policy", POLICIES, visible=False,
            hint="sampled: its actions are drawn, as they are while it learns; deterministic: each is its mean",
        )  # fmt: skip
        self.reset = gui.add_button(
            "Reset", icon=viser.Icon.ARROW_BACK_UP, color="gray", hint="Back to the recorded design"
        )
        self.sweep = gui.add_button(
            "Which parameter limits it?", icon=viser.Icon.CHART_LINE,
            hint="Success and return along each parameter, drawn beside its slider",
        )  # fmt: skip
        self.stop_sweep = gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP, visible=False)
        self.progress = gui.add_progress_bar(0.0, visible=False)
        self.legend = gui.add_html("", visible=False)
        self.sliders = gui.add_folder(None, visible=False)
        self.inject = gui.add_button(
            "Go on from here", icon=viser.Icon.PLAYER_TRACK_NEXT, hint="The running run takes this φ as its design"
        )
        self.branch = gui.add_button(
            "Branch from here", icon=viser.Icon.GIT_BRANCH, hint="Start a new run that begins with this φ"
        )
        self.export = gui.add_button("Export this", icon=viser.Icon.DOWNLOAD, hint="This φ with the policy, as a zip")
        self.leave = gui.add_button("Close", icon=viser.Icon.X, color="gray", hint="Back to what was recorded")
        self._exporting = Newest("what-if-export")
        self.policy.on_update(self._in_turn(lambda event: self._choose_policy(event.client) if event.client else None))
        self.begin.on_click(self._in_turn(lambda _: self.start()))
        self.leave.on_click(self._in_turn(lambda _: self.close()))
        self.reset.on_click(self._in_turn(lambda _: self._set(self._recorded) if self.open else None))
        self.sweep.on_click(self._in_turn(lambda _: self._start_sweep()))
        self.stop_sweep.on_click(self._in_turn(lambda _: self._end_sweep()))
        self.inject.on_click(lambda event: on_inject(self._phi.tolist, event.client))
        self.branch.on_click(once(lambda event: self._branch(on_branch, event.client)))
        self.export.on_click(once(lambda event: self._export(on_export, event.client) if event.client else None))
        self._asking, self._sweeping = Newest("what-if", _REST), Newest("what-if-sweep")
        self._marking = Newest("what-if-marks", _REST)
        self.clear()

    @property
    def remembered(self) -> dict[str, Remembered]:
        """The inputs that a browser finds again as it left them."""
        return {"policy": self.policy}

    @property
    def phi(self) -> np.ndarray:
        """Return the design (d,) of the sliders."""
        return self._phi

    @property
    def is_changed(self) -> bool:
        """Tell whether the design of the sliders is another than the recorded one."""
        return self.open and not np.array_equal(self._phi, self._recorded)

    @property
    def instead(self) -> str:
        """Return what is seen instead of a recorded episode, as words before "of iteration 5"; nothing while closed."""
        if not self.open:
            return ""
        return "a body changed by hand, with the policy" if self.is_changed else "the recorded body, with the policy"

    def clear(self) -> None:
        """Show no run."""
        self._history = None
        self._shut()
        self.begin.visible = False
        self.note.content = wording.paragraph(wording.dim("no data yet: press Start"))

    def update(self, history: History, iteration: int, phi: np.ndarray, *, live: bool, following: bool) -> None:
        """Show a run at the iteration of the timeline, whose design is `phi` (d,).

        Another iteration, or following the run again, gives up the changes.
        """
        another = self._history is None or self._history.record.id != history.record.id
        moved = iteration != self._iteration
        self._history, self._iteration, self._recorded = history, iteration, phi
        if self.open and (another or following):
            self._shut()
        elif self.open and moved:
            self._before = None
            self._set(phi)
        if not self.open:
            self._phi = phi
        self.begin.visible = not self.open
        self.inject.visible = self.open and live
        if not self.open:
            self.note.content = wording.paragraph(
                f"Policy and design of iteration {iteration}. "
                + wording.dim("Change the body by hand: the policy plays on it, and its success is measured.")
            )

    def close(self) -> None:
        """Give up the changes, and show what was recorded."""
        self._shut()
        self._on_change()

    def stop(self) -> None:
        """End the threads of the panel."""
        for thread in (self._asking, self._sweeping, self._marking, self._exporting):
            thread.stop()

    # --- what people do ---

    def _in_turn(self, act: Callable[[Any], object]) -> Callable[[Any], None]:
        """Return what a press or a drag does, done while nothing else changes the panel."""

        def done(event: Any) -> None:
            with self._turn:
                act(event)

        return done

    def _branch(
        self,
        on_branch: Callable[[int, list[float], viser.ClientHandle | None], None],
        client: viser.ClientHandle | None,
    ) -> None:
        if self.open:
            on_branch(self._iteration, self._phi.tolist(), client)

    def _export(
        self, on_export: Callable[[int, list[float], viser.ClientHandle], None], client: viser.ClientHandle
    ) -> None:
        iteration, phi = self._iteration, self._phi.tolist()
        self._exporting.put(lambda _: on_export(iteration, phi, client))  # it takes seconds

    def start(self) -> None:
        """Begin to change the shown design by hand."""
        history = self._history
        if history is None:
            return
        self._on_open()
        self._answers.warm_up()
        names = tuple(p.name for p in history.record.parameters)
        if names != self._names:
            self._build(history)
            self._names = names
        self.open = True
        self._show_open()
        self._set(self._recorded)

    def _build(self, history: History) -> None:
        """Make a slider for each parameter: once for a task, again only when a run of another task is opened."""
        for slot in self._slots:
            slot.remove()
        with self.sliders:
            self._slots = [self._gui.add_folder(None)]
        quantities = quantities_of(history)
        rows: dict[int, _Row] = {}
        with self._slots[0]:
            for quantity in quantities:
                unit = f" [{quantity.unit.name}]" if quantity.unit.name else ""
                if len(quantities) > 1:
                    self._gui.add_html(wording.paragraph(f"<b>{wording.text(quantity.name)}</b>{wording.text(unit)}"))
                for entry in quantity.entries:
                    label = entry.part if len(quantities) > 1 else f"{entry.part}{unit}"
                    rows[entry.index] = self._row(entry.index, history.record.parameters[entry.index], label)
        self._rows = [rows[i] for i in range(len(rows))]

    def _row(self, i: int, p: Parameter, label: str) -> _Row:
        unit = unit_of(p)
        step = 10.0**-unit.digits
        lo, hi = (round(end * unit.factor, unit.digits) for end in (p.hard_lo, p.hard_hi))
        slider = self._gui.add_slider(
            label, lo, hi, step, lo,
            hint=f"{p.name}: from {unit.words(p.hard_lo)} to {unit.words(p.hard_hi)}",
        )  # fmt: skip
        slider.on_update(self._in_turn(lambda event: self._drag(i, event.client) if event.client else None))
        return _Row(p, unit, slider, self._gui.add_html("", visible=False))

    def _choose_policy(self, client: viser.ClientHandle | None) -> None:
        """Try the policy in another way; what was measured of it before says nothing of that."""
        if self.policy.value not in POLICIES:
            self._on_refusal(f"unknown policy; choose from: {', '.join(POLICIES)}", client)
            self.policy.value = POLICIES[0]
        if self.open:
            self._before = None
            self._forget_sweep()
            self._try(self._phi)

    def _drag(self, i: int, client: viser.ClientHandle | None) -> None:
        if i >= len(self._rows):  # of a run of another task, whose slider is gone by now
            return
        row = self._rows[i]
        value, (lo, hi) = row.slider.value, (row.slider.min, row.slider.max)
        if not self.open:
            return
        if not lo <= value <= hi:
            row.slider.value = self._on_slider(row, self._phi[i])
            self._on_refusal(f"{row.parameter.name} must lie inside [{lo:g}, {hi:g}] {row.unit.name}", client)
            return
        if value == self._on_slider(row, self._phi[i]):
            return
        phi = self._phi.copy()
        phi[i] = min(max(value / row.unit.factor, row.parameter.hard_lo), row.parameter.hard_hi)
        self._try(phi)
        self._show_marks()

    def _set(self, phi: np.ndarray) -> None:
        """Move the sliders to a design, and try it."""
        for row, value in zip(self._rows, phi, strict=True):
            row.slider.value = self._on_slider(row, value)
        self._try(phi)
        self._show_marks()

    @staticmethod
    def _on_slider(row: _Row, value: float) -> float:
        return min(max(round(float(value) * row.unit.factor, row.unit.digits), row.slider.min), row.slider.max)

    def _try(self, phi: np.ndarray) -> None:
        """Show a body, and ask what the policy comes to on it."""
        history, iteration, first = self._history, self._iteration, np.array_equal(phi, self._recorded)
        if history is None:
            return
        with self._lock:
            self._phi, self.episode, self.found = phi, None, None
            self._asking.put(lambda cancellation: self._ask(history, iteration, phi, first, cancellation))
        self._on_change()
        self._end_sweep()
        self._show_result()

    def _ask(self, history: History, iteration: int, phi: np.ndarray, first: bool, cancellation: Cancellation) -> None:
        def play(episode: bytes) -> None:
            with self._lock:
                cancellation.check()
                self.episode = episode
            self._on_change()

        wish = Wish(design=str(iteration), episodes=EPISODES, policy=self.policy.value)
        try:
            changed = msgspec.structs.replace(wish, phi=phi.tolist())
            found = self._answers.evaluate(history, changed, cancellation, play)
            self._tell(found, first, cancellation)
            if self._before is None:  # the first drag came before it was known
                self._tell(self._answers.evaluate(history, wish, cancellation), True, cancellation)
        except (ValueError, OSError, EvaluatorError) as error:
            cancellation.check()
            self._show_result(str(error))
            return

    def _tell(self, found: WhatIf, recorded: bool, cancellation: Cancellation) -> None:
        """Show what the policy came to, on the changed or on the recorded body."""
        with self._lock:
            cancellation.check()
            self.found = self.found if recorded and self.is_changed else found
            self._before = found if recorded else self._before
        self._show_result()

    # --- the sweep ---

    def _start_sweep(self) -> None:
        history, iteration, phi = self._history, self._iteration, self._phi
        if history is None or not self.open:
            return
        points: list[SweepPoint] = []
        self._swept = phi, points
        self._show_sweeping(True)
        self._sweeping.put(lambda cancellation: self._sweep(history, iteration, phi, points, cancellation))

    def _sweep(
        self, history: History, iteration: int, phi: np.ndarray, points: list[SweepPoint], cancellation: Cancellation
    ) -> None:
        wish = Wish(
            design=str(iteration), phi=phi.tolist(), episodes=SWEEP_EPISODES, policy=self.policy.value
        )  # fmt: skip
        try:
            for point in self._answers.sweep(history, wish, cancellation):
                cancellation.check()
                points.append(point)
                self.progress.value = 100.0 * point.number / point.of
                if point.number % len(self._rows) == 0:  # all curves have one more point
                    self._show_curves()
        except (ValueError, OSError, EvaluatorError) as error:
            cancellation.check()
            self._on_refusal(str(error), None)
        self._show_sweeping(False)

    def _end_sweep(self) -> None:
        self._sweeping.cancel()
        self._show_sweeping(False)

    def _show_sweeping(self, at_work: bool) -> None:
        self.sweep.visible = self.open and not at_work
        self.stop_sweep.visible = self.progress.visible = self.open and at_work
        if at_work:
            self.progress.value = 0.0

    def _show_curves(self) -> None:
        """Draw what the sweep has found so far."""
        with self._turn:
            self._draw_curves()

    def _draw_curves(self) -> None:
        scale = scale_of(self._swept[1])
        self.legend.visible = scale is not None
        if scale is not None:
            self.legend.content = legend_of_curves(scale, SWEEP_EPISODES, self.policy.value)
        for i in range(len(self._rows)):
            self._show_curve(i, scale)

    def _show_marks(self) -> None:
        """Move the marks of the present design, once the sliders rest: a drag would send all curves many times."""
        if self._swept[1]:
            self._marking.put(lambda _: self._show_curves())

    def _show_curve(self, i: int, scale: Scale | None) -> None:
        row, (phi, points) = self._rows[i], self._swept
        row.curves.visible = scale is not None
        if scale is None:
            return
        p, others = row.parameter, np.arange(len(phi)) != i
        mine = [point for point in list(points) if point.parameter == p.name]
        through = np.array_equal(phi[others], self._phi[others])
        row.curves.content = curves_of(mine, scale, float(self._phi[i]), (p.hard_lo, p.hard_hi), faded=not through)

    # --- what is shown ---

    def _show_open(self) -> None:
        shown = self.result, self.policy, self.reset, self.sweep, self.sliders, self.branch, self.export, self.leave
        for handle in shown:
            handle.visible = self.open
        self.begin.visible = not self.open
        if not self.open:
            for handle in (self.inject, self.stop_sweep, self.progress, self.legend):
                handle.visible = False

    def _shut(self) -> None:
        with self._lock:
            self._asking.cancel()
            self.open, self.episode, self.found, self._before = False, None, None, None
        self._sweeping.cancel()
        self._forget_sweep()
        self._show_open()

    def _forget_sweep(self) -> None:
        self._swept = np.zeros(0), []
        for handle in (self.legend, *(row.curves for row in self._rows)):
            handle.visible = False

    def _show_result(self, trouble: str = "") -> None:
        if not self.open:
            return
        changed = self.is_changed
        self.note.content = wording.paragraph(
            f"Policy of iteration {self._iteration} on "
            + ("<b>a body changed by hand</b>" if changed else "the recorded body")
        )
        if trouble:
            self.result.content = wording.alert(trouble)
        elif self.found is None:
            self.result.content = wording.paragraph(wording.dim(f"measuring success over {EPISODES} episodes…"))
        else:
            self.result.content = outcome_table(self.found, self._before if changed else None)
