"""A task's first picture: the scene as a drawing of flat faces, shown until the 3-D viewer has loaded."""

import numpy as np

from morph_core.catalogue import make_task
from studio.sketch import Disc, Faces, Rod, Shape, Sketch, sketch_of
from studio.viewer.take import Shot, make_take

_MARGIN = 0.06
"""Margin of the picture, as a share of its larger side."""


def preview_svg(task_name: str) -> str:
    """Return an SVG of the initial design in its start posture. Raise ValueError with the choices if there is no such
    task."""
    initial = tuple(make_task(task_name).design_space.initial.tolist())
    return svg_of(sketch_of(make_take(Shot(task_name, (), initial))))


def svg_of(sketch: Sketch) -> str:
    """Return a sketch as SVG."""
    lo, hi = sketch.low, sketch.high
    margin = _MARGIN * float((hi - lo).max())
    width, height = hi - lo + 2 * margin
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{lo[0] - margin:.3f} {-hi[1] - margin:.3f} '
        f'{width:.3f} {height:.3f}" stroke-linecap="round" stroke-linejoin="round"><g transform="scale(1 -1)">'
        f"{''.join(map(_element, sketch.shapes))}</g></svg>"
    )


def _element(shape: Shape) -> str:
    match shape:
        case Rod(ends=ends, radius=radius, colour=colour):
            (x0, y0), (x1, y1) = ends
            line = f'<line x1="{x0:.4f}" y1="{y0:.4f}" x2="{x1:.4f}" y2="{y1:.4f}"'
            return f'{line} stroke="{_rgb(colour)}" stroke-width="{2 * radius:.4f}"/>'
        case Disc(centre=centre, radius=radius, colour=colour):
            x, y = centre
            return f'<circle cx="{x:.4f}" cy="{y:.4f}" r="{radius:.4f}" fill="{_rgb(colour)}"/>'
        case Faces(corners=corners, colours=colours, seam=seam):
            faces = "".join(map(_face, corners, colours))
            return f'<g stroke-width="{seam:.5f}">{faces}</g>'


def _face(corners: np.ndarray, colour: np.ndarray) -> str:
    points = " ".join(f"{x:.4f},{y:.4f}" for x, y in corners)
    return f'<polygon points="{points}" fill="{_rgb(colour)}" stroke="{_rgb(colour)}"/>'


def _rgb(colour: np.ndarray) -> str:
    red, green, blue = colour
    return f"rgb({red} {green} {blue})"
