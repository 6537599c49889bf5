"""A body as flat triangles in the order in which they hide each other: a picture that any size can be printed of."""

import heapq

import numpy as np

from morph_core.picture import covered
from studio.film.lens import Lens
from studio.film.solid import Solid, brightness
from studio.viewer.take import Take


def triangles_of(take: Take, frame: int, lens: Lens, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles (n, 3, 2) in pixels that are seen, the hidden ones first, and colours (n, 3) up to 255.

    What hides what is looked up pixel by pixel: parts that reach into each other have no order as a whole.
    """
    robot, objects, scenery = (Solid.of(figure) for figure in (take.robot, take.objects, take.scenery))
    surfaces = [robot.at(frame), objects.at(frame), scenery.at(0)]
    colours = np.concatenate([
        take.robot.colours[robot.part],
        take.object_colours(frame)[objects.part],
        take.scenery_colours(frame)[scenery.part],
    ])  # fmt: skip
    corners, normals = (np.concatenate(pair) for pair in zip(*surfaces, strict=True))
    seen = lens.project(corners)
    (x0, x1, x2), (y0, y1, y2) = seen[..., 0].T, seen[..., 1].T
    front = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0) < -1e-9
    seen, light = seen[front], brightness(normals[front]).mean(1)[:, None]
    order = _hidden_first(seen, width, height)
    painted = colours[front] * np.minimum(light, 1) + 255 * np.maximum(light - 1, 0)
    return seen[order][..., :2], np.round(np.clip(painted[order], 0, 255)).astype(int)


def _hidden_first(seen: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the indices of those triangles (F, 3, 3) of which a pixel is seen, each after all that it hides.

    Where triangles reach into each other, so that each hides some of the other, the one that is nearer comes later.
    """
    which, at, nearness = covered(seen, width, height)
    order = np.lexsort((nearness, at))
    which, at = which[order], at[order]
    front = np.ones(len(at), bool)
    front[:-1] = at[1:] != at[:-1]
    visible = np.zeros(len(seen), bool)
    visible[which[front]] = True
    kept = visible[which]
    which, at = which[kept], at[kept]
    above = (at[1:] == at[:-1]) & (which[1:] != which[:-1])
    edges = np.unique(np.stack([which[:-1][above], which[1:][above]], 1), axis=0)
    return _sorted(np.flatnonzero(visible), edges, seen[..., 2].mean(1))


def _sorted(nodes: np.ndarray, edges: np.ndarray, nearness: np.ndarray) -> np.ndarray:
    """Return the nodes so that of each edge (m, 2) the first comes first, the farthest of those that may come next."""
    waits = np.bincount(edges[:, 1], minlength=len(nearness)).tolist()
    starts = np.searchsorted(edges[:, 0], np.arange(len(nearness) + 1)).tolist()
    after = edges[:, 1].tolist()
    near = nearness.tolist()
    ready = [(near[i], i) for i in nodes.tolist() if not waits[i]]
    heapq.heapify(ready)
    held = sorted(((near[i], i) for i in nodes.tolist()), reverse=True)  # the farthest is at the end
    found: list[int] = []
    done = np.zeros(len(near), bool)
    while len(found) < len(nodes):
        if ready:
            _, i = heapq.heappop(ready)
        else:  # a circle
            _, i = held.pop()
        if done[i]:
            continue
        done[i] = True
        found.append(i)
        for j in after[starts[i] : starts[i + 1]]:
            waits[j] -= 1
            if not waits[j] and not done[j]:
                heapq.heappush(ready, (near[j], j))
    return np.array(found, int)
