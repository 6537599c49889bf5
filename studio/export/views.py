"""Pictures of a robot for its report: four views to one scale, and one with the parts drawn apart."""

import base64
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from morph_core.picture import Camera, Surface, draw, png
from studio.export.meshes import start_posture
from studio.robots.parts import MILLIMETRE, Part, body_of, colours_of

OBLIQUE = np.array([0.75, -0.95, 0.5])
"""From the robot to the camera, for pictures from the side and above."""
SIDES = {
    "from the front": np.array([0.0, -1.0, 0.0]),
    "from the right": np.array([1.0, 0.0, 0.0]),
    "from above": np.array([0.0, 0.0, 1.0]),
}
"""What a view to scale is called, and the direction from the robot to its camera."""
SIDE_WIDTH, SIDE_HEIGHTS = 440, (110, 440)
"""Width of a view to scale, and the lowest and the largest height that it is given, in pixels."""
WIDTH, HEIGHTS = 840, (300, 620)
"""Width of the large pictures, and the lowest and the largest height that they are given, in pixels."""
APART = 0.4
"""Distance of a part from the one that carries it, as a share of the distance of their middles."""
MARGIN = 40
"""Height in pixels that is left above and below what is seen, together."""
GAP = 34.0
"""Least distance in pixels of two labels in a column."""


@dataclass(frozen=True)
class Placed:
    """The part of one link, where it is at the start."""

    link: str
    triangles: np.ndarray  # (F, 3, 3) m
    colour: np.ndarray  # (3,)

    @property
    def surface(self) -> Surface:
        """Triangles and colour, as they are drawn."""
        return self.triangles, self.colour

    @property
    def middle(self) -> np.ndarray:
        """Middle (3,) m of the box round the part."""
        return (self.triangles.min((0, 1)) + self.triangles.max((0, 1))) / 2


@dataclass(frozen=True)
class View:
    """A picture of the robot."""

    caption: str
    image: str
    """The picture as the address of an image, which holds it."""
    width: int
    height: int


@dataclass(frozen=True)
class Label:
    """A link's name in a picture with the parts apart."""

    link: str
    at: tuple[float, float]
    """Middle of the link's part, in pixels from the left and from the top."""
    beside: tuple[float, float]
    """Where the label stands."""


@dataclass(frozen=True)
class Views:
    """All pictures of a robot."""

    oblique: View
    """View from the side and above."""
    sides: Sequence[View]
    """Views to one scale."""
    bar: float
    """Length in m of a bar that tells their scale."""
    bar_pixels: float
    """Length of that bar in their pixels."""
    size: np.ndarray
    """Size (3,) m of the box round the robot at the start."""
    exploded: View
    labels: Sequence[Label]
    """Labels of the exploded view, one for each link."""


def views_of(model: mujoco.MjModel, parts: Sequence[Part]) -> Views:
    """Draw a robot of at least one part at its start; the ground of each picture is clear."""
    placed = placed_parts(model, parts)
    surfaces = [part.surface for part in placed]
    cameras = {name: _camera(surfaces, direction, SIDE_WIDTH, SIDE_HEIGHTS) for name, direction in SIDES.items()}
    scale = min(camera.scale for camera in cameras.values())
    bar = _round_length(0.25 * SIDE_WIDTH / scale)
    sides = [_view(name, surfaces, _scaled(camera, scale)) for name, camera in cameras.items()]
    oblique = _view("from the side and above", surfaces, _camera(surfaces, OBLIQUE, WIDTH, HEIGHTS))
    exploded, labels = _exploded(model, placed)
    return Views(oblique, sides, bar, bar * scale, np.ptp(_points(surfaces), axis=0), exploded, labels)


def _points(surfaces: Sequence[Surface]) -> np.ndarray:
    return np.concatenate([triangles.reshape(-1, 3) for triangles, _ in surfaces])


def _camera(surfaces: Sequence[Surface], direction: np.ndarray, width: int, heights: tuple[int, int]) -> Camera:
    """Return a camera whose pictures are as high as what it sees, within `heights`."""
    camera = Camera.framing(_points(surfaces), direction, width, heights[1])
    return dataclasses.replace(camera, height=_height(camera, surfaces, heights))


def _scaled(camera: Camera, scale: float) -> Camera:
    """Return a camera with another scale, which is not larger, whose pictures are as high as what it sees."""
    height = max(SIDE_HEIGHTS[0], round(camera.height * scale / camera.scale))
    return dataclasses.replace(camera, scale=scale, height=height)


def _height(camera: Camera, surfaces: Sequence[Surface], heights: tuple[int, int]) -> int:
    seen = np.ptp(_points(surfaces) @ camera.axes[1]) * camera.scale
    return int(np.clip(round(seen + MARGIN), *heights))


def _view(caption: str, surfaces: Sequence[Surface], camera: Camera) -> View:
    image = base64.b64encode(png(draw(surfaces, camera))).decode()
    return View(caption, f"data:image/png;base64,{image}", camera.width, camera.height)


def placed_parts(model: mujoco.MjModel, parts: Sequence[Part]) -> list[Placed]:
    """Return each link's part where it is at the start, in the order of the model's bodies."""
    data, colours = start_posture(model), colours_of(model, parts)
    placed = {}
    for part in parts:
        for link in part.links:
            body = body_of(model, link)
            vertices = MILLIMETRE * part.vertices @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
            placed[body] = Placed(link, vertices[part.faces], colours[link][:3])
    return [placed[body] for body in sorted(placed)]


def apart(model: mujoco.MjModel, placed: Sequence[Placed]) -> dict[str, np.ndarray]:
    """Return link -> by how much (3,) m its part is drawn away from its place: out of the part that carries it."""
    bodies = {body_of(model, part.link): part for part in placed}
    moved: dict[str, np.ndarray] = {}
    for body, part in sorted(bodies.items()):
        parent = _carrier(model, body, bodies)
        if parent is None:
            moved[part.link] = np.zeros(3)
        else:
            moved[part.link] = moved[parent.link] + APART * (part.middle - parent.middle)
    return moved


def _carrier(model: mujoco.MjModel, body: int, bodies: Mapping[int, Placed]) -> Placed | None:
    """Return the part of the nearest body that carries `body`; None where no part does."""
    while body:
        body = int(model.body_parentid[body])
        if body in bodies:
            return bodies[body]
    return None


def _exploded(model: mujoco.MjModel, placed: Sequence[Placed]) -> tuple[View, list[Label]]:
    """Return the picture of the parts apart, and a label for each link."""
    moved = apart(model, placed)
    surfaces = [(part.triangles + moved[part.link], part.colour) for part in placed]
    camera = _camera(surfaces, OBLIQUE, WIDTH, HEIGHTS)
    middles = np.array([part.middle + moved[part.link] for part in placed])
    seen = (middles @ camera.axes.T - camera.centre)[:, :2] * [camera.scale, -camera.scale]
    seen += [camera.width / 2, camera.height / 2]
    labels = _labels([part.link for part in placed], seen, camera.height)
    return _view("the parts drawn apart", surfaces, camera), labels


def _labels(links: Sequence[str], seen: np.ndarray, height: int) -> list[Label]:
    """Return labels in two columns beside the picture, in the order in which their parts (n, 2) are seen."""
    left = np.argsort(np.argsort(seen[:, 0], kind="stable")) < len(links) // 2
    places: dict[int, tuple[float, float]] = {}
    for side, column in ((left, -GAP / 2), (~left, WIDTH + GAP / 2)):
        chosen = np.flatnonzero(side)
        chosen = chosen[np.argsort(seen[chosen, 1], kind="stable")]
        heights = spread_out(seen[chosen, 1], GAP, GAP / 2, height - GAP / 2)
        places |= {int(i): (column, float(at)) for i, at in zip(chosen, heights, strict=True)}
    return [Label(link, (float(seen[i, 0]), float(seen[i, 1])), places[i]) for i, link in enumerate(links)]


def spread_out(wanted: np.ndarray, gap: float, low: float, high: float) -> np.ndarray:
    """Return ascending places near the `wanted` ones (n,), `gap` apart and between `low` and `high`.

    Where there is no room for `gap`, they are as far apart as there is.
    """
    count = len(wanted)
    gap = min(gap, (high - low) / max(count - 1, 1))
    steps = gap * np.arange(count)
    lowest = np.maximum.accumulate(np.maximum(wanted, low) - steps)
    return np.minimum(lowest, high - gap * (count - 1)) + steps


def _round_length(longest: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above `longest`."""
    power = 10.0 ** np.floor(np.log10(longest))
    return float(max(digit for digit in (1, 2, 5) if digit * power <= longest * (1 + 1e-9)) * power)
