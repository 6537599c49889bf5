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
    "from the side and above": OBLIQUE,
}
"""What a view is called, and the direction from the robot to its camera."""
VIEW = (480, 400)
"""Width and height of a view in pixels."""
EXPLODED = (840, 640)
"""Width and height in pixels of the picture with the parts apart."""
APART = 0.55
"""How far a part is drawn from the one that carries it, as a share of the distance of their middles."""
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
    """A picture of the robot from one side."""

    caption: str
    image: str
    """The picture as the address of an image, which holds it."""
    bar: float
    """Share of the picture's width that the scale's bar takes."""


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

    sides: Sequence[View]
    bar: float
    """Length in m of the bar that is the scale of all sides."""
    size: np.ndarray
    """Size (3,) m of the box round the robot at the start."""
    exploded: str
    """The picture with the parts apart, as the address of an image, which holds it."""
    labels: Sequence[Label]


def views_of(model: mujoco.MjModel, parts: Sequence[Part]) -> Views:
    """Draw a robot of at least one part at its start; the ground of each picture is clear."""
    placed = placed_parts(model, parts)
    points = np.concatenate([part.triangles.reshape(-1, 3) for part in placed])
    cameras = {name: Camera.framing(points, direction, *VIEW) for name, direction in SIDES.items()}
    scale = min(camera.scale for camera in cameras.values())
    bar = _round_length(0.25 * VIEW[0] / scale)
    surfaces = [part.surface for part in placed]
    sides = [
        View(name, _address(draw(surfaces, dataclasses.replace(camera, scale=scale))), bar * scale / VIEW[0])
        for name, camera in cameras.items()
    ]
    exploded, labels = _exploded(model, placed)
    return Views(sides, bar, np.ptp(points, axis=0), exploded, labels)


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


def _exploded(model: mujoco.MjModel, placed: Sequence[Placed]) -> tuple[str, list[Label]]:
    """Return the picture of the parts apart as an address, and a label for each link."""
    moved = apart(model, placed)
    surfaces = [(part.triangles + moved[part.link], part.colour) for part in placed]
    points = np.concatenate([triangles.reshape(-1, 3) for triangles, _ in surfaces])
    camera = Camera.framing(points, OBLIQUE, *EXPLODED)
    middles = np.array([part.middle + moved[part.link] for part in placed])
    seen = (middles @ camera.axes.T - camera.centre)[:, :2] * [camera.scale, -camera.scale] + np.array(EXPLODED) / 2
    return _address(draw(surfaces, camera)), _labels([part.link for part in placed], seen)


def _labels(links: Sequence[str], seen: np.ndarray) -> list[Label]:
    """Return labels in two columns beside the picture, in the order in which their parts (n, 2) are seen."""
    width, height = EXPLODED
    left = np.argsort(np.argsort(seen[:, 0], kind="stable")) < len(links) // 2
    places: dict[int, tuple[float, float]] = {}
    for side, column in ((left, -GAP / 2), (~left, width + GAP / 2)):
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


def _address(image: np.ndarray) -> str:
    """Return the address of an image (height, width, 4) that holds it as PNG."""
    return f"data:image/png;base64,{base64.b64encode(png(image)).decode()}"
