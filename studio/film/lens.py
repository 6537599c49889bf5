"""The camera of a film or a still: from points of the world to pixels, with perspective or without."""

import math
from dataclasses import dataclass

import numpy as np

from studio.viewer.scene import FIELD_OF_VIEW, screen_axes

Box = tuple[float, float, float, float]
"""A rectangle of a picture in pixels: left, top, right and bottom."""


@dataclass(frozen=True)
class Lens:
    """A camera that stands still."""

    axes: np.ndarray
    """Unit vectors of the world, in rows (3, 3), that point right, up, and towards the camera."""
    eye: np.ndarray
    """Place (3,) of the camera along these axes, in m; without perspective, what is in the middle."""
    scale: float
    """Pixels of a metre that is a metre away from the eye; without perspective, of any metre."""
    middle: tuple[float, float]
    """Pixel that the camera is pointed at."""
    perspective: bool

    @classmethod
    def framing(cls, points: np.ndarray, direction: np.ndarray, free: Box, *, perspective: bool = True) -> "Lens":
        """Return the camera that sees all points (n, 3) inside a rectangle as large as they can be.

        `direction` (3,) leads from the points to the camera.
        """
        towards = direction / np.linalg.norm(direction)
        axes = np.stack([*screen_axes(towards), towards])
        across, upward, nearer = (points @ axes.T).T
        width, height = free[2] - free[0], free[3] - free[1]
        middle = (free[0] + free[2]) / 2, (free[1] + free[3]) / 2
        if not perspective:
            sides = [max(float(np.ptp(along)), 1e-6) for along in (across, upward)]
            centre = np.array([(along.max() + along.min()) / 2 for along in (across, upward, nearer)])
            return cls(axes, centre, min(width / sides[0], height / sides[1]), middle, False)
        slope_up = math.tan(FIELD_OF_VIEW / 2)
        place, far = [], 1e-3
        for along, slope in ((across, slope_up * width / height), (upward, slope_up)):
            right, left = (along + slope * nearer).max(), (slope * nearer - along).max()
            place.append((right - left) / 2)
            far = max(far, (right + left) / (2 * slope))
        far = max(far, float(nearer.max()) + 1e-3)
        return cls(axes, np.array([*place, far]), height / 2 / slope_up, middle, True)

    def zoomed(self, factor: int) -> "Lens":
        """Return the camera whose pictures have `factor` as many pixels along each side."""
        across, down = self.middle
        return Lens(self.axes, self.eye, self.scale * factor, (across * factor, down * factor), self.perspective)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return for points (..., 3) where they are seen: pixels from the left, from the top, and how near they are.

        What is nearer has the larger third number, which changes evenly across a flat face.
        """
        seen = (points @ self.axes.T - self.eye).astype(float)
        if not self.perspective:
            return seen * [self.scale, -self.scale, 1.0] + [*self.middle, 0.0]
        nearness = 1 / np.maximum(-seen[..., 2], 1e-6)
        return np.stack(
            [
                self.middle[0] + self.scale * seen[..., 0] * nearness,
                self.middle[1] - self.scale * seen[..., 1] * nearness,
                nearness,
            ],
            -1,
        )
