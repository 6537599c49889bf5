"""Stills for papers: one body at one moment on clear ground, as SVG or PNG, to a size in millimetres."""

import dataclasses
import io
import math
import re
from dataclasses import dataclass

import numpy as np

from morph_core.history import History
from morph_core.protocol import Which
from studio.film.errors import FilmError
from studio.film.lens import Lens
from studio.film.plan import Side, Story, episode_of
from studio.film.solid import fallen
from studio.film.vector import triangles_of
from studio.viewer.scene import OBLIQUE, is_flat
from studio.viewer.take import FRAMES_PER_SECOND, Take

MILLIMETRES = {"mm": 1.0, "cm": 10.0, "in": 25.4, "inch": 25.4}
SIDES = 10.0, 1000.0
"""Shortest and longest side of a still, in mm."""
DPI = 72, 1200
MOST_PIXELS = 40e6
"""Pixels of the largest PNG: each takes some thirty bytes while it is drawn."""
_HIGHEST = 1.4
"""Height of a still whose width alone is given, at most, as a multiple of its width."""
_EDGE = 0.02
"""Width of the edge that stays clear, as a share of the shorter side."""
_BAR = 0.3
"""Share of the width that the scale bar takes at most."""
_FINE = 2400
"""Pixels along the longer side in which an SVG looks up what hides what."""
_SEAM = 0.07
"""Width in mm of the line round each triangle of an SVG in its own colour, which hides the gaps between them."""
_TYPE = 2.8
"""Height of the letters beside the scale bar, in mm."""


@dataclass(frozen=True)
class Format:
    """What a still is to be like."""

    width: float
    """Width in mm."""
    height: float | None
    """Height in mm; None for as high as what is seen."""
    dpi: int
    """Pixels per inch of a PNG."""
    bar: bool
    """Whether a scale bar is drawn."""


def read_size(words: str) -> tuple[float, float | None]:
    """Return width and height in mm of words such as 85mm, 85x60mm or 3.4x2.4in. FilmError says what is allowed."""
    units = "|".join(sorted(MILLIMETRES, key=len, reverse=True))
    match = re.fullmatch(rf"(\d+(?:\.\d+)?)(?:x(\d+(?:\.\d+)?))?\s*({units})", words.strip().lower())
    low, high = SIDES
    if match:
        factor = MILLIMETRES[match[3]]
        sides = [float(side) * factor for side in match.groups()[:2] if side is not None]
        if all(low <= side <= high for side in sides):
            return sides[0], sides[1] if len(sides) > 1 else None
    raise FilmError(
        f"the size of a still is a width, or width x height, with its unit, such as 85mm, 85x60mm or 3.4x2.4in, each "
        f'side from {low:g} to {high:g} mm, not "{words[:40]}"'
    )


class Still:
    """A body at one moment: a design in its start posture, or a time in its recorded episode."""

    def __init__(self, history: History, design: str, seconds: float | None = None, which: Which | None = None) -> None:
        """Build it. Raise FilmError with the choices where there is no such design, episode or time."""
        if seconds is None and which is None:
            try:
                iteration, _ = history.design(design)
            except ValueError as error:
                raise FilmError(str(error)) from error
            side = Side(str(history.folder.path.resolve()), history.iteration, None)
            take, self._frame = Story(side).exactly(iteration), 0
        else:
            side = Side(str(history.folder.path.resolve()), history.iteration, episode_of(history, design), which)
            take = Story(side).episode
            assert take is not None
            time = seconds or 0.0
            if not 0 <= time <= take.duration:
                raise FilmError(
                    f"--at must be from 0 to {take.duration:.2f} s, the length of the episode, not {time:g}"
                )
            self._frame = round(time * FRAMES_PER_SECOND)
        self._take = _without_table(take)
        self._direction = np.array([0.0, 0.0, 1.0]) if is_flat(*take.box) else OBLIQUE

    def png(self, form: Format) -> bytes:
        """Return the still as PNG, with soft shadows on clear ground. FilmError for one that is too large."""
        from PIL import ImageDraw, ImageFont

        from studio.film.sheet import INK, find_font
        from studio.film.stage import Stage

        width, height, room = self._size(form, self._with_shadows)
        scale = form.dpi / 25.4  # pixels per mm
        pixels = round(width * scale), round(height * scale)
        if pixels[0] * pixels[1] > MOST_PIXELS:
            raise FilmError(
                f"{pixels[0]:,} x {pixels[1]:,} pixels are more than {MOST_PIXELS / 1e6:.0f} million, beyond which "
                "drawing takes gigabytes; give a smaller --size or --dpi, or an SVG, which has no pixels"
            )
        edge = _EDGE * min(width, height) * scale
        free = (edge, edge, pixels[0] - edge, pixels[1] - edge - room * scale)
        lens = Lens.framing(self._with_shadows, self._direction, free, perspective=False)
        picture = Stage(lens, *pixels, contacts=False, shadows=self._stands).picture(self._take, self._frame)
        if form.bar:
            length, words = _bar(width * scale * _BAR / lens.scale)
            draw, right = ImageDraw.Draw(picture), pixels[0] - edge
            line, bottom = 0.25 * scale, pixels[1] - edge
            draw.rectangle((right - length * lens.scale, bottom - line, right, bottom), (*INK, 255))
            font = ImageFont.truetype(str(find_font()), max(6, round(_TYPE * scale)))
            draw.text((right - length * lens.scale / 2, bottom - 3 * line), words, (*INK, 255), font, "ms")
        buffer = io.BytesIO()
        picture.save(buffer, "PNG", dpi=(form.dpi, form.dpi))
        return buffer.getvalue()

    def svg(self, form: Format) -> bytes:
        """Return the still as SVG, whose lengths are those of the page; its ground is clear."""
        width, height, room = self._size(form, self._points)
        fine = _FINE / max(width, height)  # pixels per mm in which is looked up what hides what
        edge = _EDGE * min(width, height)
        free = tuple(fine * v for v in (edge, edge, width - edge, height - edge - room))
        lens = Lens.framing(self._points, self._direction, free, perspective=False)  # pyright: ignore[reportArgumentType]
        seen, colours = triangles_of(self._take, self._frame, lens, math.ceil(fine * width), math.ceil(fine * height))
        drawn = "".join(
            f'<path d="M{x0:.3f} {y0:.3f}L{x1:.3f} {y1:.3f}L{x2:.3f} {y2:.3f}Z" fill="{c}" stroke="{c}"/>'
            for ((x0, y0), (x1, y1), (x2, y2)), c in zip(
                (seen / fine).tolist(), (f"#{r:02x}{g:02x}{b:02x}" for r, g, b in colours.tolist()), strict=True
            )
        )  # fmt: skip
        bar = self._svg_bar(width - edge, height - edge, width * _BAR, lens.scale / fine) if form.bar else ""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.3f}mm" height="{height:.3f}mm" '
            f'viewBox="0 0 {width:.3f} {height:.3f}"><g stroke-width="{_SEAM}" stroke-linejoin="round">{drawn}</g>'
            f"{bar}</svg>\n"
        ).encode()

    @staticmethod
    def _svg_bar(right: float, bottom: float, longest: float, scale: float) -> str:
        """Return a scale bar that ends at a place, all in mm; `scale` is how many of them a metre has."""
        length, words = _bar(longest / scale)
        left = right - length * scale
        return (
            f'<path d="M{left:.3f} {bottom:.3f}H{right:.3f}" stroke="#1b1f26" stroke-width=".3"/>'
            f'<text x="{(left + right) / 2:.3f}" y="{bottom - 1:.3f}" font-size="{_TYPE}" fill="#1b1f26" '
            f'font-family="Helvetica, Arial, DejaVu Sans, sans-serif" text-anchor="middle">{words}</text>'
        )

    @property
    def _points(self) -> np.ndarray:
        """Points (n, 3) m that have to be in sight."""
        moving = [figure.corners([self._frame]) for figure in (self._take.robot, self._take.objects) if len(figure)]
        return np.concatenate([*moving, self._take.scenery.corners([0])])

    @property
    def _stands(self) -> bool:
        """Whether the start posture is seen; what has been lifted throws its shadow far away."""
        return self._frame == 0

    @property
    def _with_shadows(self) -> np.ndarray:
        """Points (n, 3) m that have to be in sight with the shadows."""
        level = float(self._take.floor[0][2])
        return np.concatenate([self._points, fallen(self._points, level)]) if self._stands else self._points

    def _size(self, form: Format, points: np.ndarray) -> tuple[float, float, float]:
        """Return width and height in mm of what shows points (n, 3), and how much of the height the scale bar takes."""
        room = 1.6 * _TYPE if form.bar else 0.0
        if form.height is not None:
            return form.width, form.height, room
        lens = Lens.framing(points, self._direction, (0, 0, 1, 1), perspective=False)
        seen = np.ptp(points @ lens.axes.T, axis=0)
        return form.width, form.width * min(max(seen[1] / seen[0], 0.2), _HIGHEST) + room, room


def _without_table(take: Take) -> Take:
    """Return a take of which the table is not seen, so that the ground is clear."""
    kept = [i for i, name in enumerate(take.scenery.names) if not name.startswith("table")]
    return dataclasses.replace(take, scenery=take.scenery.take(kept), touched=take.touched[:, kept])


def _bar(longest: float) -> tuple[float, str]:
    """Return the length in m of a scale bar, 1, 2 or 5 times a power of ten and not above `longest`, and its words."""
    power = 10.0 ** math.floor(math.log10(longest))
    length = max(power * step for step in (1, 2, 5) if power * step <= longest * 1.001)
    for unit, factor in (("m", 1.0), ("cm", 100.0), ("mm", 1000.0)):
        if length * factor >= 0.999:
            return length, f"{length * factor:g} {unit}"
    return length, f"{length * 1000:g} mm"
