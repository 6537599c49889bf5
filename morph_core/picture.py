"""Pictures of triangles as pixels and as PNG, drawn with numpy alone: a server may have no graphics."""

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_OVERSAMPLING = 2
"""Pixels along a side that are averaged to one."""
_EDGE_ON = 1e-9
"""Cosine between a face's normal and the sight below which nothing of the face is seen."""
_FILLED = 0.92
"""Share of the picture's width or height that what is framed takes."""

Surface = tuple[np.ndarray, np.ndarray]
"""Triangles (F, 3, 3) in the world, and red, green, blue (3,) in [0, 1]."""


@dataclass(frozen=True)
class Light:
    """A lamp that is far away."""

    direction: np.ndarray
    """Vector (3,) from what is lit to the lamp: right, up, and towards the camera."""
    ambient: float
    """Share of its colour that a face keeps in the shade."""

    def on(self, normals: np.ndarray) -> np.ndarray:
        """Return what share (F,) of its colour a face with this normal (F, 3), of any length, shows."""
        lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(self.direction)
        return self.ambient + (1 - self.ambient) * np.clip(normals @ self.direction / lengths, 0, 1)


@dataclass(frozen=True)
class Camera:
    """A camera without perspective, and the size of its pictures."""

    axes: np.ndarray
    """Unit vectors of the world, in rows (3, 3), that point right, up, and towards the camera."""
    centre: np.ndarray
    """Point (3,) in the middle of the picture, in metres along the camera's axes."""
    scale: float
    """Pixels per metre."""
    width: int
    height: int

    @classmethod
    def framing(cls, points: np.ndarray, direction: np.ndarray, width: int, height: int) -> "Camera":
        """Return the camera that sees all of the points (n, 3); `direction` (3,) leads from them to it."""
        towards = direction / np.linalg.norm(direction)
        right = np.cross([0.0, 0.0, 1.0], towards)
        length = np.linalg.norm(right)
        right = right / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
        axes = np.stack([right, np.cross(towards, right), towards])
        seen = np.einsum("ji,ni->jn", axes, points)  # BLAS waits for its threads on a busy machine
        low, high = seen.min(1), seen.max(1)
        scale = _FILLED * min(width / max(high[0] - low[0], 1e-9), height / max(high[1] - low[1], 1e-9))
        return cls(axes, (low + high) / 2, float(scale), width, height)


BESIDE_THE_CAMERA = Light(np.array([0.35, 0.25, 0.9]), 0.35)


def draw(surfaces: Sequence[Surface], camera: Camera, light: Light = BESIDE_THE_CAMERA) -> np.ndarray:
    """Return red, green, blue and opacity (height, width, 4) uint8 of what the camera sees; the ground is clear."""
    width, height = camera.width * _OVERSAMPLING, camera.height * _OVERSAMPLING
    triangles = np.concatenate([t for t, _ in surfaces]) @ camera.axes.T  # (F, 3, 3)
    colours = np.repeat(np.stack([c for _, c in surfaces]), [len(t) for t, _ in surfaces], axis=0)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    seen = normals[:, 2] > _EDGE_ON * np.linalg.norm(normals, axis=1)
    triangles, normals, colours = triangles[seen], normals[seen], colours[seen]
    scale = camera.scale * _OVERSAMPLING
    corners = (triangles - camera.centre) * [scale, -scale, 1.0] + [width / 2, height / 2, 0.0]
    shaded = colours * light.on(normals)[:, None]
    which, at, depth = covered(corners, width, height)
    nearest = np.full(height * width, -np.inf)
    np.maximum.at(nearest, at, depth)
    front = depth == nearest[at]
    shown = np.full(height * width, -1)
    shown[at[front]] = which[front]
    filled = np.flatnonzero(shown >= 0)
    return _averaged(filled, shaded[shown[filled]], camera.width, camera.height)


def _averaged(at: np.ndarray, colours: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return an image (height, width, 4) uint8 of finer pixels (n,), by their places, and their colours (n, 3)."""
    row, column = np.divmod(at, width * _OVERSAMPLING)
    coarse = row // _OVERSAMPLING * width + column // _OVERSAMPLING
    count = np.bincount(coarse, minlength=height * width)
    total = np.stack([np.bincount(coarse, channel, height * width) for channel in colours.T], 1)
    image = np.concatenate([total / np.maximum(count, 1)[:, None], count[:, None] / _OVERSAMPLING**2], 1)
    return np.round(255 * image).astype(np.uint8).reshape(height, width, 4)


def covered(corners: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels whose middles triangles (F, 3, 3) cover: (n,) each, which triangle, which pixel, how near."""
    x, y, _ = np.ascontiguousarray(np.moveaxis(corners, (2, 1), (0, 1)))  # (3, F) each: limits of rows are fast
    top, rows = _between(y.min(0), y.max(0), height)
    which, row = _counted(rows)
    row += top[which]
    run, rise = (np.roll(c, -1, 0) - c for c in (x, y))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (row + 0.5 - y[:, which]) / rise[:, which]  # of each edge, down to the row
        crossing = np.where((share >= 0) & (share <= 1), x[:, which] + share * run[:, which], np.nan)
    left, columns = _between(np.fmin.reduce(crossing), np.fmax.reduce(crossing), width)
    line, column = _counted(columns)
    which, row, column = which[line], row[line], column + left[line]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = np.abs(normal[:, 2:]) > 0  # rounding leaves nothing of a face that is seen from its edge
    slope = np.where(flat, normal[:, :2] / np.where(flat, normal[:, 2:], 1.0), 0.0)
    level = corners[:, 0, 2] + (slope * corners[:, 0, :2]).sum(1)
    depth = level[which] - slope[which, 0] * (column + 0.5) - slope[which, 1] * (row + 0.5)
    return which, row * width + column, depth


def _between(low: np.ndarray, high: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first of `size` pixels whose middle is between `low` and `high` (n,), and how many; none for NaN."""
    first = np.ceil(np.clip(np.nan_to_num(low), 0, size) - 0.5).astype(int)
    last = np.floor(np.clip(np.nan_to_num(high, nan=-1.0), -1, size) - 0.5).astype(int)
    return first, np.maximum(0, last - first + 1)


def _counted(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for counts (n,) the index of each of them as often as it says, and 0, 1, 2... within each."""
    which = np.repeat(np.arange(len(counts)), counts)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)


def png(image: np.ndarray) -> bytes:
    """Return an image (height, width, 4) uint8 as PNG."""
    height, width, _ = image.shape

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], 1).tobytes()
    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 6)) + chunk(b"IEND", b"")
