"""The legend: what the colours of the things in the scene mean."""

from collections.abc import Iterator

import numpy as np

from studio.viewer import wording
from studio.viewer.figure import Figure
from studio.viewer.scene import CONTACT_COLOUR, FORCE_COLOUR, GHOST_COLOURS
from studio.viewer.take import GOAL_LIT, LIT_BY, SECOND_COLOUR, WALL_LIT, Take
from studio.viewer.tint import HIGH, LOW, MIDDLE, Tint

Colour = tuple[int, int, int]


def legend_of(take: Take) -> str:
    """Return the legend of what is in the scene as HTML: a swatch and a word for each colour."""
    entries = [
        f'<span style="white-space:nowrap;margin-right:0.9em">{wording.swatch(colour)} {wording.text(words)}</span>'
        for colour, words in meanings(take)
    ]
    return wording.paragraph(" ".join(entries)) + (_scale(take.shot.tint) if take.shot.tint else "")


def meanings(take: Take) -> Iterator[tuple[Colour, str]]:
    """Yield the colours of the things in the scene, each with the word for it."""
    goal = _colour_of(take.scenery, "goal")
    if goal:
        yield goal, "goal"
        if take.goal_touched.any():
            yield GOAL_LIT, "reached"
    for name, (milestone, light) in LIT_BY.items():
        colour = _colour_of(take.objects, name)
        if colour:
            yield colour, name
            if milestone in take.milestones and take.milestones[milestone].any():
                yield light, milestone
    if np.isfinite(take.contact).any():
        yield CONTACT_COLOUR, "contact"
    if take.touched.any():
        yield WALL_LIT, "wall hit"
    if take.forces:
        yield FORCE_COLOUR, f"contact force, 1 cm is {take.forces.newtons_per_cm:g} N"
    if take.second and take.shot.overlaid:
        yield SECOND_COLOUR, "B, tinted"
    if take.ghost:
        yield GHOST_COLOURS["ghost"], f"{take.shot.ghost_name} design"
    beside = take.shot.beside
    if beside.trail:
        yield GHOST_COLOURS["trail"], "earlier designs"
    if beside.explored:
        yield GHOST_COLOURS["explored"], "explored designs"
    if beside.generation:
        yield GHOST_COLOURS["generation"], "CMA-ES's last generation"


def _scale(tint: Tint) -> str:
    """Return what the colours of the robot's parts mean as HTML: a bar between the words for its ends."""
    stops = ", ".join("rgb({}, {}, {})".format(*colour) for colour in (LOW, MIDDLE, HIGH))
    bar = f'<span style="flex:1;height:0.7em;border-radius:2px;background:linear-gradient(90deg, {stops})"></span>'
    ends = f"<span>{wording.text(tint.low)}</span>{bar}<span>{wording.text(tint.high)}</span>"
    row = f'<div style="display:flex;align-items:center;gap:0.5em;white-space:nowrap">{ends}</div>' if tint.low else ""
    return wording.paragraph(f"colours of the parts: {wording.text(tint.meaning)}{row}")


def _colour_of(figure: Figure, name: str) -> Colour | None:
    """Return the colour of the part of that name, or None if there is none."""
    if name not in figure.names:
        return None
    red, green, blue = (int(c) for c in figure.colours[figure.names.index(name)])
    return red, green, blue
