"""A task's first picture: the scene as a drawing of flat faces, shown until the 3-D viewer has loaded."""

import dataclasses

import mujoco
import numpy as np

from morph_core.catalogue import make_task
from studio.viewer import shapes
from studio.viewer.figure import Figure
from studio.viewer.scene import OBLIQUE, is_flat, screen_axes
from studio.viewer.take import Shot, make_take

_MARGIN = 0.06
"""Margin of the picture, as a share of its larger side."""
_TABLE = 1.2
"""Extent of the table that is drawn, as a multiple of what stands on it."""
_LIGHT = np.array([-0.35, -0.5, 0.8]) / np.linalg.norm([-0.35, -0.5, 0.8])
_AMBIENT = 0.62
"""The share of its colour that a face keeps in the shade."""


def preview_svg(task_name: str) -> str:
    """Return an SVG of the initial design in its start posture. Raise ValueError with the choices if there is no such
    task."""
    initial = tuple(make_task(task_name).design_space.initial.tolist())
    take = make_take(Shot(task_name, (), initial))
    direction = np.array([0.0, 0.0, 1.0]) if is_flat(*take.box) else OBLIQUE
    axes = np.stack([*screen_axes(direction), direction])  # rows: right, up and towards the eye
    drawn = []
    for figure in (_cut(take.scenery, take.box), take.objects, take.robot):
        drawn += [_drawing(figure, i, axes) for i in range(len(figure))]
    drawn.sort(key=lambda drawing: drawing[0])  # the farthest is painted first
    points = np.concatenate([corners for _, corners, _ in drawn])
    lo, hi = points.min(0), points.max(0)
    margin = _MARGIN * float((hi - lo).max())
    width, height = hi - lo + 2 * margin
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{lo[0] - margin:.3f} {-hi[1] - margin:.3f} '
        f'{width:.3f} {height:.3f}" stroke-linecap="round" stroke-linejoin="round"><g transform="scale(1 -1)">'
        f"{''.join(shape for *_, shape in drawn)}</g></svg>"
    )


def _cut(scenery: Figure, box: tuple[np.ndarray, np.ndarray]) -> Figure:
    """Return the scenery with its table cut to a little more than the box; a whole table would make the rest small."""
    reach = _TABLE * np.abs(np.stack(box))[:, :2].max()
    table = np.array([name.startswith("table") for name in scenery.names], bool)
    sizes = scenery.sizes.copy()
    sizes[table, :2] = np.minimum(sizes[table, :2], reach)
    return dataclasses.replace(scenery, sizes=sizes)


def _drawing(figure: Figure, i: int, axes: np.ndarray) -> tuple[tuple[bool, float], np.ndarray, str]:
    """Return a part's place in the painter's order, corners (n, 2) m of its extent, and its SVG element."""
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, figure.wxyz[0, i].astype(float))
    seen = axes @ turn.reshape(3, 3)  # the part's own axes as the eye has them
    centre, kind, size = axes @ figure.positions[0, i].astype(float), figure.kinds[i], figure.sizes[i]
    order = (not figure.names[i].startswith("table"), float(centre[2]))
    if kind == "capsule":
        ends = centre[:2] + np.outer([-1, 1], size[2] * seen[:2, 2])
        (x0, y0), (x1, y1) = ends
        colour = _shade(figure.colours[i], axes.T @ _towards_the_eye(seen[:, 2]))
        line = f'<line x1="{x0:.4f}" y1="{y0:.4f}" x2="{x1:.4f}" y2="{y1:.4f}"'
        return order, _around(ends, size[0]), f'{line} stroke="{colour}" stroke-width="{2 * size[0]:.4f}"/>'
    if kind == "sphere" and np.ptp(size) < 1e-9:
        circle = f'<circle cx="{centre[0]:.4f}" cy="{centre[1]:.4f}" r="{size[0]:.4f}"'
        return order, _around(centre[None, :2], size[0]), f'{circle} fill="{_shade(figure.colours[i], _LIGHT)}"/>'
    mesh = figure.meshes[i]
    unit = {"box": shapes.box, "cylinder": shapes.cylinder, "sphere": shapes.sphere}
    vertices, faces = (mesh.vertices, mesh.faces) if mesh else unit[kind]()
    placed = centre + (vertices * size) @ seen.T
    return order, placed[:, :2], _faces(placed[faces], axes, figure.colours[i])


def _faces(corners: np.ndarray, axes: np.ndarray, colour: np.ndarray) -> str:
    """Return the faces (f, 3, 3), as the eye has them, that are turned to the eye, the farthest first."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    elements = []
    for f in np.argsort(corners[..., 2].mean(1)):
        if normals[f, 2] > 1e-6:
            points = " ".join(f"{x:.4f},{y:.4f}" for x, y, _ in corners[f])
            shade = _shade(colour, axes.T @ normals[f])
            elements.append(f'<polygon points="{points}" fill="{shade}" stroke="{shade}"/>')
    return f'<g stroke-width="{0.012 * np.ptp(corners[..., :2]):.5f}">{"".join(elements)}</g>'


def _towards_the_eye(along: np.ndarray) -> np.ndarray:
    """Return the normal (3,) of a rod's side that is turned to the eye; `along` (3,) is its axis as the eye has it."""
    normal = np.array([0.0, 0.0, 1.0]) - along[2] * along
    length = float(np.linalg.norm(normal))
    return normal / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])


def _shade(colour: np.ndarray, normal: np.ndarray) -> str:
    """Return a colour (3,) uint8 by how much light a face with this normal (3,) in the world gets."""
    light = _AMBIENT + (1 - _AMBIENT) * max(0.0, float(normal @ _LIGHT))
    red, green, blue = np.round(colour * light).astype(int)
    return f"rgb({red} {green} {blue})"


def _around(points: np.ndarray, radius: float) -> np.ndarray:
    return np.concatenate([points - radius, points + radius])
