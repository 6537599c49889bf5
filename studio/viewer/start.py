"""The start panel: everything a new run needs, and one button."""

import contextlib
from collections.abc import Callable

import viser

from morph_core.catalogue import METHODS, TASKS, broken_plugins, make_method, make_task
from morph_core.design import DesignSpace
from morph_core.method import Method
from morph_core.origin import Origin
from morph_core.presets import PRESETS
from morph_core.task import Task
from studio import limits
from studio.cost import CostlyError
from studio.export.design_file import DESIGN_TYPES, Design, phi_for, read_design, starting_from
from studio.fields import fields_of
from studio.new_run import DEFAULT_ITERATIONS, Branch, StartRun, method_at, resettled, space_at
from studio.viewer import wording
from studio.viewer.bounds import BoundsForm
from studio.viewer.once import once
from studio.viewer.parts import shows_parts
from studio.viewer.settings import SettingsForm
from studio.viewer.take import Shot


class StartPanel:
    """Form for a new run; `on_start` is called with a checked request and the client who sent it."""

    def __init__(
        self,
        gui: viser.GuiApi,
        *,
        on_start: Callable[[StartRun, viser.ClientHandle | None], None],
        on_preview: Callable[[], None],
    ) -> None:
        """Make the form; `on_preview` is called when another task, task option or design to start from is chosen."""
        self._on_start = on_start
        self._on_preview = on_preview
        self._gui = gui
        self._design: Design | None = None
        self._origin: Origin | None = None
        self._parent: Method | None = None
        self._bounds: BoundsForm | None = None
        first = next(iter(TASKS))
        task = make_task(first)
        self.folder = gui.add_folder("New run")
        with self.folder:
            self.notice = gui.add_html("", visible=False)
            self.source = gui.add_html("", visible=False)
            self.task = gui.add_dropdown("task", list(TASKS), initial_value=first, hint="What the robot has to do.")
            self.about = gui.add_html("")
            self.options = {name: self._add_options(gui, name) for name in TASKS}
            self.method = gui.add_dropdown("method", list(METHODS), hint=_methods_hint())
            self.preset = gui.add_dropdown("preset", list(PRESETS), hint="One word for a whole set of settings.")
            self.meaning = gui.add_html("")
            self.iterations = gui.add_number(
                "iterations", _usual_iterations(task), min=1, max=limits.MAX_ITERATIONS, step=1,
                hint="Each samples trajectories, learns from them, and searches for the next design.",
            )  # fmt: skip
            self.costly = gui.add_checkbox(
                "costly", False, visible=False, hint="Yes, start it although an iteration takes this long."
            )
            self.start = gui.add_button("Start", color="green", icon=viser.Icon.PLAYER_PLAY)
            self.seed = gui.add_number(
                "seed", 0, min=0, max=limits.LARGEST_SEED, step=1, hint="The same seed gives the same run."
            )
            self._slot = gui.add_folder(None)
            with self._slot:
                self.held = gui.add_folder("Bounds and locks", expand_by_default=False)
            self.settings = SettingsForm(gui)
            self.bring = gui.add_upload_button(
                "Start from a design…", icon=viser.Icon.UPLOAD, mime_type=DESIGN_TYPES,
                hint="A design.json, or an exported zip: the run begins with it instead of the initial design",
            )  # fmt: skip
            self.forget = gui.add_button("Start from the initial design", icon=viser.Icon.X, visible=False)
        self.start.on_click(once(lambda event: self.submit(event.client)))
        self.task.on_update(lambda _: self._choose_task())
        self.method.on_update(lambda _: self._choose_method())
        self.preset.on_update(lambda _: self._choose_method())
        self.seed.on_update(lambda _: self._show_source())
        self._choose_method()
        if broken := broken_plugins():
            self.tell("; ".join(f"plug-in left out: {plugin}" for plugin in broken), wording.AMBER)
        self.bring.on_upload(lambda event: self.take(event.target.value.content))
        self.forget.on_click(lambda _: self._forget())
        for handles in self.options.values():
            for handle in handles.values():
                handle.on_update(lambda _: self._show_beginning())
        self._show_bounds()

    @property
    def begins_as_usual(self) -> bool:
        """Tell whether a run would begin with the task's own design, and with the task's options as they are."""
        return self._origin is None and self._design is None and not self._task_options(self.task.value)

    @property
    def preview(self) -> Shot | None:
        """The design that a run would begin with, in the task and with the options that are chosen; None without."""
        name = self.task.value
        try:
            space = self._space()
            phi = phi_for(self._design, name, space) if self._design else space.initial
        except (ValueError, TypeError):
            return None
        settled = tuple(sorted(self._task_options(name).items()))
        return Shot(name, settled, phi=tuple(phi.tolist()), printed=shows_parts(space.parameters))

    def branch_from(self, origin: Origin | None) -> None:
        """Offer a run that begins at `origin`, with the settings of its parent; None offers one from the beginning.

        Raise ValueError where nothing can be branched from there.
        """
        if origin is None:
            if self._origin is not None:
                self._forget()
            return
        record, method = origin.record, method_at(origin)
        space_at(origin)  # raises where the task has changed
        self.tell(None)
        self._design, self._origin, self._parent = None, origin, method
        self.task.value, self.method.value, self.seed.value = record.task, record.method, record.seed
        goes_on_as_planned = record.env_steps is None and record.iterations > origin.begins_at
        self.iterations.value = record.iterations - origin.begins_at if goes_on_as_planned else DEFAULT_ITERATIONS
        self._choose_method()
        self._show_beginning()

    def take(self, content: bytes) -> None:
        """Begin with the design of a design.json or of a bundle, in its task; say so where it can't be."""
        try:
            design = read_design(content)
            phi_for(design, design.task, make_task(design.task, design.task_options).design_space)
        except (ValueError, TypeError) as error:
            self.tell(str(error))
            return
        self.tell(None)
        self.task.value = design.task
        for name, handle in self.options[design.task].items():
            if name in design.task_options:
                handle.value = str(design.task_options[name])
        self._start_from(design)

    def show_legend(self, legend: str) -> None:
        """Show what the colours of the scene mean; `legend` is HTML."""
        title = wording.dim(wording.text(make_task(self.task.value).title)) if self.task.value in TASKS else ""
        content = wording.paragraph(title) + f'<div style="min-height:2.9em">{legend}</div>'  # Start stays in its place
        if content != self.about.content:
            self.about.content = content

    def request(self) -> StartRun:
        """Return what the form says, or raise ValueError with a sentence that says what is allowed."""
        name, method = self.task.value, self.method.value
        task = make_task(name, self._task_options(name) if name in TASKS else None)
        preset = self._preset()
        settings = self.settings.settings() if method in METHODS else {}
        if self._parent and method == self._parent.name:
            resettled(self._parent, task, settings)
        else:
            make_method(method, task, settings, preset)
        wish = StartRun(
            task=name,
            preset=preset,
            method=method,
            seed=limits.seed(self.seed.value),
            iterations=limits.iterations(self.iterations.value),
            settings=settings,
            task_options=self._task_options(name),
            parameters=list(self._bounds.edited()[1]) or None if self._bounds else None,
            branch=Branch(self._origin.run, self._origin.iteration) if self._origin else None,
            costly=self.costly.visible and self.costly.value,
        )
        return starting_from(self._design, wish, wish.task_options) if self._design else wish

    def submit(self, client: viser.ClientHandle | None) -> None:
        """Hand on what the form says, or show why it is not allowed."""
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
            self._ask_for_yes(isinstance(error, CostlyError))
        else:
            self.tell(None)
            self._ask_for_yes(False)
        finally:
            self.start.disabled = False

    def _ask_for_yes(self, absurd: bool) -> None:
        """Offer a box to say yes to iterations that take absurdly long; it is never ticked when it appears."""
        if absurd != self.costly.visible:
            self.costly.visible, self.costly.value = absurd, False

    def tell(self, sentence: str | None, colour: str = wording.RED) -> None:
        """Show a sentence above the form, where it is in sight, or none."""
        self.notice.visible = sentence is not None
        self.notice.content = wording.alert(sentence, colour) if sentence else ""

    def _add_options(self, gui: viser.GuiApi, task: str) -> dict[str, viser.GuiDropdownHandle]:
        """Add a choice for every option of the task that is one of a few words."""
        return {
            field.name: gui.add_dropdown(
                field.name, [str(choice) for choice in field.choices], initial_value=str(field.default),
                hint=field.doc, visible=task == next(iter(TASKS)),
            )
            for field in fields_of(make_task(task)) if field.choices
        }  # fmt: skip

    def _task_options(self, task: str) -> dict[str, object]:
        """Return the options that differ from the task's defaults: those of the form, and others of the design."""
        if self._origin:
            return dict(self._origin.record.task_options)
        defaults = make_task(task)
        others = self._design.task_options if self._design and self._design.task == task else {}
        chosen = others | {name: handle.value for name, handle in self.options[task].items()}
        return {name: value for name, value in chosen.items() if value != getattr(defaults, name)}

    def _start_from(self, design: Design | None) -> None:
        """Begin with a design, or with the task's own."""
        self._design, self._origin, self._parent = design, None, None
        self._show_beginning()

    def _forget(self) -> None:
        """Begin with the task's initial design, and with what was found to work for the task."""
        self._start_from(None)
        self._choose_task()

    def _space(self) -> DesignSpace:
        """Return the design space of the run; ValueError or TypeError where task or options are no good."""
        name = self.task.value
        return space_at(self._origin) if self._origin else make_task(name, self._task_options(name)).design_space

    def _show_beginning(self) -> None:
        """Show what the run begins with: its bounds, its body, and where they come from."""
        self._show_source()
        self._show_bounds()
        self._on_preview()

    def _show_bounds(self) -> None:
        """Make the inputs for bounds and locks anew, as the run would begin with them."""
        self.held.remove()
        with self._slot:
            self.held = self._gui.add_folder("Bounds and locks", expand_by_default=False)
        self._bounds = None
        with contextlib.suppress(ValueError, TypeError, KeyError), self.held:  # said when the run is started
            self._bounds = BoundsForm(self._gui, self._space())

    def _show_source(self) -> None:
        """Say what the run begins with, where that is not the task's initial design."""
        origin, design = self._origin, self._design
        self.source.visible = self.forget.visible = origin is not None or design is not None
        self.task.disabled = origin is not None
        self.bring.visible = origin is None
        self.iterations.label = "further iterations" if origin else "iterations"
        for task, handles in self.options.items():
            for handle in handles.values():
                handle.visible = origin is None and task == self.task.value
        if origin:
            self.source.content = wording.alert(f"branches {origin.words}: {self._taken(origin)}", wording.BLUE)
        elif design:
            said = f"begins with the design of iteration {design.iteration} of {design.run}"
            self.source.content = wording.alert(said, wording.BLUE)

    def _taken(self, origin: Origin) -> str:
        """Return in words what the branch takes along, with the method that is chosen."""
        if origin.checkpoint is None:
            return "the same run again, but for what is changed here"
        if self.method.value != origin.record.method:
            return "another method counts from 0, with φ, bounds and the weights of policy and critic, where they fit"
        if self.seed.value != origin.record.seed:
            return "counts on with all that was learnt there, and with random numbers of another seed"
        return "counts on with all that was learnt there"

    def _choose_task(self) -> None:
        chosen = self.task.value
        if chosen not in TASKS:
            self.tell(f'unknown task "{chosen}"; choose from: {", ".join(sorted(TASKS))}')
            return
        if self._origin:
            if chosen != self._origin.record.task:  # which a branch keeps
                self.task.value = self._origin.record.task
            return
        if self._design and self._design.task != chosen:
            self._design = None
        self.iterations.value = _usual_iterations(make_task(chosen))
        self._choose_method()
        self._show_beginning()

    def _choose_method(self) -> None:
        """Show the settings of the method that is chosen, as the preset has them."""
        keeps = self._parent is not None and self._parent.name == self.method.value
        has_presets = not keeps and any(preset.method == self.method.value for preset in PRESETS.values())
        self.preset.visible = self.meaning.visible = has_presets
        self.meaning.content = wording.paragraph(wording.dim(PRESETS[self.preset.value].meaning))
        if self.method.value in METHODS and self.task.value in TASKS:
            self.settings.show(make_task(self.task.value), self.method.value, self._preset(), self._parent)
        self._show_source()

    def _preset(self) -> str | None:
        """Return the preset that is chosen; None where the method has none."""
        return self.preset.value if self.preset.visible else None


def _usual_iterations(task: Task) -> int:
    """Return how many iterations a run of the task takes: as long as its schedule falls."""
    return make_method(next(iter(METHODS)), task).schedule.iterations


def _methods_hint() -> str:
    return "; ".join(f"{name}: {METHODS[name].title}" for name in METHODS)
