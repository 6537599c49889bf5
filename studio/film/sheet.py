"""A picture with words, bars and curves on it, laid out in units that scale with its height."""

import functools
import importlib.util
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from studio.film.errors import FilmError

Colour = tuple[int, int, int]
INK, DIM, FAINT, LINE = (27, 31, 38), (91, 99, 110), (148, 155, 164), (214, 218, 224)
PAPER, GROUND = (255, 255, 255), (243, 245, 248)
UNITS = 1080
"""Height of every picture in the units in which it is laid out."""
_CURVE_FINE = 3
"""Pixels along a side that are averaged to one where curves are drawn."""


def find_font(bold: bool = False) -> Path:
    """Return the file of the typeface, which matplotlib ships: Pillow's own has neither φ nor a true minus.

    Raise FilmError where it is missing.
    """
    spec = importlib.util.find_spec("matplotlib")
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    path = Path(spec.origin).parent / "mpl-data" / "fonts" / "ttf" / name if spec and spec.origin else None
    if path is None or not path.is_file():
        raise FilmError(NEEDS_EXTRA.format("matplotlib, whose typeface the captions are set in,"))
    return path


NEEDS_EXTRA = (
    '{} is not installed; pip install "morph-studio[video]". A still as SVG (--still FILE.svg) needs nothing of it'
)


@functools.lru_cache(maxsize=64)
def _font(pixels: int, bold: bool) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(find_font(bold)), pixels)


class Sheet:
    """A picture that is written and drawn on; all places and sizes are in units, of which it is 1080 high."""

    def __init__(self, width: int, height: int) -> None:
        """Begin with white paper of this size in pixels."""
        self.image = Image.new("RGB", (width, height), PAPER)
        self._draw = ImageDraw.Draw(self.image)
        self.unit = height / UNITS
        self.width = width / self.unit

    def pixels(self, *values: float) -> tuple[int, ...]:
        """Return lengths in pixels."""
        return tuple(round(value * self.unit) for value in values)

    def write(
        self, x: float, y: float, words: str, size: float, *, colour: Colour = INK, bold: bool = False,
        anchor: str = "ls", room: float | None = None,
    ) -> float:  # fmt: skip
        """Write words with their baseline at a place, smaller where there is not room enough; return their width.

        Words that would have to be smaller than two thirds end with an ellipsis.
        """
        font, shown = self._fitting(" ".join(words.split()), size, bold, room)
        self._draw.text((x * self.unit, y * self.unit), shown, colour, font, anchor)
        return font.getlength(shown) / self.unit

    def _fitting(self, words: str, size: float, bold: bool, room: float | None) -> tuple[ImageFont.FreeTypeFont, str]:
        largest, widest = max(6, round(size * self.unit)), np.inf if room is None else room * self.unit
        for pixels in range(largest, max(5, round(largest * 2 / 3)) - 1, -1):
            font = _font(pixels, bold)
            if font.getlength(words) <= widest:
                return font, words
        font = _font(max(5, round(largest * 2 / 3)), bold)
        while words and font.getlength(words + "…") > widest:
            words = words[:-1]
        return font, words + "…"

    def fill(
        self, left: float, top: float, right: float, bottom: float, colour: Colour, *, round_by: float = 0
    ) -> None:
        """Fill a rectangle, with round corners where `round_by` is their radius."""
        box = self.pixels(left, top, right, bottom)
        box = (box[0], box[1], max(box[0], box[2] - 1), max(box[1], box[3] - 1))
        if round_by:
            self._draw.rounded_rectangle(box, max(1, round(round_by * self.unit)), colour)
        else:
            self._draw.rectangle(box, colour)

    def put(self, picture: Image.Image, left: float, top: float) -> None:
        """Put a picture with clear ground at a place; its size in pixels stays."""
        self.image.paste(picture, self.pixels(left, top), picture)  # pyright: ignore[reportArgumentType]

    def curves(
        self, box: tuple[float, float, float, float], drawn: Sequence[tuple[np.ndarray, Colour, float]],
        dots: Sequence[tuple[np.ndarray, Colour, float]] = (),
    ) -> None:  # fmt: skip
        """Draw lines through points (n, 2) in units from the box's upper left corner, with colour and width; and dots,
        with colour and radius. Edges are smooth."""
        left, top, right, bottom = self.pixels(*box)
        fine = self.image.crop((left, top, right, bottom)).resize(
            ((right - left) * _CURVE_FINE, (bottom - top) * _CURVE_FINE), Image.Resampling.NEAREST
        )
        draw, scale = ImageDraw.Draw(fine), self.unit * _CURVE_FINE
        for points, colour, width in drawn:
            if len(points) > 1:
                places = [tuple(p) for p in (points * scale).tolist()]
                draw.line(places, colour, max(1, round(width * scale)), joint="curve")
        for points, colour, radius in dots:
            for x, y in (points * scale).tolist():
                r = radius * scale
                draw.ellipse((x - r, y - r, x + r, y + r), colour)
        self.image.paste(fine.reduce(_CURVE_FINE), (left, top))
