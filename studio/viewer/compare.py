"""The A/B panel: a second design of any run beside the one on screen, on one playback clock, and how both differ."""

import time
from collections.abc import Callable, Mapping
from typing import Literal, Protocol, get_args

import viser

from morph_core.history import History
from morph_core.protocol import Evaluation, Which
from studio.compare import check_alike, compare
from studio.viewer import wording
from studio.viewer.comparison import comparison_table
from studio.viewer.fresh import FreshEpisodes
from studio.viewer.take import SECOND_COLOUR, Shot

View = Literal["off", "side by side", "overlaid"]
Refuse = Callable[[str, viser.ClientHandle | None], None]
_VIEWS = get_args(View)
_NO_RUN: str = ""
_RELIST = 5.0
"""Seconds after which the runs are listed anew, of which there may be hundreds."""
_INTRODUCTION = (
    "A is the design on screen, as the timeline has it. Choose a second one, B, or pin the one on screen and go on "
    "along the timeline; both play on one clock."
)


class Others(Protocol):
    """All runs of the folder, of which a browser is told of the newest alone."""

    def of_task(self, task: str) -> Mapping[str, str]:
        """Return what people call each run of a task that can be read, or "", by the run's own name, newest first."""
        ...

    def get(self, run_id: str) -> History:
        """Return a run; raise ValueError that says why it can't be read."""
        ...


class ComparePanel:
    """The panel that chooses the second of two designs, and says how both differ."""

    def __init__(
        self,
        gui: viser.GuiApi,
        *,
        others: Others,
        fresh: FreshEpisodes,
        on_choice: Callable[[], None],
        on_refusal: Refuse,
    ) -> None:
        """Make the panel where the caller stands; `on_choice` is called when other designs are to be shown."""
        self._others = others
        self._fresh = fresh
        self._on_choice = on_choice
        self._on_refusal = on_refusal
        self._first: tuple[History, int] | None = None
        self._histories: dict[str, History] = {}
        self._second: History | None = None
        self._tabled: tuple[object, ...] = ()
        self._listed: dict[str, str] = {}  # a run's words in the list -> its name
        self._listed_at, self._listed_of = 0.0, ""
        self.introduction = gui.add_html(wording.paragraph(wording.dim(wording.text(_INTRODUCTION))))
        self.view = gui.add_dropdown("show B", _VIEWS, hint="Beside A, or in its place and tinted")
        self.pin = gui.add_button(
            "Pin the design on screen as B", icon=viser.Icon.PIN, hint="It stays while A goes on along the timeline"
        )
        self.run = gui.add_dropdown("B: run", [_NO_RUN], hint="Type a part of its name to find it")
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
        self._offer(history.record.task, second.folder.id)
        self.iteration.min = min(second.begins_at, second.iteration)
        self.iteration.max = max(second.iteration, second.begins_at + 1)
        self.iteration.value = max(second.begins_at, min(self.iteration.value, second.iteration))
        self._set_visible(True)
        self._describe()

    @property
    def second_run(self) -> str | None:
        """Return the name of the run of the second design while that is shown."""
        return self._second.folder.id if self._second is not None and self.view.value != "off" else None

    @property
    def wants_episode(self) -> tuple[History, int] | None:
        """Return run and iteration of the second design where it is shown and has no recorded episode."""
        second, iteration = self._second, int(self.iteration.value)
        if self.view.value == "off" or second is None or self._why_not() or iteration <= second.begins_at:
            return None
        return None if _recorded(second, iteration) else (second, iteration)

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
        said = _recorded(second, iteration)
        known: list[Which] = [recorded.which for recorded in said.recorded] if said else []
        shot = Shot(
            task=second.record.task,
            task_options=_options(second),
            phi=tuple(phi.tolist()),
            episode=(second.folder, iteration) if said else None,
            which=which if which in known else next(iter(known), None),
            played=None if said else self._fresh.of(second, iteration),
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
            self._is_overlaid, self._standing("A", history, shown), self._standing("B", second, iteration),
        )  # fmt: skip
        if said == self._tabled:
            return
        self._tabled = said
        words = [self._standing("A", history, shown), self._standing("B", second, iteration)]
        if self.view.value == "overlaid" and self._differ_in_options():
            words.append("They run with other options of the task, in other surroundings, so they stand side by side.")
        self._say(" ".join(word for word in words if word))
        found = compare(history, str(shown), second, str(iteration))
        a, b = ("own colours", "tinted") if self._is_overlaid else ("", "")
        self.table.content = comparison_table(found, history, (a, b), SECOND_COLOUR if self._is_overlaid else None)
        self.table.visible = True

    def _standing(self, letter: str, history: History, iteration: int) -> str:
        """Return a sentence on a design that has no recorded episode; nothing of one that has."""
        if _recorded(history, iteration):
            return ""
        return f"{letter}, iteration {iteration}: {self._fresh.words(history, iteration)}."

    def _offer(self, task: str, chosen: str) -> None:
        """Offer all runs of a task while B is shown, and choose one of them."""
        now = time.monotonic()
        if self.view.value != "off" and (task != self._listed_of or now - self._listed_at > _RELIST):
            self._listed_of, self._listed_at = task, now
            self._listed = {
                f"{words} · {name}" if words else name: name for name, words in self._others.of_task(task).items()
            }
        shown = next((words for words, name in self._listed.items() if name == chosen), chosen)
        options = tuple(dict.fromkeys((*self._listed, shown)))
        if tuple(self.run.options) != options:
            self.run.options = options
        self.run.value = shown

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
        name = self._listed.get(self.run.value)
        try:
            if name is None:
                raise ValueError(f'unknown run "{self.run.value}"; choose one of the list')
            chosen = self._histories.get(name) or self._others.get(name)
        except ValueError as error:
            self._on_refusal(str(error), client)
        else:
            self._second = chosen
            self.iteration.value = self._like_the_first(chosen)
        self._on_choice()

    def _like_the_first(self, chosen: History) -> int:
        """Return the iteration of another run that people mean beside the one on screen: the last one beside the last
        one, else the same, as far as the run has it."""
        first, shown = self._first or (chosen, chosen.iteration)
        return max(chosen.begins_at, chosen.iteration if shown >= first.iteration else min(shown, chosen.iteration))

    def _choose_iteration(self, client: viser.ClientHandle | None) -> None:
        second = self._second
        if second and not second.begins_at <= self.iteration.value <= second.iteration:
            said = f"choose {second.begins_at} to {second.iteration}"
            self._on_refusal(f"{second.folder.id} has no iteration {self.iteration.value}; {said}", client)
        self._on_choice()


def _options(history: History) -> tuple[tuple[str, object], ...]:
    return tuple(sorted(history.record.task_options.items()))


def _recorded(history: History, iteration: int) -> Evaluation | None:
    """Return the evaluation of an iteration that has recorded an episode."""
    return next((e for e in history.evaluations if e.iteration == iteration and e.episode), None)
