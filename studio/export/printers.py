"""The printers that prints are laid out for: a table of common ones, and any other by its size."""

import re
from dataclasses import dataclass

import numpy as np

from studio.export.errors import ExportError

BORDER = 8.0
"""Width (mm) along the edges of a bed on which nothing is laid: room for a skirt and for clips."""
SMALLEST, LARGEST = 50.0, 2000.0
"""Smallest and largest size of a printer in each direction (mm)."""
_ANGLES = np.radians(np.arange(91.0))
_COS, _SIN = np.cos(_ANGLES), np.sin(_ANGLES)
_COS[-1] = 0.0


@dataclass(frozen=True)
class Printer:
    """What a printer can print."""

    name: str
    size: tuple[float, float, float]
    """Width, depth and height of what is printed at most, in mm."""

    @property
    def room(self) -> tuple[float, float]:
        """Width and depth of the bed inside its border, in mm."""
        return self.size[0] - 2 * BORDER, self.size[1] - 2 * BORDER

    def angle_of(self, length: float, width: float) -> float | None:
        """Return the smallest angle (rad) by which a rectangle (mm) must be turned to lie on the bed; None if none."""
        x, y = self.room
        fits = (length * _COS + width * _SIN <= x) & (length * _SIN + width * _COS <= y)
        if fits[-1]:  # a quarter turn is as good as none
            return float(_ANGLES[0 if fits[0] else -1])
        return float(_ANGLES[fits.argmax()]) if fits.any() else None

    def takes(self, size: np.ndarray) -> bool:
        """Tell whether a body of `size` (3,) mm, as it lies, can be printed; it may be turned on the bed."""
        return size[2] <= self.size[2] and self.angle_of(float(size[0]), float(size[1])) is not None

    def longest(self, width: float) -> float:
        """Return the length (mm) of the longest strip of a width that lies on the bed, 0 where none does."""
        x, y = self.room
        along = np.divide(x - width * _SIN, _COS, out=np.full_like(_COS, np.inf), where=_COS > 0)
        across = np.divide(y - width * _COS, _SIN, out=np.full_like(_SIN, np.inf), where=_SIN > 0)
        allowed = (width * _SIN <= x) & (width * _COS <= y)
        return float(max(np.where(allowed, np.minimum(along, across), 0.0).max(), 0.0))

    def __str__(self) -> str:
        size = " x ".join(f"{s:g}" for s in self.size) + " mm"
        return f"{self.name} ({size})" if self.name in PRINTERS else size


PRINTERS = {
    name: Printer(name, size)
    for name, size in {
        "bambu_a1_mini": (180.0, 180.0, 180.0),
        "bambu_x1c": (256.0, 256.0, 256.0),
        "creality_ender_3_v3": (220.0, 220.0, 250.0),
        "creality_k1_max": (300.0, 300.0, 300.0),
        "prusa_mini": (180.0, 180.0, 180.0),
        "prusa_mk4s": (250.0, 210.0, 220.0),
        "prusa_xl": (360.0, 360.0, 360.0),
    }.items()
}
"""Printers by name, with the build volumes that their makers state."""
DEFAULT = Printer("256x256x256", (256.0, 256.0, 256.0))
"""The printer unless another is asked for: a size that many have."""
CHOICES = f"{', '.join(PRINTERS)}, or a size in mm such as 300x300x400, each from {SMALLEST:g} to {LARGEST:g}"


def printer_of(word: str) -> Printer:
    """Return the printer of a name or of a size such as 256x256x256 (mm); ExportError says what is allowed."""
    if word in PRINTERS:
        return PRINTERS[word]
    match = re.fullmatch(r"(\d{1,6}(?:\.\d{1,3})?)x(\d{1,6}(?:\.\d{1,3})?)x(\d{1,6}(?:\.\d{1,3})?)", word)
    if match is None:
        raise ExportError(f'unknown printer "{word[:40]}"; choose from: {CHOICES}')
    width, depth, height = (float(number) for number in match.groups())
    if not all(SMALLEST <= side <= LARGEST for side in (width, depth, height)):
        raise ExportError(
            f'the printer "{word}" has a side outside {SMALLEST:g} to {LARGEST:g} mm; choose from: {CHOICES}'
        )
    return Printer(f"{width:g}x{depth:g}x{height:g}", (width, depth, height))
