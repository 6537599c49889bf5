"""Runs, designs and studies in a notebook: each shows itself there, and draws, runs or exports what it holds.

`train("reacher")` or `open_run(NAME)` is a run; `run.plot()` draws its curves, `run.design("best").view()` shows a
design, live where it can be.
"""

import contextlib
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import numpy as np

from morph_core.curves import Curves
from morph_core.durable import where_written, write_file
from morph_core.history import History
from morph_core.hypertext import table
from morph_core.protocol import Stop
from morph_core.run_folder import RunFolder
from studio.cli.choice import open_run as find
from studio.compare import evaluation_of
from studio.export.bundle import build_bundle, bundle_name, task_of
from studio.export.errors import ExportError
from studio.export.place import write_bundle
from studio.inquest import start_child
from studio.log import sender_here
from studio.new_run import StartRun, prepare_run
from studio.preview import svg_of
from studio.settings import at_home, default_runs
from studio.show.evolution import build_evolution
from studio.show.page import build_page
from studio.sketch import sketch_of
from studio.study.plan import StudyError
from studio.study.report import RUNS, results_at
from studio.trainers import spawn_trainer
from studio.viewer.take import Shot, make_take

_POLL_SECONDS = 0.5
_PICTURE_WIDTH = 480
"""Pixels: width of a still picture."""
_HEIGHTS = 50, 10_000
"""Smallest and largest height of a frame in pixels."""
_SHOWN = 80
"""Characters of a wrong value that are repeated to whoever gave it."""


def train(
    task: str,
    *,
    iterations: int | None = None,
    method: str | None = None,
    preset: str | None = None,
    seed: int = 0,
    settings: Mapping[str, object] | None = None,
    runs: str | Path | None = None,
) -> "Run":
    """Train a new run in the folder `runs`, as `morph-studio train` does, and return it when it has ended.

    How far it is shows below the cell. An interrupt stops it after its iteration, a second one ends it at once. Raise
    ValueError that says what is allowed, RuntimeError with the reason where the training failed.
    """
    if not isinstance(settings, Mapping | None) or not _holds_words([*(settings or {})]):
        raise ValueError(f'settings takes names and values, such as {{"alpha": 0.1}}, not {_shown_short(settings)}')
    wish = StartRun(
        task=task, iterations=iterations, method=method, preset=preset, seed=seed, settings=dict(settings or {})
    )
    folder = _folder_of_runs(runs)
    try:
        prepared = prepare_run(folder, wish)
    except OSError as error:
        raise ValueError(f"no run can be written to {folder}: {error.strerror or error}") from error
    return Run(_trained(prepared))


def open_run(run: str | Path, runs: str | Path | None = None) -> "Run":
    """Return a run by its name in the folder `runs`, or by the path of its folder. ValueError lists the choices."""
    where = _folder_of_runs(runs)
    if runs is not None and not where.is_dir():
        raise ValueError(f"{where} is no folder of runs")
    return Run(find(where, str(_path_of("run", run))))


def open_study(directory: str | Path) -> "StudyResults":
    """Return what a study came to, from its folder or that of its report. ValueError says what is missing."""
    study = StudyResults(_path_of("directory", directory))
    if not any((study.directory / name).is_file() for name in ("study.json", RUNS)):
        results_at(study.directory)  # says so
    return study


@dataclass(frozen=True)
class Run:
    """One run of a folder: a notebook shows what it has come to."""

    history: History

    def design(self, which: str | int = "best") -> "Design":
        """Return the best evaluated design, the "latest" one, or that of an iteration (0 is the initial one).

        Raise ValueError that says what is allowed.
        """
        if not isinstance(which, str | int) or isinstance(which, bool):
            raise ValueError(f'which takes "best", "latest" or an iteration, not {_shown_short(which)}')
        self.history.poll()
        return Design(self.history, *self.history.design(str(which)))

    def plot(self) -> Curves:
        """Return the curves of the run; ImportError names the extra where matplotlib is missing."""
        self.history.poll()
        return self.history.plot()

    def view(self, height: int = 720, file: str | Path | None = None) -> "View":
        """Return the whole evolution of the run, as `morph-studio replay --html` writes it, to be scrubbed and played.

        It has up to 5 MB, which the notebook holds: with `file`, a path below the notebook's folder, it holds that link
        alone. Raise ValueError where it can't be written there, or for a height that is none.
        """
        frame = _Frame.of(height, file)
        self.history.poll()
        return frame.around("The evolution of the run", build_evolution([self.history]).content)

    def _repr_html_(self) -> str:
        self.history.poll()
        return self.history._repr_html_()


@dataclass(frozen=True, eq=False)
class Design:
    """One design of a run: a notebook shows its picture and its numbers."""

    history: History
    iteration: int
    phi: np.ndarray  # (d,)

    def view(self, height: int = 720, file: str | Path | None = None) -> "View":
        """Return the design live, as `morph-studio show` writes it; a still one where nothing of it can run live.

        A live page has 5 MB, which the notebook holds: with `file`, a path below the notebook's folder, it holds that
        link alone. Raise ValueError where it can't be written there, or for a height that is none.
        """
        frame = _Frame.of(height, file)
        try:
            page = build_page(self.history, str(self.iteration))
        except ExportError as error:
            return View(f"<p>{escape(str(error))}. Its picture and its numbers are here.</p>{self._repr_html_()}")
        return frame.around("The design, live", page.content)

    @property
    def picture(self) -> "Picture":
        """The design in its start posture. ValueError says why it can't be built."""
        record = self.history.record
        shot = Shot(record.task, tuple(record.task_options.items()), tuple(self.phi.tolist()))
        return Picture(svg_of(sketch_of(make_take(shot))))

    def export(self, out: str | Path | None = None, formats: Sequence[str] | None = None) -> Path:
        """Write the design as `morph-studio export` does, to a zip or a folder, and return its path.

        Raise ValueError with what disagrees, or with what is allowed.
        """
        if formats is not None and (isinstance(formats, str) or not _holds_words(formats)):
            raise ValueError(f'formats takes a list of names, such as ["mjcf", "stl"], not {_shown_short(formats)}')
        which = str(self.iteration)
        path = (
            _path_of("out", out) if out is not None else self.history.folder.exports / bundle_name(self.history, which)
        )
        return write_bundle(build_bundle(self.history, which, formats), path)

    def _repr_html_(self) -> str:
        space = self.history.at(self.iteration).space
        title = f"Design of iteration {self.iteration}, {self.history.folder.id}"
        numbers = space.table({"initial": self.history.initial_phi, "this design": self.phi}, title)
        evaluation = evaluation_of(self.history, self.iteration)
        measured = evaluation._repr_html_() if evaluation else "<p>It was not evaluated.</p>"
        return f"{self._drawn()}{numbers}{measured}"

    def _drawn(self) -> str:
        """Return the picture, with a sentence before it where the robot can't be put together."""
        try:
            task = task_of(self.history)
        except ExportError as error:
            return f"<p>There is no picture of it: {escape(str(error))}.</p>"
        try:
            task.check_buildable(self.phi)
        except ValueError as error:
            return f"<p>It can't be built: {escape(str(error))}.</p>{self.picture._repr_html_()}"
        return self.picture._repr_html_()


@dataclass(frozen=True)
class Picture:
    """A drawing that a notebook shows."""

    svg: str = field(repr=False)

    def _repr_html_(self) -> str:
        return f'<div style="max-width:{_PICTURE_WIDTH}px">{self.svg}</div>'


@dataclass(frozen=True)
class View:
    """What a notebook shows of a design, live or still."""

    html: str = field(repr=False)

    def _repr_html_(self) -> str:
        return self.html


@dataclass(frozen=True)
class StudyResults:
    """What the runs of a study came to: a notebook shows the tables of its report."""

    directory: Path

    def plot(self, task: str | None = None) -> Curves:
        """Return success and return of all methods on a task, by default the first. StudyError says what is allowed."""
        from studio.study.report.figures.learning import learning_curves

        results = results_at(self.directory)
        wanted = results.tasks[0] if task is None else task
        for drawing in learning_curves(results):
            if drawing.name == f"learning-{wanted}":
                return Curves(drawing.figure)
        raise StudyError(f"{self.directory} holds no curves of {wanted}; its tasks are {', '.join(results.tasks)}")

    def _repr_html_(self) -> str:
        results = results_at(self.directory)
        from studio.study.report.summary import COLUMNS, summary

        headings = [column.heading for column in COLUMNS]
        return "".join(
            table(headings, summary(results, task), f"{self.directory.name}: {task}") for task in results.tasks
        )


def _folder_of_runs(runs: str | Path | None) -> Path:
    return default_runs() if runs is None else _path_of("runs", runs)


def _path_of(name: str, given: object) -> Path:
    """Return the path that was given for an argument. ValueError where it is none."""
    if not isinstance(given, str | Path) or "\0" in str(given) or not str(given):
        raise ValueError(f"{name} takes the path of a file or a folder, not {_shown_short(given)}")
    try:
        return at_home(given)
    except OSError as error:
        raise ValueError(f"{name}: {error.strerror}") from error


def _holds_words(given: object) -> bool:
    return isinstance(given, Sequence) and all(isinstance(word, str) for word in given)


def _shown_short(given: object) -> str:
    """Return a value as it is written in code, or as much of it as a sentence bears."""
    written = repr(given)
    return written if len(written) <= _SHOWN else f"{written[:_SHOWN]}…"


@dataclass(frozen=True)
class _Frame:
    """An iframe for a page of ours, and the file that it loads the page from, if any."""

    height: int
    file: Path | None

    @classmethod
    def of(cls, height: object, file: object) -> "_Frame":
        """Check what was asked for before a page is made. ValueError says what is allowed."""
        low, high = _HEIGHTS
        if not isinstance(height, int) or isinstance(height, bool) or not low <= height <= high:
            raise ValueError(f"height takes a whole number of pixels from {low} to {high}, not {_shown_short(height)}")
        return cls(height, None if file is None else _below(_path_of("file", file)))

    def around(self, title: str, page: bytes) -> View:
        """Return the page in the iframe, where its scripts can reach nothing of the notebook's. ValueError where the
        disk does not take the file."""
        source = f'srcdoc="{escape(page.decode())}"'
        if self.file is not None:
            try:
                write_file(where_written(self.file), page)
            except OSError as error:
                raise ValueError(f"{self.file} can't be written: {error.strerror or error}") from error
            source = f'src="{escape(self.file.as_posix())}"'
        look = f"width:100%;height:{self.height}px;border:1px solid #8a929c"
        return View(f'<iframe title="{title}" sandbox="allow-scripts" style="{look}" {source}></iframe>')


def _below(file: Path) -> Path:
    """Return the path of a page as seen from the notebook's folder. ValueError unless it can lie there."""
    here = Path.cwd()
    target = (here / file).parent.resolve() / file.name
    if not target.is_relative_to(here.resolve()):
        raise ValueError(f"file lies outside {here}, from where a notebook's page can't load it: give a name below it")
    if target.suffix.lower() not in (".html", ".htm") or target.is_dir() or not target.parent.is_dir():
        raise ValueError(f'file takes a name that ends in .html, in a folder that is there, not "{file}"')
    return target.relative_to(here.resolve())


# --- a training below its cell ----------------------------------------------------------------------------------------


def _trained(folder: RunFolder) -> History:
    """Start the trainer of a run, show how far it is, and return the run when it has ended."""
    child = start_child(folder, functools.partial(spawn_trainer, folder))
    history = History(folder)
    show = _shown(history)
    asked = False
    while child.process.poll() is None:
        try:
            time.sleep(_POLL_SECONDS)
            if history.poll():
                show()
        except KeyboardInterrupt:
            if asked:
                child.process.kill()
            else:
                folder.send(Stop(), sender_here("notebook"))
            asked = True
    history.poll()
    show()
    end = child.spoken_end(history)
    if end is None or end.status == "failed":
        raise RuntimeError(f"{folder.id}: {end.message if end else child.cause()}")
    return history


def _shown(history: History) -> Callable[[], None]:
    """Show a run below the cell; what is returned shows it anew. Without IPython nothing is shown."""
    with contextlib.suppress(ImportError):
        from IPython.display import display

        handle = display(history, display_id=True)
        if handle is not None:
            return functools.partial(handle.update, history)
    return lambda: None
