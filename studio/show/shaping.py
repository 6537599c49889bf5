"""What a page needs to build a hand anew for any phi: the numbers of `Hand`, its parts' moments, and their meshes."""

import base64
from dataclasses import asdict

import numpy as np

from morph_core.history import History
from morph_core.tasks import hand, printed
from morph_core.tasks.grasp import GraspTask
from studio.export.policy import policy_at
from studio.robots import stl
from studio.show.prints import LENGTH, is_printed, surfaces


def shaping_of(history: History, task: GraspTask, iteration: int, phi: np.ndarray) -> dict[str, object] | None:
    """Return what the page's shape.js builds other designs from, around phi (d,); None for a hand of another kind."""
    if not is_printed(task):
        return None
    made = task.hand
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
        "mesh_length": LENGTH,
        "meshes": {
            name: base64.b64encode(stl.stl(*surface, name)).decode() for name, surface in surfaces(task).items()
        },
        "bias_slope": _bias_slope(history, task, iteration, phi),
    }


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
