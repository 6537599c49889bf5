"""The timeline: which design is seen."""

import math
from collections.abc import Callable, Sequence

import viser

from morph_core.history import History
from studio.viewer import wording
from studio.viewer.parts import has_printed_parts, shows_parts
from studio.viewer.view import Remembered

_TRAIL = 6
"""Largest number of earlier designs that are shown at once."""


class TimelinePanel:
    """The panel that chooses an iteration of the run and what is shown beside its design."""

    def __init__(
        self,
        gui: viser.GuiApi,
        *,
        on_choice: Callable[[], None],
        on_inject: Callable[[Callable[[], list[float]], viser.ClientHandle | None], None],
        on_refusal: Callable[[str, viser.ClientHandle | None], None],
    ) -> None:
        """Make the panel.

        `on_choice` is called when another design is to be shown, `on_inject` when the run is to continue from the shown
        one, and `on_refusal` with a sentence on what can't be done.
        """
        self._on_choice = on_choice
        self._on_refusal = on_refusal
        self._recorded: list[int] = []
        self._first = self._latest = 0
        self._history: History | None = None
        self.panel = gui.add_panel()
        with self.panel.add_tab("Timeline", viser.Icon.TIMELINE):
            self.what = gui.add_html("")
            self.legend = gui.add_html("")
            self.follow = gui.add_checkbox("follow latest", True, hint="Show each new design as it comes (F)")
            self.iteration = gui.add_slider(
                "iteration", 0, 1, 1, 0, hint="The design of this iteration; the first is the initial one"
            )
            self.recorded = gui.add_button_group(
                "episodes", ("first", "back", "on", "last"), hint="Only iterations with a recorded episode"
            )
            self.printed = gui.add_checkbox(
                "printed parts", True, hint="What is exported to be printed; otherwise the simulated collision shapes"
            )
            self.ghost = gui.add_checkbox("initial design as ghost", True)
            self.trail = gui.add_checkbox("earlier designs", False)
            self.population = gui.add_checkbox(
                "explored designs", False, hint="Some of the designs that this iteration's episodes were run with"
            )
            self.inject = gui.add_button(
                "Continue from this design", icon=viser.Icon.GIT_BRANCH,
                hint="The running run takes this φ as its design from the next iteration on",
            )  # fmt: skip
        layers = (self.printed, self.ghost, self.trail, self.population)
        self._has_printed_parts = True
        self._choices = (self.follow, self.iteration, self.recorded, *layers)
        self.follow.on_update(lambda event: on_choice() if event.client else None)
        self.iteration.on_update(lambda event: self._pick(event.client) if event.client else None)
        self.recorded.on_click(lambda event: self._jump(event.target.value))
        for layer in layers:
            layer.on_update(lambda _: on_choice())
        self.inject.on_click(lambda event: on_inject(self._chosen_phi, event.client))

    @property
    def remembered(self) -> dict[str, Remembered]:
        """The inputs that a browser finds again as it left them."""
        return {"ghost": self.ghost, "trail": self.trail, "population": self.population}

    @property
    def shown_iteration(self) -> int:
        """Return the iteration whose design is to be shown: the latest one with an episode, or the chosen one."""
        if self.follow.value:
            return self._recorded[-1] if self._recorded else self._latest
        return self.iteration.value

    @property
    def has_episode(self) -> bool:
        """Tell whether the shown iteration has a recorded episode."""
        return self.shown_iteration in self._recorded

    def update(self, history: History, *, live: bool, by_hand: bool = False) -> None:
        """Offer the iterations that a run has recorded, and say which one is shown, or was changed `by_hand`."""
        another = self._history is None or history.record.id != self._history.record.id
        self._history = history
        if another:
            self.follow.value = True
            self.printed.value = shows_parts(history.record.parameters)
            self._has_printed_parts = has_printed_parts(history)
        self._first, self._latest = history.begins_at, history.iteration
        self._recorded = [e.iteration for e in history.evaluations if e.episode]
        self.iteration.min, self.iteration.max = self._first, max(self._latest, self._first + 1)
        for handle in self._choices:
            handle.visible = handle is not self.printed or self._has_printed_parts
        if self.follow.value or not self._first <= self.iteration.value <= self.iteration.max:
            self.iteration.value = self._known(self.shown_iteration)
        self.inject.visible = live and not self.follow.value
        changed = f"a body changed by hand, with the policy of iteration {self.shown_iteration}"
        self.what.content = wording.paragraph(changed if by_hand else self._what())

    def turn_to(self, iteration: int) -> None:
        """Choose an iteration, or the nearest one that the run has, and follow the newest design no longer."""
        self.follow.value = False
        self.iteration.value = self._known(iteration)

    def _known(self, iteration: int) -> int:
        """Return the iteration of the slider that is nearest to another one."""
        return max(self._first, min(iteration, int(self.iteration.max)))

    def clear(self, sentence: str) -> None:
        """Show no run, and `sentence` in its place."""
        self._history, self._recorded, self._first, self._latest = None, [], 0, 0
        for handle in (*self._choices, self.inject):
            handle.visible = False
        self.what.content = wording.paragraph(wording.text(sentence))

    def earlier(self, history: History) -> list[tuple[float, ...]]:
        """Return some of the designs before the shown one, or none unless earlier designs are wanted."""
        if not self.trail.value:
            return []
        before = [tuple(p.phi) for p in history.progress if p.iteration < self.shown_iteration]
        step = max(1, math.ceil(len(before) / _TRAIL))
        return before[::step]

    def show_legend(self, legend: str) -> None:
        """Show what the colours of the scene mean; `legend` is HTML."""
        if legend != self.legend.content:
            self.legend.content = legend

    def hold(self) -> None:
        """Stay at the shown iteration instead of following the latest one."""
        shown = self.shown_iteration
        self.follow.value, self.iteration.value = False, min(shown, int(self.iteration.max))

    def toggle_follow(self) -> None:
        """Begin to follow the latest design, or stop following it."""
        self.follow.value = not self.follow.value
        self._on_choice()

    def _what(self) -> str:
        if self._history is None:
            return ""
        shown = self.shown_iteration
        if shown == self._first:
            return "initial design, in its start posture" if not self.has_episode else "initial design"
        if self.has_episode:
            return f"design of iteration {shown}, playing its episode on Hw-Phy"
        nearest = min(self._recorded, key=lambda i: abs(i - shown), default=None)
        hint = f" (the nearest one is of iteration {nearest})" if nearest is not None else " yet"
        return f"design of iteration {shown}, in its start posture: no episode was recorded{hint}"

    def _pick(self, client: viser.ClientHandle | None) -> None:
        value = self.iteration.value
        if not self._first <= value <= self._latest:
            known = self.shown_iteration if self.follow.value else self._first
            self.iteration.value = min(known, int(self.iteration.max))
            self._on_refusal(f"there is no iteration {value}; choose {self._first} to {self._latest}", client)
            return
        self.follow.value = False
        self._on_choice()

    def _jump(self, where: str) -> None:
        steps: dict[str, Callable[[Sequence[int], int], int]] = {
            "first": lambda recorded, _: recorded[0],
            "back": lambda recorded, here: max((i for i in recorded if i < here), default=recorded[0]),
            "on": lambda recorded, here: min((i for i in recorded if i > here), default=recorded[-1]),
            "last": lambda recorded, _: recorded[-1],
        }
        if not self._recorded or where not in steps:
            return
        goal = steps[where](self._recorded, self.shown_iteration)
        self.follow.value = False
        self.iteration.value = goal
        self._on_choice()

    def _chosen_phi(self) -> list[float]:
        if self._history is None:
            raise ValueError("there is no design to continue from")
        _, phi = self._history.design(str(self.shown_iteration))
        return [float(value) for value in self._history.design_space.check(self._history.design_space.clip(phi))]
