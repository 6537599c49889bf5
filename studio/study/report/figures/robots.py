"""The robots before and after, drawn side by side as they stand in their scene."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from morph_core.run_folder import RunFolder
from studio.sketch import Disc, Faces, Rod, Shape, Sketch, sketch_of
from studio.study.report.drawing import Drawing, new_figure
from studio.study.report.figures.learning import broken
from studio.study.report.results import Results, RunRow
from studio.viewer.take import Shot, make_take

_PANELS = 4
_MARGIN = 0.03
_ARC = np.linspace(-np.pi / 2, np.pi / 2, 9)


def before_and_after(results: Results, directory: Path) -> Iterator[Drawing]:
    """Yield for each task the initial design, and for each variant the one of its median seed."""
    for task in results.tasks:
        medians = {v: run for v in results.variants if (run := median_run(results.ended(task, v)))}
        sketches = [("initial design", _initial(results, task, medians.values()))]
        for variant, run in medians.items():
            sketches.append((broken(f"{variant}, seed {run.seed}"), _final(results, directory, run)))
        drawn = [(title, sketch) for title, sketch in sketches if sketch]
        if len(drawn) > 1:
            yield _panels(task, drawn)


def median_run(rows: Sequence[RunRow]) -> RunRow | None:
    """Return the run in the middle of those that finished, by success and then by return."""
    finished = [row for row in rows if row.status == "finished" and row.sampled_success is not None]
    ordered = sorted(finished, key=lambda row: (row.score, row.sampled_return or 0.0))
    return ordered[len(ordered) // 2] if ordered else None


def _initial(results: Results, task: str, runs: Any) -> Sketch | None:
    record = next((results.records[run.run] for run in runs), None)
    if record is None:
        return None
    return _sketch(Shot(task, tuple(record.task_options.items()), tuple(p.initial for p in record.parameters)))


def _final(results: Results, directory: Path, run: RunRow) -> Sketch | None:
    """Return the design at the end of its last recorded episode, or in the start posture where none was recorded."""
    phi = tuple(row.final for row in results.designs if row.run == run.run)
    options = tuple(results.records[run.run].task_options.items())
    folder = RunFolder(directory / run.run)
    recorded = max(folder.episode_iterations(), default=None)
    played = _sketch(Shot(run.task, options, phi, (folder, recorded))) if recorded is not None else None
    return played or _sketch(Shot(run.task, options, phi))


def _sketch(shot: Shot) -> Sketch | None:
    """Return the last frame of a shot; None for one that can't be drawn: its task is gone, or its episode damaged."""
    try:
        return sketch_of(make_take(shot), -1)
    except (ValueError, OSError, KeyError):
        return None


def _panels(task: str, drawn: Sequence[tuple[str, Sketch]]) -> Drawing:
    low, high = np.min([s.low for _, s in drawn], 0), np.max([s.high for _, s in drawn], 0)
    margin = _MARGIN * float((high - low).max())
    columns = min(_PANELS, len(drawn))
    each = 9.6 / columns
    height = each * float((high - low)[1] / (high - low)[0])
    figure, axes = new_figure(-(-len(drawn) // columns), columns, min(height + 0.25, 3.2))
    for panel, (title, sketch) in zip(axes.flat, drawn, strict=False):
        for shape in sketch.shapes:
            _paint(panel, shape)
        panel.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
        panel.set_title(title, loc="left")
    for panel in axes.flat:
        panel.set_axis_off()
    return Drawing(
        f"designs-{task}",
        f"{task}: designs before and after",
        "The initial design in its start posture, and of each variant the run in the middle of its seeds (by success, "
        "then return) with the design of its last recorded episode, at that episode's end. All at one scale.",
        figure,
    )


def _paint(panel: Any, shape: Shape) -> None:
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Circle, Polygon

    match shape:
        case Rod(ends=ends, radius=radius, colour=colour):
            panel.add_patch(Polygon(_outline(ends, radius), facecolor=colour / 255, linewidth=0))
        case Disc(centre=centre, radius=radius, colour=colour):
            panel.add_patch(Circle(tuple(centre), radius, facecolor=colour / 255, linewidth=0))
        case Faces(corners=corners, colours=colours):
            panel.add_collection(
                PolyCollection(list(corners), facecolors=colours / 255, edgecolors="face", linewidths=0.3)
            )


def _outline(ends: np.ndarray, radius: float) -> np.ndarray:
    """Return the outline (n, 2) of a rod."""
    along = ends[1] - ends[0]
    turn = np.arctan2(along[1], along[0])
    caps = [
        end + radius * np.stack([np.cos(_ARC + turn + flip), np.sin(_ARC + turn + flip)], 1)
        for end, flip in ((ends[1], 0.0), (ends[0], np.pi))
    ]
    return np.concatenate(caps)
