"""A frame of a film as a picture: the scenes, their captions, the curves, the table of phi and the legend."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from studio.film.lens import Box, Lens
from studio.film.plan import Film, Moment, Script
from studio.film.sheet import DIM, FAINT, GROUND, INK, LINE, UNITS, Sheet
from studio.film.stage import Stage
from studio.film.words import (
    Colour,
    Group,
    Row,
    caption_of,
    legend_entries,
    milestone_times,
    return_curve,
    shown_iteration,
    success_curve,
    table_of,
    title_of,
)
from studio.viewer.scene import OBLIQUE, is_flat
from studio.viewer.take import Take

A, B = (0, 95, 170), (205, 92, 0)
"""Colours of two sides, which nearly all colour-blind people tell apart."""
_EDGE = 40.0
"""Units that stay free at the edges of a picture."""
_COLUMN = 640.0
"""Width of the column beside a single scene."""
_STRIP = 372.0
"""Height of the strip below two scenes."""
_ROW, _LOWEST_ROW = 47.0, 27.0
"""Height of a line of the table, and of one in a table that has many."""
_ROUND = 0.95
"""Radius of what is drawn of a table, as a share of how far from its middle anything gets."""
_TITLED = 0.22
"""Share of a level axis that its title takes."""
_LABELS = 74.0
"""Width that the values beside an upright axis take."""
_CLOSE = 130.0
"""Distance of two milestones in a chart within which their names would run into each other's lines."""
_TILT = math.radians(16)
"""Angle by which the camera leans from straight above where everything lies in one plane."""


@dataclass(frozen=True)
class _Axis:
    """The scale of a chart."""

    title: str
    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]

    def share(self, values: np.ndarray) -> np.ndarray:
        """Return where values (n,) lie on the axis, from 0 to 1."""
        return (values - self.low) / max(self.high - self.low, 1e-12)


class Pages:
    """The frames of a film as pictures. What has been drawn stays as long as it may be seen again."""

    def __init__(self, script: Script) -> None:
        """Point the cameras, which stand still."""
        self._script, self._film = script, script.film
        self._pair = len(script.stories) > 1
        self._unit = self._film.height / UNITS
        self._wide = self._film.width / self._unit
        self._panes = _panes(self._film)
        self._stages = self._make_stages()
        self._seen: list[tuple[Take, int, Image.Image] | None] = [None] * len(script.stories)
        self._axes = self._make_axes()
        self._newest: tuple[Moment, Image.Image] | None = None

    def frame(self, number: int) -> Image.Image:
        """Return a frame, which is counted from 0."""
        moment = self._script.at(number)
        if self._newest is None or self._newest[0] != moment:
            self._newest = moment, self._drawn(moment)
        return self._newest[1]

    def _drawn(self, moment: Moment) -> Image.Image:
        sheet = Sheet(self._film.width, self._film.height)
        takes = []
        for side, pane in enumerate(self._panes):
            take, instant = self._script.picture(side, moment)
            sheet.fill(*pane, GROUND)
            sheet.put(self._scene(side, take, instant), pane[0], pane[1])
            self._caption(sheet, side, pane, moment)
            takes.append(take)
        self._title(sheet)
        self._legend(sheet, takes[0])
        if self._pair:
            self._below(sheet, moment, takes)
        else:
            self._beside(sheet, moment, takes[0])
        return sheet.image

    def _make_stages(self) -> list[Stage]:
        """Return a camera for each side; two of them see the same."""
        stories, kind = self._script.stories, self._film.kind
        points = np.concatenate([story.seen(kind) for story in stories])
        box = stories[0].body(stories[0].iterations[0]).box
        flat = is_flat(*box)
        direction = np.array([0.0, -math.sin(_TILT), math.cos(_TILT)]) if flat else OBLIQUE
        table = _ROUND * float(np.hypot(points[:, 0], points[:, 1]).max())
        if not flat:
            points = np.concatenate([points, _rim(table, float(stories[0].body(stories[0].iterations[0]).floor[0][2]))])
        stages = []
        for story, pane in zip(stories, self._panes, strict=True):
            width, height = pane[2] - pane[0], pane[3] - pane[1]
            above, under = (132.0, 96.0) if self._pair else (140.0, 232.0)
            free = tuple(self._unit * v for v in (_EDGE, above, width - _EDGE, height - under))
            lens = Lens.framing(points, direction, free)  # pyright: ignore[reportArgumentType]
            ghost = story.ghost if kind == "evolution" else None
            stages.append(Stage(lens, round(width * self._unit), round(height * self._unit), ghost=ghost, table=table))
        return stages

    def _scene(self, side: int, take: Take, instant: int) -> Image.Image:
        known = self._seen[side]
        if known is None or known[0] is not take or known[1] != instant:
            known = take, instant, self._stages[side].picture(take, instant, ghost=not _plays(take))
            self._seen[side] = known
        return known[2]

    # --- words over the scenes ----------------------------------------------------------------------------------------

    def _title(self, sheet: Sheet) -> None:
        story = self._script.stories[0]
        room = (self._wide if self._pair else self._panes[0][2]) - 2 * _EDGE
        sheet.write(_EDGE, 66, title_of(story), 38, bold=True, room=room)
        if not self._pair:
            caption = caption_of(self._script, 0, self._script.at(0))
            sheet.write(_EDGE, 104, caption.subject, 23, colour=DIM, room=room)

    def _caption(self, sheet: Sheet, side: int, pane: Box, moment: Moment) -> None:
        caption, room = caption_of(self._script, side, moment), pane[2] - pane[0] - 2 * _EDGE
        left, bottom = pane[0] + _EDGE, pane[3]
        if not self._pair:
            sheet.write(left, bottom - 138, caption.headline, 46, bold=True, room=room)
            sheet.write(left, bottom - 94, caption.detail, 27, room=room)
            return
        letter = sheet.write(left, 118, "AB"[side], 34, bold=True, colour=(A, B)[side])
        sheet.write(left + letter + 14, 116, caption.subject, 22, colour=DIM, room=room - letter - 14)
        sheet.write(left, bottom - 56, caption.headline, 34, bold=True, room=room)
        sheet.write(left, bottom - 22, caption.detail, 23, room=room)

    def _legend(self, sheet: Sheet, take: Take) -> None:
        ghost = not _plays(take) and self._stages[0].has_ghost
        found = legend_entries(take, ghost=ghost)
        x, y = _EDGE, UNITS - 32.0
        for colour, words in found:
            sheet.fill(x, y - 17, x + 18, y + 1, colour, round_by=4)
            x += 28 + sheet.write(x + 27, y, words, 22, colour=DIM) + 30

    # --- beside a single scene ----------------------------------------------------------------------------------------

    def _beside(self, sheet: Sheet, moment: Moment, take: Take) -> None:
        left, right = self._wide - _COLUMN + 6, self._wide - _EDGE
        self._chart(sheet, (left, 92, right, 372), moment, [take])
        story = self._script.stories[0]
        groups = table_of(story, shown_iteration(self._script, 0, moment))
        top, bottom = 440.0, UNITS - _EDGE
        lines = sum(len(g.rows) for g in groups) + 1.6 * len(groups)
        step = max(min((bottom - top - 36) / max(lines, 1), _ROW), _LOWEST_ROW)
        sheet.write(left, top, "Design φ", 26, bold=True)
        sheet.write(right, top, "value, change since the start", 20, colour=DIM, anchor="rs")
        y = top + 8
        for group in groups:
            y += 1.15 * step
            if y > bottom - step:
                break
            sheet.write(left, y, group.name, min(22, 0.55 * step), colour=DIM)
            bounds, size = f"bars: {group.bounds}, line: initial", min(19, 0.5 * step)
            sheet.write(right, y, bounds, size, colour=FAINT, anchor="rs")
            y += 0.15 * step
            for row in group.rows:
                y += step
                if y > bottom:
                    break
                self._row(sheet, row, left, right, y, step)

    def _row(self, sheet: Sheet, row: Row, left: float, right: float, y: float, step: float) -> None:
        size, middle = min(23, 0.62 * step), y - 0.3 * step
        bar_left, bar_right = left + 160, right - 268
        sheet.fill(left, middle - 8, left + 16, middle + 8, row.colour, round_by=3)
        sheet.write(left + 26, y - 0.1 * step, row.name, size, room=bar_left - left - 34)
        _bar(sheet, row, bar_left, bar_right, middle, row.colour)
        sheet.write(right - 138, y - 0.1 * step, row.value, size, anchor="rs")
        sheet.write(right, y - 0.1 * step, row.change, size, colour=DIM, anchor="rs")

    # --- below two scenes ---------------------------------------------------------------------------------------------

    def _below(self, sheet: Sheet, moment: Moment, takes: Sequence[Take]) -> None:
        top = UNITS - _STRIP
        chart_right = _EDGE + 0.34 * self._wide
        self._chart(sheet, (_EDGE, top + 66, chart_right, UNITS - 118), moment, takes)
        tables = [
            table_of(story, shown_iteration(self._script, side, moment))
            for side, story in enumerate(self._script.stories)
        ]
        left = chart_right + 60
        sheet.write(left, top + 44, "Design φ", 26, bold=True)
        pairs = [
            (group, row, other)
            for group, beside in zip(*tables, strict=True)
            for row, other in zip(group.rows, beside.rows, strict=True)
        ]
        columns = 2 if len(pairs) > 6 else 1
        per_column = -(-len(pairs) // columns)
        width = (self._wide - _EDGE - left - 40 * (columns - 1)) / columns
        step = min((_STRIP - 110 - 52) / max(per_column, 1), 40.0)
        for column in range(columns):
            x = left + column * (width + 40)
            sheet.write(x + width - 128, top + 78, "A", 22, bold=True, colour=A, anchor="rs")
            sheet.write(x + width, top + 78, "B", 22, bold=True, colour=B, anchor="rs")
            for i, (group, row, other) in enumerate(pairs[column * per_column : (column + 1) * per_column]):
                self._pair_row(sheet, group, (row, other), x, width, top + 84 + (i + 1) * step, step)

    def _pair_row(
        self, sheet: Sheet, group: Group, rows: tuple[Row, Row], left: float, width: float, y: float, step: float
    ) -> None:
        row, other = rows
        size, middle = min(22, 0.66 * step), y - 0.3 * step
        name = row.name if row.name.startswith(group.name) else f"{group.name}, {row.name}"
        sheet.fill(left, middle - 8, left + 16, middle + 8, row.colour, round_by=3)
        room = width - 26 - 250
        bars = room > 300
        sheet.write(left + 26, y - 0.1 * step, name, size, room=0.62 * room if bars else room)
        if bars:
            begin, end = left + 26 + 0.66 * room, left + 26 + room
            _bar(sheet, row, begin, end, middle - 0.14 * step, A, thin=True)
            _bar(sheet, other, begin, end, middle + 0.14 * step, B, thin=True)
        sheet.write(left + width - 128, y - 0.1 * step, row.value, size, anchor="rs")
        sheet.write(left + width, y - 0.1 * step, other.value, size, anchor="rs")

    # --- charts -------------------------------------------------------------------------------------------------------

    def _make_axes(self) -> dict[str, tuple[_Axis, _Axis]]:
        """Return the scales of both charts, which stay the same for all of a film."""
        script = self._script
        axes = {
            "success": (
                _axis("iteration", script.first, max(script.last, script.first + 1), level=True, whole=True),
                _Axis("success", 0.0, 1.0, ((0.0, "0 %"), (0.5, "50 %"), (1.0, "100 %"))),
            )
        }
        curves = [np.array(return_curve(s.episode)) for s in script.stories if s.episode and return_curve(s.episode)]
        if curves:
            ends = np.concatenate(curves)
            longest = max(story.episode.duration for story in script.stories if story.episode)
            low, high = float(ends[:, 1].min()), float(ends[:, 1].max())
            axes["return"] = (
                _axis("time in s", 0.0, max(longest, 0.1), level=True),
                _axis("return so far", low, high if high > low else low + 1, level=False),
            )
        return axes

    def _chart(self, sheet: Sheet, box: Box, moment: Moment, takes: Sequence[Take]) -> None:
        colours: tuple[Colour, ...] = (A, B)
        box = (box[0], box[1], box[2] - _LABELS, box[3])
        if self._script.plays(moment) and "return" in self._axes:
            x, y = self._axes["return"]
            _axes(sheet, box, "Return so far", x, y)
            marked = {} if self._pair else milestone_times(takes[0])
            _milestones(sheet, box, marked, x, moment.time)
            for side, story in enumerate(self._script.stories):
                if story.episode is not None:
                    curve = np.array(return_curve(story.episode), float).reshape(-1, 2)
                    self._line(sheet, box, curve, moment.time, "return", colours[side])
            return
        x, y = self._axes["success"]
        _axes(sheet, box, "Success of each evaluation", x, y)
        for side, story in enumerate(self._script.stories):
            curve = np.array(success_curve(story), float).reshape(-1, 2)
            self._line(sheet, box, curve, moment.iteration, "success", colours[side], dots=True)

    def _line(
        self, sheet: Sheet, box: Box, curve: np.ndarray, now: float, chart: str, colour: Colour, *, dots: bool = False
    ) -> None:
        """Draw a curve (n, 2) up to now, and pale beyond it."""
        x, y = self._axes[chart]
        edge, (width, height) = 12.0, (box[2] - box[0], box[3] - box[1])
        places = np.stack([x.share(curve[:, 0]) * width, (1 - y.share(curve[:, 1])) * height], 1) + edge
        past = curve[:, 0] <= now + 1e-9
        upto = places[past]
        if not dots and past.any() and not past.all():
            at = np.array([np.interp(now, curve[:, 0], places[:, k]) for k in (0, 1)])
            upto = np.concatenate([upto, at[None]])
        around = (box[0] - edge, box[1] - edge, box[2] + edge, box[3] + edge)
        pale: Colour = (226, 230, 236)
        head = [(upto[-1:], colour, 7.0)] if len(upto) else []
        small = [(upto, colour, 4.0)] if dots and len(upto) < 60 else []
        sheet.curves(around, [(places, pale, 2.5), (upto, colour, 3.5)], [*small, *head])


def _milestones(sheet: Sheet, box: Box, times: dict[str, float], axis: _Axis, now: float) -> None:
    """Mark when (s) each milestone is reached; where several are close, their names stand beside the last of them."""
    named = sorted(times.items(), key=lambda pair: pair[1])
    places = [box[0] + float(axis.share(np.array(time))) * (box[2] - box[0]) for _, time in named]
    beside = list(places)
    for i in reversed(range(len(places) - 1)):
        if beside[i + 1] - places[i] < _CLOSE:
            beside[i] = beside[i + 1]
    for i, (name, time) in enumerate(named):
        reached = now >= time - 1e-9
        sheet.fill(places[i] - 1, box[1], places[i] + 1, box[3], DIM if reached else LINE)
        left = beside[i] > box[2] - 110
        at = places[i] - 8 if left else beside[i] + 8
        colour = INK if reached else FAINT
        sheet.write(at, box[1] + 24 + 26 * i, name, 20, colour=colour, anchor="rs" if left else "ls")


def _bar(
    sheet: Sheet, row: Row, left: float, right: float, middle: float, colour: Colour, *, thin: bool = False
) -> None:
    """Draw where a value lies between its bounds, and where it began."""
    half, width = (3.0 if thin else 5.0), right - left
    sheet.fill(left, middle - half, right, middle + half, (229, 232, 237), round_by=half)
    low, high = sorted((row.began, row.share))
    sheet.fill(left + low * width, middle - half, left + high * width, middle + half, colour)
    at = left + row.share * width
    sheet.fill(at - 1.5 * half, middle - 1.5 * half, at + 1.5 * half, middle + 1.5 * half, colour, round_by=1.5 * half)
    if not thin:
        began = left + row.began * width
        sheet.fill(began - 1.2, middle - 11, began + 1.2, middle + 11, INK)


def _rim(radius: float, level: float) -> np.ndarray:
    """Return points (n, 3) on the edge of the table, in m."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(24, level)], 1)


def _plays(take: Take) -> bool:
    """Tell whether a take is an episode, beside which nothing else stands."""
    return take.shot.episode is not None


def _axes(sheet: Sheet, box: Box, title: str, x: _Axis, y: _Axis) -> None:
    """Draw the frame of a chart: its title, and lines with their values."""
    left, top, right, bottom = box
    sheet.write(left, top - 26, title, 26, bold=True)
    for value, words in y.ticks:
        at = bottom - float(y.share(np.array(value))) * (bottom - top)
        sheet.fill(left, at - 0.75, right, at + 0.75, LINE)
        sheet.write(right + _LABELS, at, words, 19, colour=DIM, anchor="rm")
    for i, (value, words) in enumerate(x.ticks):
        at = left + float(x.share(np.array(value))) * (right - left)
        sheet.write(at, bottom + 26, words, 19, colour=DIM, anchor="ls" if i == 0 else "ms")
    sheet.write(right, bottom + 26, x.title, 19, colour=DIM, anchor="rs")


def _axis(title: str, low: float, high: float, *, level: bool, whole: bool = False) -> _Axis:
    """Return a scale with up to six round values; a level one has its title in place of the last of them."""
    raw = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * s for s in (1, 2, 5, 10) if power * s >= raw * 0.999)
    step = max(step, 1.0) if whole else step
    values = np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1) * step
    shown = values[values <= high - _TITLED * (high - low)] if level else values
    return _Axis(title, low, high, tuple((float(v), f"{v:g}".replace("-", "−")) for v in shown))


def _panes(film: Film) -> list[Box]:
    """Return where the scenes are, in units."""
    wide = film.width * UNITS / film.height
    if len(film.sides) == 1:
        return [(0.0, 0.0, wide - _COLUMN - _EDGE, float(UNITS))]
    bottom = UNITS - _STRIP
    return [(0.0, 0.0, wide / 2, bottom), (wide / 2, 0.0, wide, bottom)]
