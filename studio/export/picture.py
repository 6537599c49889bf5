"""A picture of the assembly as PNG, drawn with numpy alone: a server may have no graphics."""

import struct
import zlib
from collections.abc import Sequence

import numpy as np

WIDTH, HEIGHT = 720, 540
_OVERSAMPLING = 2
_SAMPLES = 4.0
"""Points drawn on a surface for each pixel it covers, oversampled."""
_LIGHT = np.array([0.35, 0.25, 0.9]) / np.linalg.norm([0.35, 0.25, 0.9])  # seen from the camera: right, up, towards it
_DIRECTION = np.array([-0.75, 0.95, -0.5])
"""Of sight."""

Surface = tuple[np.ndarray, np.ndarray]
"""Triangles (F, 3, 3) in the world, and red, green, blue (3,) in [0, 1]."""


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
    pixels = (triangles - centre) * [scale, -scale, 1.0] + [width / 2, height / 2, 0.0]
    shade = 0.35 + 0.65 * np.clip(normals @ _LIGHT / np.linalg.norm(normals, axis=1), 0, 1)
    area = normals[:, 2] / 2 * scale**2
    count = np.ceil(_SAMPLES * area).astype(int) + 1
    which = np.repeat(np.arange(len(count)), count)
    u, v = _spread(len(which))
    corner = pixels[which]
    points = corner[:, 0] + u[:, None] * (corner[:, 1] - corner[:, 0]) + v[:, None] * (corner[:, 2] - corner[:, 0])
    at = points[:, 1].astype(int) * width + points[:, 0].astype(int)
    order = np.argsort(points[:, 2], kind="stable")  # what is nearest is painted last
    canvas = np.zeros((height * width, 4))
    canvas[at[order], :3] = (colours * shade[:, None])[which[order]]
    canvas[at[order], 3] = 1.0
    blocks = canvas.reshape(HEIGHT, _OVERSAMPLING, WIDTH, _OVERSAMPLING, 4)
    alpha = np.minimum(1, blocks[..., 3].mean((1, 3)) * 4 / 3)  # one missed point in four is no hole
    rgb = blocks[..., :3].sum((1, 3)) / np.maximum(blocks[..., 3].sum((1, 3)), 1)[..., None]
    return _png(np.round(255 * np.concatenate([rgb, alpha[..., None]], -1)).astype(np.uint8))


def _spread(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric coordinates of points spread evenly over a triangle (the R2 sequence, folded)."""
    i = np.arange(1, count + 1)
    u, v = (0.7548776662466927 * i) % 1, (0.5698402909980532 * i) % 1
    outside = u + v > 1
    return np.where(outside, 1 - u, u), np.where(outside, 1 - v, v)


def _png(image: np.ndarray) -> bytes:
    """Return an image (height, width, 4) uint8 as PNG."""
    height, width, _ = image.shape

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], 1).tobytes()
    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 6)) + chunk(b"IEND", b"")
