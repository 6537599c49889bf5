"""The words of a film: what its captions, its legend and its table of phi say in each frame."""

import functools
from dataclasses import dataclass

import numpy as np

from morph_core.protocol import Evaluation
from studio.compare import evaluation_of
from studio.film.plan import Moment, Script, Story
from studio.viewer.legend import meanings
from studio.viewer.parts import quantities_of
from studio.viewer.scene import GHOST_COLOURS
from studio.viewer.take import FRAMES_PER_SECOND, Take
from studio.viewer.wording import percent

Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Caption:
    """What is said of one side of a film."""

    subject: str
    """The run and its method."""
    headline: str
    """The iteration, or the time in the episode."""
    detail: str
    """The success, with how it was measured; of an episode, what it came to."""


@dataclass(frozen=True)
class Row:
    """One design parameter as it is read."""

    name: str
    colour: Colour
    value: str
    """Value with its unit."""
    change: str
    """Change since the initial design, with its unit."""
    share: float
    """Where the value lies in its bounds, from 0 to 1."""
    began: float
    """Where the initial value lies in them."""


@dataclass(frozen=True)
class Group:
    """The design parameters that mean the same of one part each."""

    name: str
    bounds: str
    """Bounds of the first of them, with the unit."""
    rows: tuple[Row, ...]


def title_of(story: Story) -> str:
    """Return what the film is about."""
    title = story.task.title
    return title[:1].upper() + title[1:]


def caption_of(script: Script, side: int, moment: Moment) -> Caption:
    """Return what is said of a side in a frame."""
    story = script.stories[side]
    record = story.history.record
    subject = f"{record.method} · {story.history.folder.id}"
    episode = _episode_shown(script, story, moment)
    if episode is None:
        place = story.recorded(min(moment.iteration, story.iterations[-1]))
        iteration = story.iterations[place]
        headline = f"iteration {iteration} of {story.iterations[-1]}"
        missing = script.film.kind == "evolution" and moment.act == "closing" and story.side.iteration is None
        detail = "no episode was recorded" if missing else success_words(story, iteration)
        return Caption(subject, headline, detail)
    assert story.side.iteration is not None
    time = min(max(moment.time, 0.0), episode.duration)
    headline = f"iteration {story.side.iteration} · {time:.1f} s of {episode.duration:.1f} s"
    return Caption(subject, headline, f"{_episode_words(story)} · {success_words(story, story.side.iteration)}")


def success_words(story: Story, iteration: int) -> str:
    """Return the success at an iteration: its share, of how many episodes, and when it was measured."""
    before = [e for e in story.evaluations if e.iteration <= iteration]
    if before:
        measured = max(e.iteration for e in before)
        said = evaluation_of(story.history, measured) or before[-1]
        when = "" if measured == iteration else f", measured in iteration {measured}"
        return f"success {percent(said.sampled_success)}{_of_episodes(said)}{when}"
    known = [p for p in story.history.progress if p.iteration <= iteration]
    if known:
        return f"success {percent(known[-1].success)} of the iteration's own episodes; not evaluated yet"
    return "initial design, not trained yet"


def _of_episodes(said: Evaluation) -> str:
    return f" of {said.episodes} episodes" if said.episodes else ""


def _episode_words(story: Story) -> str:
    """Return which episode is played, and what it came to."""
    which = story.side.which
    said = [e for e in story.evaluations if e.iteration == story.side.iteration and e.episode]
    recorded = {r.which: r for e in said for r in e.recorded}
    known = recorded.get(which or "median")
    if known is None:
        return f"{which or 'recorded'} episode"
    end = "succeeds" if known.success else "fails"
    return f"{known.which} episode: {end}, return {known.episode_return:.1f}".replace("-", "−")


def _episode_shown(script: Script, story: Story, moment: Moment) -> Take | None:
    """Return the episode that is played in a frame; None where a design stands in its start posture."""
    return story.episode if script.plays(moment) else None


def shown_iteration(script: Script, side: int, moment: Moment) -> int:
    """Return the iteration whose recorded design is said to be seen on a side."""
    story = script.stories[side]
    if _episode_shown(script, story, moment) is not None:
        assert story.side.iteration is not None
        return story.side.iteration
    return story.iterations[story.recorded(min(moment.iteration, story.iterations[-1]))]


def table_of(story: Story, iteration: int) -> list[Group]:
    """Return phi at a recorded iteration, by what it means, in the units in which people read it."""
    phi, began = story.phis[story.recorded(iteration)], story.phis[0]
    parameters = story.history.record.parameters
    low, high = (np.array([getattr(p, end) for p in parameters], float) for end in ("lo", "hi"))
    span = np.where(high > low, high - low, 1.0)
    share, first = np.clip((phi - low) / span, 0, 1), np.clip((began - low) / span, 0, 1)
    groups = []
    for quantity in quantities_of(story.history):
        rows = tuple(
            Row(
                entry.part, _rgb(entry.colour), quantity.unit.words(phi[entry.index]),
                quantity.unit.change(phi[entry.index] - began[entry.index]),
                float(share[entry.index]), float(first[entry.index]),
            )
            for entry in quantity.entries
        )  # fmt: skip
        i = quantity.entries[0].index
        unit = quantity.unit
        groups.append(Group(quantity.name, f"{unit.number(low[i])} to {unit.words(high[i])}", rows))
    return groups


def legend_entries(take: Take, *, ghost: bool) -> list[tuple[Colour, str]]:
    """Return what the colours beside those of the parts mean."""
    found = list(meanings(take))
    return [*found, (GHOST_COLOURS["ghost"], "pale: initial design")] if ghost else found


@functools.lru_cache(maxsize=4)
def success_curve(story: Story) -> list[tuple[int, float]]:
    """Return the success of every evaluation, by its iteration."""
    measured = sorted({e.iteration for e in story.evaluations})
    said = [evaluation_of(story.history, iteration) for iteration in measured]
    return [(e.iteration, e.sampled_success) for e in said if e is not None]


def return_curve(take: Take) -> list[tuple[float, float]]:
    """Return the return so far at the end of every control step of an episode, by the time in seconds."""
    if not take.reward_terms:
        return []
    total = np.cumsum(np.sum(list(take.reward_terms.values()), axis=0))
    times = take.control_dt * np.arange(1, len(total) + 1)
    return [(0.0, 0.0), *zip(times.tolist(), total.tolist(), strict=True)]


def milestone_times(take: Take) -> dict[str, float]:
    """Return when each milestone of an episode is first reached, in seconds of the task's time."""
    found = {name: np.flatnonzero(reached) for name, reached in {**take.milestones, "goal": take.goal_touched}.items()}
    return {name: float(frames[0]) / FRAMES_PER_SECOND for name, frames in found.items() if len(frames)}


def _rgb(css: str) -> Colour:
    """Return the colour of a CSS colour such as #0f7dc2 or rgb(15, 125, 194)."""
    if css.startswith("#"):
        red, green, blue = (int(css[i : i + 2], 16) for i in (1, 3, 5))
        return red, green, blue
    red, green, blue = (round(float(n)) for n in css.removeprefix("rgb(").removesuffix(")").split(","))
    return red, green, blue
