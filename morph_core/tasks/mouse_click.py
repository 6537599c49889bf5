"""Mouse-clicking: a hand of five fingers lifts a computer mouse and presses its left button."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np

from morph_core.config import NotNegative
from morph_core.tasks import palette
from morph_core.tasks.grasp import OBJECT_FRICTION, GraspTask, add_button, add_free_body
from morph_core.tasks.hand import OBJECT_CONTACT, Hand

PARTS = ("body", "left", "right")
BUTTON_MIDDLE, BUTTON_HALF_SIZE = (0.31, 0.15, 0.2), (0.15, 0.24, 0.12)
"""Middle and half-size of the button as shares of the mouse's length, width and height, from the mouse's middle: on the
recess of its left front, and across the middle, so that a finger that points ahead can press it."""

START_GAP = 0.03  # m: between mouse and fingertips


@dataclass(frozen=True)
class MouseClick(GraspTask):
    """A computer mouse, larger than the hand, with a sprung button at its left front corner.

    Task: grasp the mouse, lift it and hold its button pressed while it is in the hand.
    Randomised: position and heading of the mouse at the start.
    Success: held: in at least half of the last ten control steps a distal link presses the button while the mouse is in
    the hand, 5 cm above the table with two fingers on it, or two besides the one that presses.
    """

    length: NotNegative = 0.62
    """m: length of the mouse from rear to front."""
    width: NotNegative = 0.46
    """m: the mouse's width: fingers of the initial design reach its shoulders only, those of .2 m get round them."""
    height: NotNegative = 0.14
    """m: the mouse's height."""
    mass: NotNegative = 0.4
    """kg: the mass of the mouse without its button. Half of it can be lifted without learning to squeeze."""
    travel: NotNegative = 0.015
    """m: distance by which the button can be pressed in."""

    name: ClassVar[str] = "mouse_click"
    title: ClassVar[str] = "5-finger hand lifts a mouse and presses its button"
    object_noun: ClassVar[str] = "mouse"
    fingers: ClassVar[int] = 5

    @property
    def hand(self) -> Hand:
        return Hand(self.fingers, self.initial_length, self.height + START_GAP, self.servo, self.servo_limits)

    @property
    def half_extents(self) -> np.ndarray:
        return np.array([self.length, self.width, self.height]) / 2

    def add_object(self, spec: mujoco.MjSpec) -> None:
        size = 2 * self.half_extents
        density = self.mass / (np.prod(size) * sum(_volume(*read_part(part)) for part in PARTS))
        mouse = add_free_body(spec, self.height / 2)
        for part in PARTS:
            vertices, faces = read_part(part)
            name = f"object_{part}"
            mesh = spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel(), scale=size)
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT
            geom = mouse.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, density=density, friction=OBJECT_FRICTION,
                condim=4, rgba=palette.OBJECT,
            )  # fmt: skip
            geom.contype, geom.conaffinity = OBJECT_CONTACT
        middle, half_size = (list(size * share) for share in (BUTTON_MIDDLE, BUTTON_HALF_SIZE))
        add_button(mouse, middle, [0, 0, 1], half_size, self.travel, self.stiffness)


def assets() -> Path:
    """Return the folder of meshes: inside `morph_core` where that is installed, beside it in a checkout."""
    package = Path(__file__).parents[1]
    installed = package / "assets"
    return installed if installed.is_dir() else package.parent / "assets"


@cache
def read_part(part: str) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3), in the unit cube about the origin, and faces (F, 3) of a part of the mouse."""
    rows = [line.split() for line in (assets() / f"mouse_{part}.obj").read_text().splitlines()]
    vertices = np.array([row[1:] for row in rows if row[:1] == ["v"]], dtype=float)
    return vertices, np.array([row[1:] for row in rows if row[:1] == ["f"]], dtype=np.int32) - 1


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    return float(np.linalg.det(vertices[faces]).sum() / 6)
