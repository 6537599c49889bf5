"""The A/B panel: a second design of any run beside the one on screen, on one playback clock, and how both differ."""

from collections.abc import Callable, Mapping
from typing import Literal, get_args

import viser

from morph_core.history import History
from morph_core.protocol import Which
from studio.compare import check_alike, compare
from studio.viewer import wording
from studio.viewer.comparison import comparison_table
from studio.viewer.take import SECOND_COLOUR, Shot

View = Literal["off", "side by side", "overlaid"]
Refuse = Callable[[str, viser.ClientHandle | None], None]
_VIEWS = get_args(View)
_NO_RUN: str = ""
_INTRODUCTION = (
    "A is the design on screen, as the timeline has it. Choose a second one, B, or pin the one on screen and go on "
    "along the timeline; both play on one clock."
)


class ComparePanel:
    """The panel that chooses the second of two designs, and says how both differ."""

    def __init__(self, gui: viser.GuiApi, *, on_choice: Callable[[], None], on_refusal: Refuse) -> None:
        """Make the panel where the caller stands; `on_choice` is called when other designs are to be shown."""
        self._on_choice = on_choice
        self._on_refusal = on_refusal
        self._first: tuple[History, int] | None = None
        self._histories: dict[str, History] = {}
        self._second: History | None = None
        self._tabled: tuple[object, ...] = ()
        self.introduction = gui.add_html(wording.paragraph(wording.dim(wording.text(_INTRODUCTION))))
        self.view = gui.add_dropdown("show B", _VIEWS, hint="Beside A, or in its place and tinted")
        self.pin = gui.add_button(
            "Pin the design on screen as B", icon=viser.Icon.PIN, hint="It stays while A goes on along the timeline"
        )
        self.run = gui.add_dropdown("B: run", [_NO_RUN])
        self.iteration = gui.add_slider("B: iteration", 0, 1, 1, 0)
        self.note = gui.add_html("", visible=False)
        self.table = gui.add_html("", visible=False)
        self.view.on_update(lambda event: self._set_view(event.client) if event.client else None)
        self.pin.on_click(lambda event: self._pin(event.client))
        self.run.on_update(lambda event: self._choose_run(event.client) if event.client else None)
        self.iteration.on_update(lambda event: self._choose_iteration(event.client) if event.client else None)

    def update(self, histories: Mapping[str, History], history: History, shown: int) -> None:
        """Offer the runs, and say how the second design differs from that of iteration `shown` of a run."""
        self._first, self._histories = (history, shown), dict(histories)
        if self._second is None or (self.view.value == "off" and self._second.folder.id != history.folder.id):
            self._second = history
            self.iteration.value = history.begins_at
        second = self._second = self._histories.get(self._second.folder.id, self._second)
        options = tuple(dict.fromkeys((*sorted(self._histories, reverse=True), second.folder.id)))
        if tuple(self.run.options) != options:
            self.run.options = options
        self.run.value = second.folder.id
        self.iteration.min = min(second.begins_at, second.iteration)
        self.iteration.max = max(second.iteration, second.begins_at + 1)
        self.iteration.value = max(second.begins_at, min(self.iteration.value, second.iteration))
        self._set_visible(True)
        self._describe()

    def clear(self) -> None:
        """Offer nothing: there is no design on screen that another could be compared with."""
        self._first, self._tabled = None, ()
        self._set_visible(False)
        self._say("There is no design to compare with yet.")

    def second_shot(self, which: Which | None, *, printed: bool) -> tuple[Shot | None, bool]:
        """Return what is to be seen of the second design, or None, and whether it lies over the first one.

        It plays the same kind of episode as the first, `which`, where it has recorded it.
        """
        first, second = self._first, self._second
        if self.view.value == "off" or first is None or second is None or self._why_not():
            return None, False
        iteration, phi = second.design(str(self.iteration.value))
        said = next((e for e in second.evaluations if e.iteration == iteration and e.episode), None)
        known: list[Which] = [recorded.which for recorded in said.recorded] if said else []
        shot = Shot(
            task=second.record.task,
            task_options=_options(second),
            phi=tuple(phi.tolist()),
            episode=(second.folder, iteration) if said else None,
            which=which if which in known else next(iter(known), None),
            printed=printed,
        )
        return shot, self._is_overlaid

    @property
    def _is_overlaid(self) -> bool:
        return self.view.value == "overlaid" and not self._differ_in_options()

    def _differ_in_options(self) -> bool:
        first, second = self._first, self._second
        return first is not None and second is not None and _options(first[0]) != _options(second)

    def _why_not(self) -> str:
        """Return why the second design can't be shown, as a sentence; nothing where it can."""
        first, second = self._first, self._second
        if first is None or second is None:
            return "There is no design to compare with yet."
        if not second.folder.path.is_dir():
            return f"{second.folder.id} is gone: it was deleted or moved. Choose another run for B."
        try:
            check_alike(first[0], second)
            second.design(str(self.iteration.value))
        except ValueError as error:
            return f"{error}."
        return ""

    def _describe(self) -> None:
        """Say which design is which and how they differ, unless that was said already."""
        first, second = self._first, self._second
        if first is None or second is None or self.view.value == "off":
            self._tabled = ()
            self.note.visible = self.table.visible = False
            return
        if reason := self._why_not():
            self._tabled = ()
            self._say(reason, wording.RED)
            return
        history, shown = first
        iteration = self.iteration.value
        said = (
            history.folder.id, shown, len(history.evaluations), second.folder.id, iteration, len(second.evaluations),
            self._is_overlaid,
        )  # fmt: skip
        if said == self._tabled:
            return
        self._tabled = said
        words = [_standing(letter, h, i) for letter, h, i in (("A", history, shown), ("B", second, iteration))]
        if self.view.value == "overlaid" and self._differ_in_options():
            words.append("They run with other options of the task, in other surroundings, so they stand side by side.")
        self._say(" ".join(word for word in words if word))
        found = compare(history, str(shown), second, str(iteration))
        a, b = ("own colours", "tinted") if self._is_overlaid else ("", "")
        self.table.content = comparison_table(found, history, (a, b), SECOND_COLOUR if self._is_overlaid else None)
        self.table.visible = True

    def _say(self, sentence: str, colour: str | None = None) -> None:
        self.note.visible = bool(sentence)
        self.note.content = wording.alert(sentence, colour) if colour else wording.paragraph(wording.text(sentence))
        self.table.visible = False

    def _set_visible(self, visible: bool) -> None:
        for handle in (self.view, self.pin):
            handle.visible = visible
        self.introduction.visible = visible and self.view.value == "off"
        for handle in (self.run, self.iteration):
            handle.visible = visible and self.view.value != "off"

    def _set_view(self, client: viser.ClientHandle | None) -> None:
        if self.view.value not in _VIEWS:
            self._on_refusal(f"unknown view; choose from: {', '.join(_VIEWS)}", client)
            self.view.value = "off"
        self._on_choice()

    def _pin(self, client: viser.ClientHandle | None) -> None:
        if self._first is None:
            self._on_refusal("there is no design on screen to pin", client)
            return
        self._second, iteration = self._first
        self.iteration.max = max(self._second.iteration, iteration, 1)
        self.iteration.value = iteration
        if self.view.value == "off":
            self.view.value = "side by side"
        self._on_choice()

    def _choose_run(self, client: viser.ClientHandle | None) -> None:
        chosen = self._histories.get(self.run.value)
        if chosen is None:
            self._on_refusal(f'unknown run "{self.run.value}"; choose one of the list', client)
        else:
            self._second = chosen
            self.iteration.value = max(chosen.begins_at, min(self.iteration.value, chosen.iteration))
        self._on_choice()

    def _choose_iteration(self, client: viser.ClientHandle | None) -> None:
        second = self._second
        if second and not second.begins_at <= self.iteration.value <= second.iteration:
            said = f"choose {second.begins_at} to {second.iteration}"
            self._on_refusal(f"{second.folder.id} has no iteration {self.iteration.value}; {said}", client)
        self._on_choice()


def _options(history: History) -> tuple[tuple[str, object], ...]:
    return tuple(sorted(history.record.task_options.items()))


def _standing(letter: str, history: History, iteration: int) -> str:
    """Return a sentence on a design that has no recorded episode; nothing of one that has."""
    recorded = [e.iteration for e in history.evaluations if e.episode]
    if iteration in recorded:
        return ""
    nearest = min(recorded, key=lambda i: abs(i - iteration), default=None)
    hint = "none was recorded yet" if nearest is None else f"the nearest one is of iteration {nearest}"
    return f"{letter} stands in its start posture: no episode was recorded at iteration {iteration}, {hint}."
