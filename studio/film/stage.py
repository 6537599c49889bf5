"""What a camera sees of a take: its parts as pixels with shade and shadow, drawn without graphics or a display."""

import dataclasses
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageFilter

from morph_core.picture import covered
from studio.film.lens import Lens
from studio.film.solid import Solid, brightness, fallen
from studio.viewer.figure import Figure, Mesh
from studio.viewer.scene import CONTACT_COLOUR
from studio.viewer.take import Take

FINE = 2
"""Pixels along a side that are averaged to one."""
_SHADOW = 0.30
"""Share of its light that the ground loses in the shadow."""
_SOFT = 5.0
"""Radius by which a shadow's edge is blurred, in pixels of a picture whose longer side has 1000."""
_COARSE = 4
"""Fine pixels along a side of one pixel of the shadow: it is blurred anyway."""
_GHOST = 0.38
"""Opacity of the design in the background, from 0 to 1."""
_BALL = 0.011
"""Radius of the ball that marks a contact, as a share of the scene's longest side."""
_SIDES = 180
"""Corners of the disc that is seen of a table."""
_THICK = 0.018
"""Half of that disc's thickness at most, as a share of its radius."""
_KEPT = 6
"""Number of backgrounds that are kept: lit up goals and walls make others."""


@dataclass
class _Canvas:
    """A picture of fine pixels while it is drawn."""

    pixels: np.ndarray
    """Red, green, blue and opacity (h, w, 4) uint8."""
    nearness: np.ndarray
    """How near to the camera what is seen is, (h, w); minus infinity where nothing is."""
    ground: np.ndarray
    """Where the ground is seen on which shadows fall, (h, w) bool."""

    @classmethod
    def clear(cls, width: int, height: int) -> "_Canvas":
        """Return an empty picture."""
        return cls(
            np.zeros((height, width, 4), np.uint8),
            np.full((height, width), -np.inf, np.float32),
            np.zeros((height, width), bool),
        )

    def window(self, box: tuple[int, int, int, int]) -> "_Canvas":
        """Return a copy of a part of the picture."""
        left, top, right, bottom = box
        part = np.s_[top:bottom, left:right]
        return _Canvas(self.pixels[part].copy(), self.nearness[part].copy(), self.ground[part])


class Stage:
    """A camera on takes of one scene, with a design that stands pale in the background."""

    def __init__(
        self,
        lens: Lens,
        width: int,
        height: int,
        *,
        ghost: Figure | None = None,
        table: float = 0.0,
        contacts: bool = True,
        shadows: bool = True,
    ) -> None:
        """Point the camera. Of a table a disc of radius `table` in m is seen; without one, what stands on it throws its
        shadow on clear ground."""
        self._contacts, self._shadows = contacts, shadows
        self._lens = lens.zoomed(FINE)
        self._width, self._height = width, height
        self._ghost, self._table = ghost, table
        self._soft = _SOFT * max(width, height) / 1000
        self._grounds: OrderedDict[bytes, tuple[_Canvas, Image.Image]] = OrderedDict()
        self._solids: OrderedDict[int, tuple[Take, list[Solid]]] = OrderedDict()

    @property
    def has_ghost(self) -> bool:
        """Whether there is a design for the background."""
        return self._ghost is not None

    def picture(self, take: Take, frame: int, *, ghost: bool = True) -> Image.Image:
        """Return what is seen of a frame of a take, with clear ground; the pale design is left out without `ghost`."""
        frame = min(frame, take.frames - 1)
        ground, finished = self._ground(take, frame, ghost)
        robot, objects = self._moving(take)
        surfaces = [robot.at(frame), objects.at(frame)]
        colours = np.concatenate([take.robot.colours[robot.part], take.object_colours(frame)[objects.part]])
        corners, normals = (np.concatenate(pair) for pair in zip(*surfaces, strict=True))
        seen = self._lens.project(corners)
        shadow = self._lens.project(fallen(corners, _level(take)))
        balls = self._balls(take, frame)
        reach = [middle[None] + sign * radius for middle, radius in balls for sign in (-1, 1)]
        box = self._box(np.concatenate([seen.reshape(-1, 3), shadow.reshape(-1, 3), *reach]))
        canvas, corner = ground.window(box), np.array([box[0], box[1], 0.0])
        self._darken(canvas, shadow - corner)
        _paint(canvas, seen - corner, brightness(normals), colours)
        for middle, radius in balls:
            _paint_ball(canvas, middle - corner, radius)
        picture = finished.copy()
        left, top = box[0] // FINE, box[1] // FINE
        picture.paste(Image.fromarray(canvas.pixels, "RGBA").reduce(FINE), (left, top))
        return picture

    def _moving(self, take: Take) -> list[Solid]:
        """Return the robot and the objects of a take as triangles."""
        known = self._solids.get(id(take))
        if known is None or known[0] is not take:
            known = take, [Solid.of(take.robot), Solid.of(take.objects)]
            self._solids[id(take)] = known
            while len(self._solids) > 2:
                self._solids.popitem(last=False)
        return known[1]

    def _ground(self, take: Take, frame: int, ghost: bool) -> tuple[_Canvas, Image.Image]:
        """Return all that stands still, as it is lit in a frame: in fine pixels, and finished."""
        scenery, colours = self._round_table(take.scenery), take.scenery_colours(frame)
        key = bytes([ghost]) + scenery.sizes.tobytes() + scenery.positions.tobytes() + colours.tobytes()
        if key not in self._grounds:
            canvas = self._draw_ground(scenery, colours, _level(take), ghost)
            self._grounds[key] = canvas, Image.fromarray(canvas.pixels, "RGBA").reduce(FINE)
            while len(self._grounds) > _KEPT:
                self._grounds.popitem(last=False)
        self._grounds.move_to_end(key)
        return self._grounds[key]

    def _round_table(self, scenery: Figure) -> Figure:
        """Return the scenery with a disc in place of its table: a whole table would fill the picture."""
        meshes, kinds, sizes = list(scenery.meshes), list(scenery.kinds), scenery.sizes.copy()
        for i, name in enumerate(scenery.names):
            if name.startswith("table") and self._table:
                radius, half = min(self._table, float(sizes[i, :2].min())), float(sizes[i, 2])
                meshes[i], kinds[i] = _disc(radius, min(half, _THICK * radius), half), "mesh"
                sizes[i] = 1.0
        return dataclasses.replace(scenery, meshes=tuple(meshes), kinds=tuple(kinds), sizes=sizes)

    def _draw_ground(self, scenery: Figure, colours: np.ndarray, level: float, ghost: bool) -> _Canvas:
        canvas = _Canvas.clear(self._width * FINE, self._height * FINE)
        tables = np.array([name.startswith("table") for name in scenery.names], bool)
        if self._table and tables.any():
            self._add(canvas, scenery, colours, tables)
            canvas.ground = canvas.pixels[..., 3] > 0
        else:
            canvas.ground = canvas.pixels[..., 3] == 0
        if not tables.all():
            corners, _ = Solid.of(scenery.take(np.flatnonzero(~tables).tolist())).at(0)
            self._darken(canvas, self._lens.project(fallen(corners, level)))
            before = canvas.nearness.copy()
            self._add(canvas, scenery, colours, ~tables)
            canvas.ground &= canvas.nearness == before
        if ghost and self._ghost is not None:
            self._add_ghost(canvas, self._ghost)
        return canvas

    def _add(self, canvas: _Canvas, scenery: Figure, colours: np.ndarray, chosen: np.ndarray) -> None:
        """Draw the parts of the scenery that are chosen (n,)."""
        parts = np.flatnonzero(chosen)
        solid = Solid.of(scenery.take(parts.tolist()))
        corners, normals = solid.at(0)
        _paint(canvas, self._lens.project(corners), brightness(normals), colours[parts][solid.part])

    def _add_ghost(self, canvas: _Canvas, ghost: Figure) -> None:
        """Draw a pale design; whatever comes after it is in front of it."""
        solid = Solid.of(ghost)
        corners, normals = solid.at(0)
        over = _Canvas(canvas.pixels.copy(), canvas.nearness.copy(), canvas.ground)
        _paint(over, self._lens.project(corners), brightness(normals), ghost.colours[solid.part])
        shown = over.nearness > canvas.nearness
        under, pale = canvas.pixels[shown].astype(float), over.pixels[shown].astype(float)
        share = np.where(under[:, 3:] > 0, _GHOST, 1.0)
        mixed = (1 - share) * under + share * pale
        mixed[:, 3] = np.where(under[:, 3] > 0, 255, 255 * _GHOST)
        canvas.pixels[shown] = np.round(mixed)

    def _darken(self, canvas: _Canvas, fallen: np.ndarray) -> None:
        """Put a shadow (F, 3, 3), in pixels of the canvas, on the ground where that is seen."""
        if not self._shadows:
            return
        height, width = canvas.nearness.shape
        rows, columns = -(-height // _COARSE), -(-width // _COARSE)
        small = fallen / [_COARSE, _COARSE, 1.0]
        _, at, _ = covered(small, columns, rows)
        mask = np.zeros(rows * columns, np.uint8)
        mask[at] = 255
        radius = self._soft * FINE / _COARSE
        soft = Image.fromarray(mask.reshape(rows, columns)).filter(ImageFilter.GaussianBlur(radius))
        spread = np.asarray(soft.resize((columns * _COARSE, rows * _COARSE), Image.Resampling.BILINEAR))
        at = np.flatnonzero(canvas.ground & (spread[:height, :width] > 0))  # few of all pixels
        dark = spread[:height, :width].ravel()[at].astype(np.float32) * (_SHADOW / 255)
        clear = np.isneginf(canvas.nearness.reshape(-1)[at])
        pixels = canvas.pixels.reshape(-1, 4)
        under = pixels[at]
        under[:, :3] = under[:, :3] * (1 - dark[:, None])
        under[:, 3] = np.where(clear, np.maximum(under[:, 3], 255 * dark), under[:, 3])
        pixels[at] = under

    def _balls(self, take: Take, frame: int) -> list[tuple[np.ndarray, float]]:
        """Return middle (3,) and radius, in pixels, of the balls that mark the contacts of a frame."""
        if not self._contacts:
            return []
        points, metres = take.contact[frame], _BALL * float(np.max(take.box[1] - take.box[0]))
        middles = [self._lens.project(point) for point in points[np.isfinite(points).all(1)]]
        nearness = [float(middle[2]) if self._lens.perspective else 1.0 for middle in middles]
        return [(m, metres * self._lens.scale * near) for m, near in zip(middles, nearness, strict=True)]

    def _box(self, points: np.ndarray) -> tuple[int, int, int, int]:
        """Return a rectangle of fine pixels round what is seen at points (n, 3), with room for the shadow's edge."""
        edge = 4 * FINE * _COARSE + 3 * self._soft * FINE
        step = FINE * _COARSE
        low = np.floor((points[:, :2].min(0) - edge) / step) * step
        high = np.ceil((points[:, :2].max(0) + edge) / step) * step
        size = np.array([self._width, self._height]) * FINE
        left, top = np.clip(low, 0, size - FINE).astype(int)
        right, bottom = np.clip(high, [left + FINE, top + FINE], size).astype(int)
        return int(left), int(top), int(right), int(bottom)


def _disc(radius: float, half_thickness: float, top: float) -> Mesh:
    """Return a round slab, all in m, whose upper side is `top` above its middle's place."""
    angles = 2 * np.pi * np.arange(_SIDES) / _SIDES
    rim = np.stack([radius * np.cos(angles), radius * np.sin(angles)], 1)
    levels = [np.column_stack([rim, np.full(_SIDES, z)]) for z in (top, top - 2 * half_thickness)]
    upper, lower = np.arange(_SIDES), np.arange(_SIDES) + _SIDES
    after = (upper + 1) % _SIDES
    middle = 2 * _SIDES
    faces = np.concatenate([
        np.stack([upper, after, np.full(_SIDES, middle)], 1),
        np.stack([lower, after + _SIDES, after], 1), np.stack([lower, after, upper], 1),
    ])  # fmt: skip
    vertices = np.concatenate([*levels, [[0.0, 0.0, top]]])
    return Mesh(vertices.astype(np.float32), faces.astype(np.uint32))


def _level(take: Take) -> float:
    """Return the height in m of the ground that shadows fall on."""
    return float(take.floor[0][2])


def _twice_area(seen: np.ndarray) -> np.ndarray:
    """Return twice the area (F,) of triangles in pixels; negative for those that face the camera."""
    (x0, x1, x2), (y0, y1, y2) = seen[..., 0].T, seen[..., 1].T
    return (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)


def _paint(canvas: _Canvas, seen: np.ndarray, light: np.ndarray, colours: np.ndarray) -> None:
    """Draw triangles (F, 3, 3) in pixels with their light (F, 3) at each corner and colours (F, 3)."""
    height, width = canvas.nearness.shape
    area = _twice_area(seen)
    front = area < -1e-9
    seen, light, colours, area = seen[front], light[front], colours[front].astype(np.float32), area[front]
    which, at, nearness = covered(seen, width, height)
    flat = canvas.nearness.reshape(-1)
    nearness = nearness.astype(np.float32)
    np.maximum.at(flat, at, nearness)
    shown = nearness >= flat[at]
    which, at = which[shown], at[shown]
    (x0, x1, x2), (y0, y1, y2) = seen[..., 0].T, seen[..., 1].T
    first, second, third = light.T
    along_x = ((second - first) * (y2 - y0) - (third - first) * (y1 - y0)) / area
    along_y = ((third - first) * (x1 - x0) - (second - first) * (x2 - x0)) / area
    base = first - along_x * (x0 - 0.5) - along_y * (y0 - 0.5)
    row, column = np.divmod(at, width)
    lit = (base[which] + along_x[which] * column + along_y[which] * row).astype(np.float32)
    lit = np.clip(lit, light.min(1)[which], light.max(1)[which])[:, None]
    painted = colours[which] * np.minimum(lit, 1) + 255 * np.maximum(lit - 1, 0)
    pixels = canvas.pixels.reshape(-1, 4)
    pixels[at, :3] = np.minimum(painted + 0.5, 255)
    pixels[at, 3] = 255


def _paint_ball(canvas: _Canvas, centre: np.ndarray, radius: float) -> None:
    """Draw a ball over all that is there: contacts are hidden between what touches."""
    height, width = canvas.nearness.shape
    left, top = np.maximum(np.floor(centre[:2] - radius).astype(int), 0)
    right, bottom = np.minimum(np.ceil(centre[:2] + radius).astype(int) + 1, [width, height])
    y, x = np.mgrid[top:bottom, left:right]
    inside = np.hypot(x + 0.5 - centre[0], y + 0.5 - centre[1]) <= radius
    canvas.pixels[top:bottom, left:right][inside] = [*CONTACT_COLOUR, 255]
