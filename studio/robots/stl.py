"""Surfaces as binary STL files."""

import numpy as np


def stl(vertices: np.ndarray, faces: np.ndarray, title: str) -> bytes:
    """Return a binary STL, single precision, of vertices (V, 3) and faces (F, 3)."""
    corners = vertices[faces]  # (F, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    table = np.zeros(len(faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    table["normal"] = normals / np.where(length == 0, 1.0, length)
    table["corners"] = corners
    return title.encode("ascii", "replace")[:80].ljust(80) + len(faces).to_bytes(4, "little") + table.tobytes()
