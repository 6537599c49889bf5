"""What a film shows: its sides, its acts, and which body or posture is seen in each frame."""

import functools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.protocol import Evaluation, Which
from morph_core.run_folder import RunFolder, RunFolderError
from morph_core.task import Task
from studio.compare import check_alike
from studio.film.errors import FilmError
from studio.viewer.figure import Figure
from studio.viewer.ghosts import standing
from studio.viewer.parts import has_printed_parts, shows_parts
from studio.viewer.take import FRAMES_PER_SECOND, Shot, Take, make_take

Kind = Literal["evolution", "episode"]
Act = Literal["opening", "evolution", "standing", "episode", "closing"]
SIZES = {".mp4": (1920, 1080), ".gif": (960, 540)}
"""Size in pixels of a film that is not asked to have another one."""
RATES = {".mp4": 30, ".gif": 20}
"""Frames per second of a film that is not asked to have another rate."""
STILL_WIDTH, STILL_DPI = 85.0, 300
"""Width in mm of a still that is not asked to be otherwise, a column of a journal, and its pixels per inch."""
_OPENING, _STANDING, _CLOSING = 1.0, 1.2, 1.5
"""Seconds for which the first picture stands, the last design of an evolution, and the last picture."""
_MOST_BODIES = 240
"""Largest number of bodies that an evolution is drawn with: one takes as long to build as to draw."""
_SEEN = 12
"""Number of bodies, and of moments of an episode, that the camera is pointed by."""
LONGEST = 300.0
"""Seconds of the longest film: rendering one takes several times as long, and its parts lie on the disk meanwhile."""
EVOLUTION = 2.0, 240.0
"""Shortest and longest time in seconds that an evolution itself may take in a film."""
_PER_ITERATION = 0.2
"""Seconds of an iteration, unless that makes the evolution shorter or longer than usual."""
_USUAL = 6.0, 30.0
"""Seconds of an evolution that is not asked to take another time, at least and at most."""


@dataclass(frozen=True)
class Side:
    """One of the runs that are filmed, as far as it had come."""

    run: str
    """Path of the run's folder."""
    until: int
    """Last iteration that is shown."""
    iteration: int | None
    """Iteration whose recorded episode is played; None for none."""
    which: Which | None = None
    """Name of the episode among those that were recorded then; None for the median one, or the only one."""


@dataclass(frozen=True)
class Film:
    """Everything that decides what is seen in a film: equal ones have the same frames."""

    kind: Kind
    sides: tuple[Side, ...]
    """The run, or two runs that are seen side by side."""
    width: int
    """Width in pixels."""
    height: int
    """Height in pixels."""
    fps: int
    """Frames per second."""
    seconds: float
    """Seconds that the evolution takes; 0 in a film of episodes."""


@dataclass(frozen=True)
class Moment:
    """What is seen in a frame of a film."""

    act: Act
    iteration: float
    """Iteration of an evolution; between two of them, the body is between theirs."""
    time: float
    """Seconds since the episode began."""


class Story:
    """One side of a film: the designs and the episode that it shows."""

    def __init__(self, side: Side) -> None:
        """Read the run. Raise FilmError where it holds nothing that can be shown."""
        try:
            self.history = History(RunFolder(Path(side.run)))
        except (RunFolderError, OSError) as error:
            raise FilmError(str(error)) from error
        self.side = side
        progress = [p for p in self.history.progress if p.iteration <= side.until]
        self.iterations = [self.history.begins_at, *(p.iteration for p in progress)]
        self.phis = np.array([self.history.initial_phi, *(p.phi for p in progress)], float)
        self.printed = shows_parts(self.history.record.parameters) and has_printed_parts(self.history)
        self.task = _task_of(self.history)

    @property
    def options(self) -> str:
        """Return the options of the task as JSON."""
        return json.dumps(self.history.record.task_options, sort_keys=True)

    @property
    def evaluations(self) -> list[Evaluation]:
        """Return the evaluations that are shown."""
        return [e for e in self.history.evaluations if e.iteration <= self.side.until]

    def recorded(self, iteration: float) -> int:
        """Return the place among `iterations` of the last one that is not after `iteration`."""
        return int(np.searchsorted(self.iterations, iteration, "right")) - 1

    def between(self, iteration: float) -> np.ndarray:
        """Return the design (d,) at an iteration, or on the straight way from one iteration to the next."""
        return np.array([np.interp(iteration, self.iterations, along) for along in self.phis.T])

    def body(self, iteration: float) -> Take:
        """Return the design at an iteration in its start posture, or the nearest earlier one that can be built.

        Raise FilmError where none can be.
        """
        for place in [None, *range(self.recorded(iteration), -1, -1)]:
            phi = self.between(iteration) if place is None else self.phis[place]
            if self.task.buildable(phi):
                try:
                    return self._take(tuple(phi.tolist()))
                except ValueError:
                    continue
        raise FilmError(f"no design of {self.history.folder.id} can be built with this version of {self.task.name}")

    def exactly(self, iteration: int) -> Take:
        """Return the recorded design of an iteration in its start posture. Raise FilmError if it can't be built."""
        phi = self.phis[self.recorded(iteration)]
        try:
            self.task.check_buildable(phi)
            return self._take(tuple(phi.tolist()))
        except ValueError as error:
            raise FilmError(
                f"the design of iteration {iteration} can't be built: {error}; its numbers are in the table of designs "
                "(GET /api/runs/RUN/designs), and an evolution leaves it out"
            ) from error

    @functools.lru_cache(maxsize=2)  # noqa: B019 - a story lives as long as its film is made
    def _take(self, phi: tuple[float, ...]) -> Take:
        record = self.history.record
        return make_take(Shot(record.task, tuple(record.task_options.items()), phi, printed=self.printed))

    @functools.cached_property
    def episode(self) -> Take | None:
        """The episode that is played; None without one. FilmError where it or its design is no good."""
        side, record = self.side, self.history.record
        if side.iteration is None:
            return None
        phi = tuple(self.history.design(str(side.iteration))[1].tolist())
        shot = Shot(
            record.task, tuple(record.task_options.items()), phi, episode=(self.history.folder, side.iteration),
            which=side.which, printed=self.printed,
        )  # fmt: skip
        try:
            return make_take(shot)
        except RunFolderError as error:
            raise FilmError(f"{error}; the evolution, without --design, needs no episode") from error
        except ValueError as error:
            raise FilmError(
                f"the episode of iteration {side.iteration} can't be shown: {error}; the evolution, without --design, "
                "needs no episode"
            ) from error

    @property
    def ghost(self) -> Figure | None:
        """The initial design, which stands in the background; None where it can't be built."""
        try:
            return standing(self.task.name, self.options, tuple(self.history.initial_phi.tolist()))
        except ValueError:
            return None

    def seen(self, kind: Kind) -> np.ndarray:
        """Return points (n, 3) m that have to be in sight."""
        figures: list[tuple[Figure, Sequence[int]]] = []
        if kind == "evolution":
            for iteration in np.linspace(self.iterations[0], self.iterations[-1], _SEEN):
                take = self.body(float(iteration))
                figures += [(take.robot, [0]), (take.objects, [0])]
        if self.episode is not None:
            moments = np.unique(np.linspace(0, self.episode.frames - 1, _SEEN).astype(int)).tolist()
            figures += [(self.episode.robot, moments), (self.episode.objects, moments)]
        scenery = (self.episode or self.body(self.iterations[0])).scenery
        around = [i for i, name in enumerate(scenery.names) if not name.startswith("table")]
        figures.append((scenery.take(around), [0]))
        return np.concatenate([figure.corners(instants) for figure, instants in figures])


class Script:
    """A film laid out: how many frames it has, and what is seen in each."""

    def __init__(self, film: Film) -> None:
        """Read the runs. Raise FilmError where a side can't be shown, or the film would be too long."""
        self.film = film
        self.stories = [Story(side) for side in film.sides]
        self.first = min(story.iterations[0] for story in self.stories)
        self.last = max(story.iterations[-1] for story in self.stories)
        episode = max((story.episode.duration for story in self.stories if story.episode), default=0.0)
        acts: list[tuple[Act, float]] = [("opening", _OPENING)]
        if film.kind == "evolution":
            acts.append(("evolution", film.seconds))
            acts.append(("standing", _STANDING))
        if episode:
            acts.append(("episode", episode))
        acts.append(("closing", _CLOSING))
        length = sum(seconds for _, seconds in acts)
        if length > LONGEST:
            raise FilmError(
                f"the film would take {length:.0f} s, and the longest one takes {LONGEST:.0f} s: rendering it would "
                "take many times as long; give --seconds fewer, or another episode"
            )
        self.acts: list[tuple[Act, int]] = [(act, max(1, round(seconds * film.fps))) for act, seconds in acts]
        self._has_episode = episode > 0

    @property
    def frames(self) -> int:
        """Number of frames."""
        return sum(count for _, count in self.acts)

    def at(self, frame: int) -> Moment:
        """Return what is seen in a frame, which is counted from 0."""
        begin = 0
        for act, count in self.acts:
            if frame < begin + count:
                return self._moment(act, frame - begin, count)
            begin += count
        raise IndexError(f"the film has {self.frames} frames, so none has the number {frame}")

    def _moment(self, act: Act, frame: int, count: int) -> Moment:
        if act == "episode":
            return Moment(act, self.last, frame / self.film.fps)
        if act == "closing" and self._has_episode:
            return Moment(act, self.last, LONGEST)  # beyond its end: a shorter episode stands still as well
        if act == "evolution":
            bodies = min(count, _MOST_BODIES)
            share = round(frame / count * bodies) / bodies
            return Moment(act, self.first + share * (self.last - self.first), 0.0)
        begins = act == "opening" and self.film.kind == "evolution"
        return Moment(act, self.first if begins else self.last, 0.0)

    def plays(self, moment: Moment) -> bool:
        """Tell whether episodes are seen in a frame; where not, designs stand in their start posture."""
        ends = moment.act == "closing" and self._has_episode
        return self.film.kind == "episode" or moment.act == "episode" or ends

    def picture(self, side: int, moment: Moment) -> tuple[Take, int]:
        """Return the take that is seen on a side, and which of its frames."""
        story = self.stories[side]
        if story.episode is not None and self.plays(moment):
            return story.episode, min(round(moment.time * FRAMES_PER_SECOND), story.episode.frames - 1)
        return story.body(min(moment.iteration, story.iterations[-1])), 0


def plan_evolution(histories: Sequence[History], size: tuple[int, int], fps: int, seconds: float | None = None) -> Film:
    """Return the film of an evolution, or of two side by side; it ends with an episode of the best design.

    Raise FilmError where a run has no iteration, or the tasks differ.
    """
    _check_alike(histories)
    for history in histories:
        if not history.progress:
            raise FilmError(
                f"{history.folder.id} has no iteration yet, so there is no evolution to be seen; a still shows its "
                "initial design"
            )
    iterations = max(h.iteration - h.begins_at for h in histories)
    low, high = _USUAL
    seconds = min(max(_PER_ITERATION * iterations, low), high) if seconds is None else seconds
    sides = tuple(Side(str(h.folder.path.resolve()), h.iteration, _best_recorded(h)) for h in histories)
    return Film("evolution", sides, *size, fps, seconds)


def plan_episode(places: Sequence[tuple[History, str]], which: Which | None, size: tuple[int, int], fps: int) -> Film:
    """Return the film of the episodes of one design or two, each a run and "best", "latest" or an iteration.

    Raise FilmError with the choices where a run has no such design, or recorded no episode of it.
    """
    _check_alike([history for history, _ in places])
    sides = []
    for history, design in places:
        iteration = episode_of(history, design)
        sides.append(Side(str(history.folder.path.resolve()), history.iteration, iteration, which))
    return Film("episode", tuple(sides), *size, fps, 0.0)


def episode_of(history: History, design: str) -> int:
    """Return the iteration of a design, of which an episode was recorded. Raise FilmError with the choices."""
    try:
        iteration, _ = history.design(design)
    except RunFolderError as error:
        raise FilmError(str(error)) from error
    recorded = sorted({e.iteration for e in history.evaluations if e.episode})
    if iteration in recorded:
        return iteration
    if not recorded:
        raise FilmError(
            f"{history.folder.id} has no recorded episode; what still works: the evolution, without --design, and a "
            "still of a design"
        )
    near = sorted(recorded, key=lambda i: abs(i - iteration))[:6]
    raise FilmError(
        f"no episode was recorded of iteration {iteration} of {history.folder.id}; the nearest ones are of "
        f"{', '.join(map(str, sorted(near)))}"
    )


def _best_recorded(history: History) -> int | None:
    """Return the iteration of the episode that shows best what a run came to; None where it recorded none."""
    best, recorded = history.best, [e.iteration for e in history.evaluations if e.episode]
    return best.iteration if best and best.iteration in recorded else max(recorded, default=None)


def _check_alike(histories: Sequence[History]) -> None:
    for other in histories[1:]:
        try:
            check_alike(histories[0], other)
        except ValueError as error:
            raise FilmError(str(error)) from error


def _task_of(history: History) -> Task:
    try:
        return make_task(history.record.task, history.record.task_options)
    except (ValueError, TypeError) as error:
        raise FilmError(f"the task of {history.folder.id} can't be made: {error}") from error
