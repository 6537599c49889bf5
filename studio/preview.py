"""A task's first picture: robot, obstacles and goal as a flat drawing, there before any 3-D viewer is."""

import mujoco
import numpy as np

from morph_core.tasks import make_task
from studio.viewer.figure import Figure
from studio.viewer.take import Shot, make_take

_MARGIN = 0.06
"""Of the picture's larger side."""


def preview_svg(task_name: str) -> str:
    """Return an SVG of the initial design in its start posture; ValueError lists the tasks if there is no such one."""
    initial = tuple(make_task(task_name).design_space.initial.tolist())
    take = make_take(Shot(task_name, (), initial))
    shapes = [_shape(figure, i) for figure in (take.scenery, take.robot) for i in range(len(figure.names))]
    points = np.concatenate([corners for corners, _ in shapes])
    lo, hi = points.min(0), points.max(0)
    margin = _MARGIN * float((hi - lo).max())
    width, height = hi - lo + 2 * margin
    drawn = "".join(shape for _, shape in shapes)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{lo[0] - margin:.3f} {-hi[1] - margin:.3f} '
        f'{width:.3f} {height:.3f}" stroke-linecap="round"><g transform="scale(1 -1)">{drawn}</g></svg>'
    )


def _shape(figure: Figure, i: int) -> tuple[np.ndarray, str]:
    """Return a part's extent in the drawing's plane, corners (2, 2) m, and its SVG element."""
    red, green, blue = figure.colours[i]
    colour, mesh = f"rgb({red} {green} {blue})", figure.meshes[i]
    position, size = figure.positions[0, i].astype(float), figure.sizes[i]
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, figure.wxyz[0, i].astype(float))
    turn = turn.reshape(3, 3)
    if mesh is not None:
        flat = (position + mesh.vertices @ turn.T)[:, :2]
        faces = (" ".join(f"{x:.3f},{y:.3f}" for x, y in flat[face]) for face in mesh.faces)
        drawn = "".join(f'<polygon points="{face}"/>' for face in faces)
        return _extent(flat), f'<g fill="{colour}" stroke="{colour}" stroke-width=".01">{drawn}</g>'
    if figure.kinds[i] == "capsule":
        ends = position[:2] + np.outer([-1, 1], size[2] * turn[:2, 2])
        (x0, y0), (x1, y1) = ends
        line = f'<line x1="{x0:.3f}" y1="{y0:.3f}" x2="{x1:.3f}" y2="{y1:.3f}"'
        return _extent(ends), f'{line} stroke="{colour}" stroke-width="{2 * size[0]:.3f}"/>'
    radius = float(size[:2].max())
    circle = f'<circle cx="{position[0]:.3f}" cy="{position[1]:.3f}" r="{radius:.3f}" fill="{colour}"/>'
    return _extent(position[:2] + np.array([[-radius, -radius], [radius, radius]])), circle


def _extent(points: np.ndarray) -> np.ndarray:
    return np.stack([points.min(0), points.max(0)])
