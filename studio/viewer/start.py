"""The start panel: everything a new run needs, and one button."""

import dataclasses
import math
import typing
from collections.abc import Callable
from dataclasses import dataclass

import viser

from morph_core.config import Method, Projection, config_from
from morph_core.task import check_settings
from morph_core.tasks import TASKS, make_task
from studio.viewer import wording

_MOST_ITERATIONS = 1_000_000
_LARGEST_SEED = 2**31 - 1


@dataclass(frozen=True)
class StartRequest:
    """A run that somebody wants."""

    task: str
    method: str
    seed: int
    iterations: int
    settings: dict[str, object]
    """Fields of Config."""
    task_options: dict[str, object]
    """Fields of the task's dataclass."""


class StartPanel:
    """The form; `on_start` takes a checked request."""

    def __init__(
        self,
        gui: viser.GuiApi,
        *,
        on_start: Callable[[StartRequest, viser.ClientHandle | None], None],
        on_preview: Callable[[], None],
    ) -> None:
        """`on_preview` is called when another task or task option is chosen."""
        self._on_start = on_start
        self._on_preview = on_preview
        first = next(iter(TASKS))
        task = make_task(first)
        config = task.config
        self.folder = gui.add_folder("New run")
        with self.folder:
            self.notice = gui.add_html("", visible=False)
            self.task = gui.add_dropdown("task", list(TASKS), initial_value=first, hint="What the robot has to do.")
            self.options = {name: self._add_options(gui, name) for name in TASKS}
            self.method = gui.add_dropdown(
                "method", list(typing.get_args(Method)), hint="morph is the paper's; the others are its baselines."
            )
            self.seed = gui.add_number(
                "seed", 0, min=0, max=_LARGEST_SEED, step=1, hint="The same seed gives the same run."
            )
            self.iterations = gui.add_number(
                "iterations", config.schedule_iterations, min=1, max=_MOST_ITERATIONS, step=1
            )
            self.alpha = gui.add_number(
                "α", config.alpha, min=0.0, step=0.1, hint="Weight of the divergence between proxy and Hw-Phy in Eq. 2."
            )
            self.projection = gui.add_dropdown(
                "projection", list(typing.get_args(Projection)), initial_value=config.projection,
                hint="What happens to the task's gradient where it conflicts with the hardware's.",
            )  # fmt: skip
            self.exploration = gui.add_dropdown(
                "exploration", list(task.explorations), initial_value=config.exploration,
                hint="How the hardware's output z is explored.",
            )  # fmt: skip
            self.start = gui.add_button("Start", color="green", icon=viser.Icon.PLAYER_PLAY)
        self.start.on_click(lambda event: self.submit(event.client))
        self.task.on_update(lambda _: self._choose_task())
        for handles in self.options.values():
            for handle in handles.values():
                handle.on_update(lambda _: self._on_preview())

    @property
    def preview(self) -> tuple[str, dict[str, object]] | None:
        """The task and options that are chosen, or None if they are none."""
        task = self.task.value
        if task not in TASKS:
            return None
        try:
            make_task(task, self._task_options(task))
        except ValueError:
            return None
        return task, self._task_options(task)

    def request(self) -> StartRequest:
        """Return what the form says, or raise ValueError with a sentence that says what is allowed."""
        name, method = self.task.value, self.method.value
        task = make_task(name, self._task_options(name) if name in TASKS else None)
        if method not in typing.get_args(Method):
            raise ValueError(f'unknown method "{method}"; choose from: {", ".join(typing.get_args(Method))}')
        settings: dict[str, object] = {
            "alpha": self.alpha.value,
            "projection": self.projection.value,
            "exploration": self.exploration.value,
        }
        check_settings(task, config_from(settings, task.config))
        return StartRequest(
            task=name,
            method=method,
            seed=_whole("seed", self.seed.value, 0, _LARGEST_SEED),
            iterations=_whole("iterations", self.iterations.value, 1, _MOST_ITERATIONS),
            settings=settings,
            task_options=self._task_options(name),
        )

    def submit(self, client: viser.ClientHandle | None) -> None:
        try:
            request = self.request()
        except ValueError as error:
            self.tell(str(error))
            return
        self.tell("starting…", wording.BLUE)
        self.start.disabled = True
        try:
            self._on_start(request, client)
        except (ValueError, OSError) as error:
            self.tell(str(error))
        else:
            self.tell(None)
        finally:
            self.start.disabled = False

    def tell(self, sentence: str | None, colour: str = wording.RED) -> None:
        """Show a sentence above the form, where it is in sight, or none."""
        self.notice.visible = sentence is not None
        self.notice.content = wording.alert(sentence, colour) if sentence else ""

    def _add_options(self, gui: viser.GuiApi, task: str) -> dict[str, viser.GuiDropdownHandle]:
        """Add a choice for every option of the task that is one of a few words."""
        kinds = typing.get_type_hints(TASKS[task])
        choices = {
            field.name: [str(choice) for choice in typing.get_args(kinds[field.name])]
            for field in dataclasses.fields(TASKS[task])
            if field.init and typing.get_origin(kinds[field.name]) is typing.Literal
        }
        defaults = make_task(task)
        return {
            name: gui.add_dropdown(
                name, words, initial_value=getattr(defaults, name), visible=task == next(iter(TASKS))
            )
            for name, words in choices.items()
        }

    def _task_options(self, task: str) -> dict[str, object]:
        """Return the options that differ from the task's defaults."""
        defaults = make_task(task)
        chosen = {name: handle.value for name, handle in self.options[task].items()}
        return {name: value for name, value in chosen.items() if value != getattr(defaults, name)}

    def _choose_task(self) -> None:
        chosen = self.task.value
        if chosen not in TASKS:
            self.tell(f'unknown task "{chosen}"; choose from: {", ".join(sorted(TASKS))}')
            return
        for task, handles in self.options.items():
            for handle in handles.values():
                handle.visible = task == chosen
        task = make_task(chosen)
        config = task.config
        self.exploration.options = list(task.explorations)
        self.alpha.value, self.projection.value = config.alpha, config.projection
        self.exploration.value, self.iterations.value = config.exploration, config.schedule_iterations
        self._on_preview()


def _whole(name: str, value: float, lowest: int, highest: int) -> int:
    if not math.isfinite(value) or value != int(value) or not lowest <= value <= highest:
        raise ValueError(f"{name} must be a whole number from {lowest} to {highest}, not {value}")
    return int(value)
