"""What a page needs to build a hand anew for any phi: the numbers of `Hand`, its parts' moments, and their meshes."""

import base64
from dataclasses import asdict

import numpy as np

from morph_core.history import History
from morph_core.tasks import hand, printed
from morph_core.tasks.grasp import GraspTask
from studio.export.policy import policy_at
from studio.robots import geometry, stl
from studio.robots.chooser import robot_of

_LENGTH = 200.0
"""mm: length of the links whose meshes are carried; only their shaft, in the middle, grows with their length."""
_MOUNT = 40.0
"""mm: where on the palm the piece begins that carries a finger, and how wide it is."""


def shaping_of(history: History, task: GraspTask, iteration: int, phi: np.ndarray) -> dict[str, object] | None:
    """Return what the page's shape.js builds other designs from, around phi (d,); None for a hand of another kind."""
    made = task.hand
    if type(made) is not hand.Hand:
        return None
    each = printed.MOUNT if made.servo == "none" else printed.MOUNT - printed.POCKET
    return {
        "parameters": [
            {"name": p.name, "unit": p.unit, "lo": p.lo, "hi": p.hi, "value": float(value), "initial": p.initial}
            for p, value in zip(history.at(iteration).space.parameters, phi, strict=True)
        ],
        "base_angles": made.base_angles.tolist(),
        "palm_radius": hand.PALM_RADIUS,
        "palm_range": hand.PALM_RANGE,
        "palm_middle": float(task.observation_units[0][0]),
        "finger_radius": hand.FINGER_RADIUS,
        "spacing": hand.SPACING[made.servo],
        "clearance": made.start_clearance,
        "spread": [hand.START_PROXIMAL, hand.START_DISTAL],
        "density": printed.DENSITY,
        "links": {kind: asdict(moments) for kind, moments in printed.LINKS.items()},
        "plate": _moments(printed.PLATE),
        "each": _moments(each),
        "mesh_length": _LENGTH,
        "meshes": {name: base64.b64encode(stl.stl(*surface, name)).decode() for name, surface in _meshes(task).items()},
        "bias_slope": _bias_slope(history, task, iteration, phi),
    }


def _meshes(task: GraspTask) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return surfaces in mm: a palm without fingers, the piece of a palm that carries one at angle 0, and its links."""
    design = np.concatenate([np.zeros(task.hand.fingers), np.full(task.hand.fingers, _LENGTH / 1000)])
    parts = {link: part for part in robot_of(task).parts(design) for link in part.links}
    mount = geometry.palm((0.0,), (geometry.SIZES.radius,)).solid
    for normal, distance in (((1, 0, 0), _MOUNT), ((0, 1, 0), -_MOUNT / 2), ((0, -1, 0), -_MOUNT / 2)):
        mount = mount.trim_by_plane(normal, distance)
    links = {kind: parts[f"finger_1_{kind}"] for kind in ("proximal", "distal")}
    return {
        "plate": geometry.mesh(geometry.palm((), ()).solid), "mount": geometry.mesh(mount),
        **{kind: (part.vertices, part.faces) for kind, part in links.items()},
    }  # fmt: skip


def _moments(moments: printed.Moments) -> dict[str, object]:
    return {"volume": moments.volume, "first": moments.first.tolist(), "second": moments.second.tolist()}


def _bias_slope(history: History, task: GraspTask, iteration: int, phi: np.ndarray) -> list[list[float]] | None:
    """Return how the first layer's bias grows with each entry of phi, (d, hidden), in which it is linear; None where
    the policy does not see phi."""
    space, slopes = task.design_space, []
    here = policy_at(history, iteration, phi)
    if here is None:
        return None
    for i, width in enumerate(space.hi - space.lo):
        there = phi.copy()
        there[i] += width
        moved = policy_at(history, iteration, there)
        assert moved is not None  # the same checkpoint
        slopes.append((moved.biases[0].astype(float) - here.biases[0]) / width)
    return np.array(slopes).tolist() if np.any(slopes) else None
