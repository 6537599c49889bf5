"""A picture of the assembly as PNG, drawn with numpy alone: a server may have no graphics."""

import struct
import zlib
from collections.abc import Sequence

import numpy as np

WIDTH, HEIGHT = 720, 540
_OVERSAMPLING = 2
"""How many pixels along a side are averaged to one."""
_LIGHT = np.array([0.35, 0.25, 0.9]) / np.linalg.norm([0.35, 0.25, 0.9])  # seen from the camera: right, up, towards it
_DIRECTION = np.array([-0.75, 0.95, -0.5])
"""Direction of sight."""

Surface = tuple[np.ndarray, np.ndarray]
"""A surface of one colour: triangles (F, 3, 3) in the world, and red, green, blue (3,) in [0, 1]."""


def picture(surfaces: Sequence[Surface]) -> bytes:
    """Return a PNG on a transparent ground, seen from the side and above."""
    width, height = WIDTH * _OVERSAMPLING, HEIGHT * _OVERSAMPLING
    forward = _DIRECTION / np.linalg.norm(_DIRECTION)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    view = np.stack([right, np.cross(right, forward), -forward])
    triangles = np.concatenate([t for t, _ in surfaces]) @ view.T  # (F, 3, 3): right, up, towards the camera
    colours = np.repeat(np.stack([c for _, c in surfaces]), [len(t) for t, _ in surfaces], axis=0)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    seen = normals[:, 2] > 0
    triangles, normals, colours = triangles[seen], normals[seen], colours[seen]
    low, high = triangles.min((0, 1)), triangles.max((0, 1))
    scale = 0.92 * min(width / (high[0] - low[0]), height / (high[1] - low[1]))
    centre = (low + high) / 2
    corners = (triangles - centre) * [scale, -scale, 1.0] + [width / 2, height / 2, 0.0]
    shade = 0.35 + 0.65 * np.clip(normals @ _LIGHT / np.linalg.norm(normals, axis=1), 0, 1)
    which, at, depth = _covered(corners, width)
    order = np.argsort(depth, kind="stable")  # what is nearest is painted last
    canvas = np.zeros((height * width, 4))
    canvas[at[order], :3] = (colours * shade[:, None])[which[order]]
    canvas[at[order], 3] = 1.0
    blocks = canvas.reshape(HEIGHT, _OVERSAMPLING, WIDTH, _OVERSAMPLING, 4)
    alpha = blocks[..., 3].mean((1, 3))
    rgb = blocks[..., :3].sum((1, 3)) / np.maximum(blocks[..., 3].sum((1, 3)), 1)[..., None]
    return _png(np.round(255 * np.concatenate([rgb, alpha[..., None]], -1)).astype(np.uint8))


def _covered(corners: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels whose middles triangles (F, 3, 3) cover: (n,) each, which triangle, which pixel, how near."""
    x, y, _ = np.moveaxis(corners, 2, 0)  # (F, 3)
    top, rows = _between(y.min(1), y.max(1))
    which, row = _counted(rows)
    row += top[which]
    run, rise = (np.roll(c, -1, 1) - c for c in (x, y))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (row[:, None] + 0.5 - y[which]) / rise[which]  # of each edge, down to the row
    crossing = np.where((share >= 0) & (share <= 1), x[which] + share * run[which], np.nan)
    left, columns = _between(np.fmin.reduce(crossing, axis=1), np.fmax.reduce(crossing, axis=1))
    line, column = _counted(columns)
    which, row, column = which[line], row[line], column + left[line]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[which]
    off = np.stack([column + 0.5, row + 0.5], 1) - corners[which, 0, :2]
    depth = corners[which, 0, 2] - (normal[:, :2] * off).sum(1) / normal[:, 2]
    return which, row * width + column, depth


def _between(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first pixel whose middle is between `low` and `high` (n,), and how many there are; none for NaN."""
    first = np.ceil(np.nan_to_num(low) - 0.5).astype(int)
    return first, np.maximum(0, np.floor(np.nan_to_num(high, nan=-1.0) - 0.5).astype(int) - first + 1)


def _counted(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for counts (n,) the index of each of them as often as it says, and 0, 1, 2... within each."""
    which = np.repeat(np.arange(len(counts)), counts)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)


def _png(image: np.ndarray) -> bytes:
    """Return an image (height, width, 4) uint8 as PNG."""
    height, width, _ = image.shape

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], 1).tobytes()
    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 6)) + chunk(b"IEND", b"")
