"""evolution.html: the whole evolution of up to four runs of one task in one file that needs no network."""

from collections.abc import Callable, Sequence
from html import escape

import numpy as np

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.task import Task
from studio.shelf.marks import read_marks
from studio.show.bodies import Body, Cast, Played, body_of, episodes_within, packed_designs
from studio.show.course import Course, Designs, course_of, designs_of, packed_course
from studio.show.pack import Pack
from studio.show.prints import Prints, is_printed
from studio.show.sheet import Page, filled, packed_text, picture
from studio.units import unit_of

MOST_RUNS = 4
MOST_DESIGNS = 200
"""Designs whose bodies a page holds, of each run."""
EPISODE_BYTES = 2_400_000
"""Bytes that all recorded episodes of a page take, compressed."""
SCRIPTS = ("page.js", "pack.js", "stage.js", "chart.js", "actors.js", "evolution.js")
STYLES = ("page.css", "evolution.css")
Step = Callable[[str, int, int], None]
"""What is told how far it is: step(run, designs built, designs in all)."""


def check_runs(histories: Sequence[History]) -> None:
    """Raise ValueError that says what is allowed where runs can't be shown side by side."""
    names = [history.folder.id for history in histories]
    if len(histories) > MOST_RUNS:
        raise ValueError(f"at most {MOST_RUNS} runs stand side by side, these are {len(histories)}")
    if len({history.folder.path.resolve() for history in histories}) < len(names):
        raise ValueError(f"a run stands beside others once: {', '.join(names)}")
    tasks = {history.record.task: history.folder.id for history in histories}
    if len(tasks) > 1:
        said = ", ".join(f"{run} of {task}" for task, run in tasks.items())
        raise ValueError(f"runs of one task stand side by side, these are of {len(tasks)}: {said}")


def build_evolution(histories: Sequence[History], step: Step | None = None) -> Page:
    """Return the page of 1 to 4 runs of one task; ValueError says what is allowed.

    What can't be built or read is left out, and the page says so; `step` is told how far it is.
    """
    check_runs(histories)
    pack, missing = Pack(), []
    runs = []
    for history in histories:
        made, lacks = _run(history, EPISODE_BYTES // len(histories), pack, step)
        runs.append(made)
        missing += [f"{history.folder.id}: {sentence}" if len(histories) > 1 else sentence for sentence in lacks]
    first = histories[0]
    names = ", ".join(history.folder.id for history in histories)
    known = {
        "title": escape(str(runs[0]["title"])),
        "runs": escape(names),
        "rule": escape(str(runs[0]["rule"])),
        "missing": escape(" ".join(missing)),
        "picture": "".join(_figure(history) for history in histories),
        "rows": _rows(first),
    }
    document = {"runs": runs, "missing": " ".join(missing)}
    content = filled(
        "evolution.html", known, vendor=("three.js",), scripts=SCRIPTS, styles=STYLES,
        packed={"evolution": packed_text(pack.content(document))},
    )  # fmt: skip
    return Page(content, " ".join(missing))


def _run(history: History, budget: int, pack: Pack, step: Step | None) -> tuple[dict[str, object], list[str]]:
    """Return one run as a page reads it, and sentences on what it lacks."""
    course = course_of(history)
    designs = designs_of(course, MOST_DESIGNS)
    task, lacks = _task(history)
    cast = Cast(Prints.of(task) if task is not None and is_printed(task) else None)
    bodies: list[Body | str] = []
    played: list[Played] = []
    if task is not None:
        for i, phi in enumerate(designs.phi):
            bodies.append(_body(task, phi))
            if step:
                step(history.folder.id, i + 1, len(designs.phi))
        played = episodes_within(history, task, budget, cast.prints)
    shown = packed_designs(bodies, cast, pack) if bodies else None
    episodes = [episode.packed(cast, pack) for episode in played]
    lacks += _left_out(course, designs, len(played), boxed=cast.boxed) + _unbuilt(designs, bodies)
    low, high = _box(bodies, played)
    record = history.record
    return {
        "id": history.folder.id, "name": read_marks(history.folder.path).name or history.folder.id,
        "method": record.method, "seed": record.seed,
        "title": task.title if task else record.task, "rule": task.success_rule if task else "",
        "control_dt": task.control_dt if task else 0.05,
        "low": low, "high": high,
        "course": packed_course(course, designs, task, pack),
        "cast": cast.packed(pack), "designs": shown, "episodes": episodes,
    }, lacks  # fmt: skip


def _task(history: History) -> tuple[Task | None, list[str]]:
    try:
        return make_task(history.record.task, history.record.task_options), []
    except (ValueError, TypeError) as error:
        return None, [f"No body is shown, as the task can't be made here: {error}. The traces and the table are whole."]


def _body(task: Task, phi: np.ndarray) -> Body | str:
    try:
        return body_of(task, phi)
    except ValueError as error:
        return str(error)


def _left_out(course: Course, designs: Designs, episodes: int, *, boxed: bool) -> list[str]:
    """Return sentences on what the page holds less of than the run."""
    lacks, kept = [], "first, last, best and marked ones among them, the others evenly"
    if len(course.progress) < course.total:
        lacks.append(f"Of {course.total:,} iterations the page holds {len(course.progress):,}, {kept}.")
    if len(designs.phi) < designs.total:
        lacks.append(
            f"Of {designs.total:,} different designs the page holds the bodies of {len(designs.phi):,}, {kept}; "
            "an iteration whose body is left out shows the one before."
        )
    recorded = sum(bool(e.episode) for e in course.history.evaluations)
    if not recorded:
        lacks.append("This run recorded no episode, so that its bodies stand in their start posture.")
    elif not episodes:
        lacks.append("No recorded episode can be read, so that bodies stand in their start posture.")
    elif episodes < recorded:
        lacks.append(f"Of {recorded} recorded episodes the page holds {episodes}, first, last and best among them.")
    if boxed:
        lacks.append("Meshes that are too large for the page are drawn as the boxes round them.")
    return lacks


def _unbuilt(designs: Designs, bodies: Sequence[Body | str]) -> list[str]:
    """Return a sentence on the designs that can't be built, if there are any."""
    reasons = [(i, body) for i, body in zip(designs.iterations, bodies, strict=False) if isinstance(body, str)]
    if not reasons:
        return []
    iteration, reason = reasons[0]
    return [
        f"{len(reasons)} of {len(bodies)} designs can't be built and have no body, that of iteration {iteration} "
        f"because {reason}. Their traces and the table are whole."
    ]


def _box(bodies: Sequence[Body | str], played: Sequence[Played]) -> tuple[list[float], list[float]]:
    """Return the corners of what is framed: all designs, the scenery, and the robot's way in the last episode."""
    corners = [corner for body in bodies if not isinstance(body, str) for corner in body.corners]
    robots = [one.body.figures[0] for one in played[-1:]]  # the last knows what it does; the first may be anywhere
    corners += [corner for robot in robots if len(robot) for corner in robot.extent()]
    if not corners:
        return [-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]
    return np.min(corners, 0).tolist(), np.max(corners, 0).tolist()


def _figure(history: History) -> str:
    """Return the best design as a picture, as HTML; nothing where it can't be built."""
    iteration, phi = history.design("best")
    try:
        source = picture(make_task(history.record.task, history.record.task_options), phi)
    except (ValueError, TypeError):
        return ""
    said = f"Run {history.folder.id}: the design of iteration {iteration} in its start posture"
    return f'<img class="still" src="{source}" alt="{escape(said)}" title="{escape(said)}">'


def _rows(history: History) -> str:
    """Return phi of the first run as rows of a table: what a browser without scripts shows."""
    space, (_, best) = history.design_space, history.design("best")
    rows = []
    for i, p in enumerate(space.parameters):
        unit = unit_of(p)
        values = (p.lo, p.hi, history.initial_phi[i], best[i], history.phi[i])
        cells = "".join(f"<td>{unit.number(float(value))}" for value in values)
        rows.append(f"<tr><th scope=row>{escape(p.name)}{cells}<td>{escape(unit.name)}")
    return "".join(rows)
