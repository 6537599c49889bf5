"""Make the parts of the computer mouse, mouse_*.obj: `python assets/make_mouse.py` writes them beside itself.

The mouse fills the unit cube about the origin, its front at x = 0.5 and its base at z = -0.5; the task scales it to
metres. Each part is convex, because MuJoCo collides a mesh's convex hull.
"""

from pathlib import Path

import manifold3d
import numpy as np
import trimesh

OUTLINE = [(-0.5, 0.56), (-0.42, 0.8), (-0.25, 0.95), (0.0, 1.0), (0.3, 0.92), (0.44, 0.76), (0.5, 0.6)]
"""(x, share of the full width): seen from above."""
PROFILE = [(-0.5, 0.38), (-0.42, 0.62), (-0.25, 0.9), (0.0, 1.0), (0.3, 0.8), (0.44, 0.64), (0.5, 0.5)]
"""(x, share of the full height): seen from the side."""
CROSS_SECTION = [(0.94, 0.0), (1.0, 0.4), (0.98, 0.75), (0.82, 0.94), (0.4, 1.0)]
"""(share of the half width, share of the height), of one half: the flanks lean in towards the table."""
FRONT = 0.06
"""x: the buttons lie in front of it."""
SEAM = -0.1
"""y: between the right button and the left one, which reaches across the middle, where a finger is."""
RECESS = 0.3
"""The left button's place is lower than the right button's by this share of the height."""
SOLE = 0.1
"""Height of the front parts' base: the mouse stands on its body alone, which saves contacts with the table."""
DECIMALS = 4


def sections(xs: list[float], bottom: float = 0.0, top: float = 1.0) -> np.ndarray:
    """Return the corners (P, 3) of the left half's cross-sections, clipped to shares of their heights."""
    half_widths = np.interp(xs, *zip(*OUTLINE, strict=True)) / 2
    heights = np.interp(xs, *zip(*PROFILE, strict=True))
    return np.array(
        [
            (x, half_width * y, height * np.clip(z, bottom, top))
            for x, half_width, height in zip(xs, half_widths, heights, strict=True)
            for y, z in CROSS_SECTION
        ]
    )


def parts() -> dict[str, trimesh.Trimesh]:
    """Return the convex parts by name."""
    xs = [x for x, _ in OUTLINE]
    rear, front = [*(x for x in xs if x < FRONT), FRONT], [FRONT, *(x for x in xs if x > FRONT)]
    body = np.concatenate([sections(rear), sections(front, top=0.0)])
    left, right = sections(front, bottom=SOLE, top=1 - RECESS), sections(front, bottom=SOLE)
    points = {
        "body": np.concatenate([body, body * [1, -1, 1]]),
        "left": np.concatenate([left, left * [1, 0, 1] + [0, SEAM, 0]]),
        "right": np.concatenate([right * [1, -1, 1], right * [1, 0, 1] + [0, SEAM, 0]]),
    }
    return {name: hull(corners) for name, corners in points.items()}


def hull(points: np.ndarray) -> trimesh.Trimesh:
    """Return the convex hull of points (P, 3), its vertices in a fixed order."""
    mesh = manifold3d.Manifold.hull_points(points).to_mesh()
    vertices = np.round(np.asarray(mesh.vert_properties, dtype=float), DECIMALS) - [0, 0, 0.5]
    order = np.lexsort(vertices.T)
    faces = np.argsort(order)[np.asarray(mesh.tri_verts)]
    faces = np.array([np.roll(face, -face.argmin()) for face in faces])
    return trimesh.Trimesh(vertices[order], faces[np.lexsort(faces.T)], process=False)


def main() -> None:
    for name, mesh in parts().items():
        text = trimesh.exchange.obj.export_obj(mesh, include_normals=False, header=None, digits=DECIMALS)
        (Path(__file__).parent / f"mouse_{name}.obj").write_text(f"{text}\n")


if __name__ == "__main__":
    main()
