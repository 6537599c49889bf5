"""The timeline: which iteration is seen, what happened in the run, and what was in force."""

from collections.abc import Callable, Sequence

import viser

from morph_core.history import History
from studio.moments import Mark, in_force_words, marks_of
from studio.viewer import wording
from studio.viewer.evolution import PACES, Evolution
from studio.viewer.strip import key_of, pointer, strip
from studio.viewer.view import Remembered


class TimelinePanel:
    """The panel that chooses an iteration of the run, with its marks, and plays the evolution."""

    def __init__(
        self,
        gui: viser.GuiApi,
        *,
        on_choice: Callable[[], None],
        on_move: Callable[[], None],
        on_inject: Callable[[Callable[[], list[float]], viser.ClientHandle | None], None],
        on_star: Callable[[int, bool, viser.ClientHandle | None], None],
        on_refusal: Callable[[str, viser.ClientHandle | None], None],
        unrecorded: Callable[[History, int], str],
    ) -> None:
        """Make the panel.

        `on_choice` is called when another design is to be shown, `on_move` when the evolution has gone on to another
        one, `on_inject` when the run is to continue from the shown one, `on_star(iteration, starred, client)` when its
        star is to come or go, and `on_refusal` with a sentence on what can't be done. `unrecorded(history, iteration)`
        says in words what is seen where no episode was recorded.
        """
        self._on_choice = on_choice
        self._on_move = on_move
        self._on_inject = on_inject
        self._on_star = on_star
        self._on_refusal = on_refusal
        self._unrecorded = unrecorded
        self._recorded: list[int] = []
        self._starred: Sequence[int] = ()
        self._marks: list[Mark] = []
        self._drawn: tuple[object, ...] = ()
        self._first = self._latest = 0
        self._place = 0.0
        self._history: History | None = None
        self.evolution = Evolution(self._go_on)
        self.panel = gui.add_panel()
        with self.panel.add_tab("Timeline", viser.Icon.TIMELINE):
            self.what = gui.add_html("")
            self.marks = gui.add_html("")
            self.pointer = gui.add_html("")
            self.iteration = gui.add_slider(
                "iteration", 0, 1, 1, 0, hint="The design of this iteration; the first is the initial one"
            )
            self.follow = gui.add_checkbox("live", True, hint="Show each new design as it comes (L)")
            self.in_force = gui.add_html("")
            self.legend = gui.add_html("")
            self.evolve = gui.add_button(
                "Play the evolution", icon=viser.Icon.PLAYER_TRACK_NEXT,
                hint="The body goes through the iterations, in its start posture",
            )  # fmt: skip
            self.recorded = gui.add_button_group(
                "episodes", ("first", "back", "on", "last"), hint="Only iterations with a recorded episode"
            )
            self.marked = gui.add_button_group(
                "marks", ("previous", "next"), hint="The marks of the timeline but for recorded episodes"
            )
            self.pace = gui.add_slider("pace [1/s]", *PACES, 1, 10, hint="Iterations per second of the evolution")
            self.again = gui.add_checkbox("again and again", True, hint="Begin the evolution anew after its end")
            self.star = gui.add_button("Star this design", icon=viser.Icon.STAR, hint="It stands first in the gallery")
            self.inject = gui.add_button(
                "Continue from this design", icon=viser.Icon.GIT_BRANCH,
                hint="The running run takes this φ as its design from the next iteration on",
            )  # fmt: skip
            self.key = gui.add_html("")
        self._choices = (
            self.follow, self.iteration, self.recorded, self.marked, self.evolve, self.pace, self.again, self.star,
        )  # fmt: skip
        self._told = (self.marks, self.pointer, self.key, self.in_force)
        self.follow.on_update(lambda event: self._follow() if event.client else None)
        self.iteration.on_update(lambda event: self._pick(event.client) if event.client else None)
        self.recorded.on_click(lambda event: self._jump(event.target.value))
        self.marked.on_click(lambda event: self._jump(event.target.value, marks=True))
        self.evolve.on_click(lambda _: self.toggle_evolution())
        self.pace.on_update(lambda event: self._set_pace(event.client))
        self.star.on_click(lambda event: self.toggle_star(event.client))
        self.inject.on_click(lambda event: self.go_on_from_here(event.client))

    @property
    def remembered(self) -> dict[str, Remembered]:
        """The inputs that a browser finds again as it left them."""
        return {"pace": self.pace, "again": self.again}

    @property
    def shown_iteration(self) -> int:
        """Return the iteration whose design is to be shown: the latest one with an episode, or the chosen one."""
        if self.follow.value:
            return self._recorded[-1] if self._recorded else self._latest
        return self.iteration.value

    @property
    def has_episode(self) -> bool:
        """Tell whether an episode is to be played: the shown iteration has one, and the evolution stands still."""
        return self.plays(self.shown_iteration)

    def plays(self, iteration: int) -> bool:
        """Tell whether the recorded episode of an iteration is to be played while that one is shown."""
        return iteration in self._recorded and not self.evolution.playing

    @property
    def wants_episode(self) -> bool:
        """Tell whether somebody stays at an iteration with a policy of which no episode was recorded."""
        held = not self.follow.value and not self.evolution.playing
        return held and self.shown_iteration > self._first and self.shown_iteration not in self._recorded

    def update(self, history: History, *, live: bool, starred: Sequence[int] = (), instead: str = "") -> None:
        """Offer the iterations that a run has recorded, and say which one is shown, or what is seen `instead` of it."""
        another = self._history is None or history.record.id != self._history.record.id
        self._history, self._starred = history, starred
        if another:
            self.evolution.pause()
            self.follow.value = True
        self._first, self._latest = history.begins_at, history.iteration
        self._recorded = [e.iteration for e in history.evaluations if e.episode]
        self.iteration.min, self.iteration.max = self._first, max(self._latest, self._first + 1)
        for handle in (*self._choices, *self._told):
            handle.visible = True
        if self.follow.value or not self._first <= self.iteration.value <= self.iteration.max:
            self.iteration.value = self._known(self.shown_iteration)
        self.inject.visible = live and not self.follow.value
        seen = f"{instead} of iteration {self.shown_iteration}" if instead else self._what()
        self.what.content = wording.paragraph(seen)
        self._mark(history)
        self._tell(history)

    def turn_to(self, iteration: int) -> None:
        """Choose an iteration, or the nearest one that the run has, and follow the newest design no longer."""
        self.evolution.pause()
        self.follow.value = False
        self.iteration.value = self._known(iteration)

    def _known(self, iteration: int) -> int:
        """Return the iteration of the slider that is nearest to another one."""
        return max(self._first, min(iteration, int(self.iteration.max)))

    def clear(self, sentence: str) -> None:
        """Show no run, and `sentence` in its place."""
        self.evolution.pause()
        self._history, self._recorded, self._first, self._latest = None, [], 0, 0
        for handle in (*self._choices, *self._told, self.inject):
            handle.visible = False
        self.what.content = wording.paragraph(wording.text(sentence))

    def stop(self) -> None:
        """End what plays."""
        self.evolution.pause()

    def show_legend(self, legend: str) -> None:
        """Show what the colours of the scene mean; `legend` is HTML."""
        if legend != self.legend.content:
            self.legend.content = legend

    def hold(self) -> None:
        """Stay at the shown iteration instead of following the latest one."""
        shown = self.shown_iteration
        self.evolution.pause()
        self.follow.value, self.iteration.value = False, min(shown, int(self.iteration.max))

    def step(self, iterations: int) -> None:
        """Go some iterations on or back, as far as the run reaches."""
        if self._history is not None:
            self.turn_to(min(self.shown_iteration + iterations, self._latest))
            self._on_choice()

    def go_on_from_here(self, client: viser.ClientHandle | None) -> None:
        """Ask for the run to continue from the shown design."""
        self._on_inject(self._chosen_phi, client)

    def toggle_follow(self) -> None:
        """Begin to follow the latest design, or stop following it."""
        self.follow.value = not self.follow.value
        self._follow()

    def toggle_evolution(self) -> None:
        """Pause the evolution while it plays, else play it: from the start, if the shown design is the latest."""
        if self.evolution.playing:
            self.evolution.pause()
        elif self._history is not None and self._latest > self._first:
            shown = self.shown_iteration
            at_end = self.follow.value or shown >= self._latest
            self._place = float(self._first if at_end else shown)
            self.follow.value = False
            self.evolution.play()
        self._name_evolution()
        self._on_choice()

    def toggle_star(self, client: viser.ClientHandle | None = None) -> None:
        """Star the shown design, or take its star away."""
        if self._history is not None:
            shown = self.shown_iteration
            self._on_star(shown, shown not in self._starred, client)

    def _what(self) -> str:
        if self._history is None:
            return ""
        shown = self.shown_iteration
        if self.evolution.playing:
            return f"design of iteration {shown}, in its start posture: the evolution plays"
        if shown == self._first:
            return "initial design, in its start posture" if not self.has_episode else "initial design"
        if self.has_episode:
            return f"design of iteration {shown}, playing its episode on Hw-Phy"
        return f"design of iteration {shown}, {wording.text(self._unrecorded(self._history, shown))}"

    def _mark(self, history: History) -> None:
        """Draw the marks, unless nothing has happened since they were drawn."""
        drawn = (history.record.id, len(history.events), tuple(self._starred))
        if drawn == self._drawn:
            return
        self._drawn = drawn
        self._marks = marks_of(history, self._starred)
        self.marks.content = strip(self._marks, self._first, self._latest)
        self.key.content = key_of(self._marks)

    def _tell(self, history: History) -> None:
        """Say what is in force at the shown iteration, and offer what can be done there."""
        shown = self.shown_iteration
        self.pointer.content = pointer(shown, self._first, self._latest)
        clauses = wording.text(" · ".join(in_force_words(history, shown)))
        self.in_force.content = wording.paragraph(f"<b>In force at iteration {shown}</b><br>{clauses}")
        self.star.label = "Take the star away" if shown in self._starred else "Star this design"
        self._name_evolution()

    def _name_evolution(self) -> None:
        playing, label = self.evolution.playing, self.evolve.label
        self.evolve.label = "Pause the evolution" if playing else "Play the evolution"
        if self.evolve.label == label:  # an icon takes long to be drawn
            return
        self.evolve.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_TRACK_NEXT

    def _follow(self) -> None:
        self.evolution.pause()
        if self.follow.value:
            self.iteration.value = self._known(self.shown_iteration)
        self._on_choice()

    def _pick(self, client: viser.ClientHandle | None) -> None:
        value = self.iteration.value
        self.evolution.pause()
        if not self._first <= value <= self._latest:
            known = self.shown_iteration if self.follow.value else self._first
            self.iteration.value = min(known, int(self.iteration.max))
            self._on_refusal(f"there is no iteration {value}; choose {self._first} to {self._latest}", client)
            return
        self.follow.value = False
        self._on_choice()

    def _go_on(self, iterations: float) -> bool:
        """Go some iterations on in the evolution; return whether there are more."""
        self._place += iterations
        if self._place >= self._latest + 1:
            if not self.again.value:
                self.iteration.value = self._known(self._latest)
                return False
            self._place = float(self._first)
        shown = self._known(int(self._place))
        if shown != self.iteration.value:
            self.iteration.value = shown
            self.pointer.content = pointer(shown, self._first, self._latest)
            self._on_move()
        return True

    def _jump(self, where: str, *, marks: bool = False) -> None:
        here = self.shown_iteration
        stops = [m.iteration for m in self._marks if m.kind != "episode"] if marks else self._recorded
        goals = {
            "first": lambda: stops[0],
            "back": lambda: max((i for i in stops if i < here), default=stops[0]),
            "on": lambda: min((i for i in stops if i > here), default=stops[-1]),
            "last": lambda: stops[-1],
        }
        goals |= {"previous": goals["back"], "next": goals["on"]}
        if stops and where in goals:
            self.turn_to(goals[where]())
            self._on_choice()

    def _set_pace(self, client: viser.ClientHandle | None) -> None:
        value = self.pace.value
        if not PACES[0] <= value <= PACES[1]:
            self.pace.value = 10
            self._on_refusal(f"the pace must lie inside [{PACES[0]}, {PACES[1]}] iterations/s, not {value:g}", client)
        self.evolution.set_pace(self.pace.value)

    def _chosen_phi(self) -> list[float]:
        if self._history is None:
            raise ValueError("there is no design to continue from")
        _, phi = self._history.design(str(self.shown_iteration))
        return [float(value) for value in self._history.design_space.check(self._history.design_space.clip(phi))]
