"""Pen-pressing: a hand of four fingers lifts a long box and presses the button on its end."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import mujoco
import numpy as np

from morph_core.config import NotNegative, most
from morph_core.tasks import palette
from morph_core.tasks.grasp import OBJECT_FRICTION, GraspTask, add_button, add_free_body
from morph_core.tasks.hand import OBJECT_CONTACT

BUTTON_HALF_SIZE = (0.02, 0.022, 0.022)  # m


@dataclass(frozen=True)
class PenPress(GraspTask):
    """A long box with a sprung button on one end face, like a pen's.

    Task: grasp the pen, lift it and hold its button pressed while it is in the hand.
    Randomised: position and heading of the pen at the start.
    Success: held: in at least half of the last ten control steps a distal link presses the button while the pen is in
    the hand, 5 cm above the table with two fingers on it, or two besides the one that presses.
    """

    half_length: Annotated[NotNegative, most(1.0, "no hand reaches round it")] = 0.28
    """m: half the pen's length; the button reaches .32 m, beyond the fingers of the initial design (.30 m)."""
    half_width: Annotated[NotNegative, most(1.0, "no hand reaches round it")] = 0.03
    """m: half the pen's width and height."""
    mass: Annotated[NotNegative, most(1000.0, "no servo lifts it")] = 0.15
    """kg: the mass of the pen without its button."""

    name: ClassVar[str] = "pen_press"
    title: ClassVar[str] = "4-finger hand lifts a pen and presses its button"
    object_noun: ClassVar[str] = "pen"
    fingers: ClassVar[int] = 4

    @property
    def half_extents(self) -> np.ndarray:
        return np.array([self.half_length, self.half_width, self.half_width])

    def add_object(self, spec: mujoco.MjSpec) -> None:
        pen = add_free_body(spec, self.half_width)
        box = pen.add_geom(
            name="object", type=mujoco.mjtGeom.mjGEOM_BOX, size=[self.half_length, self.half_width, self.half_width],
            mass=self.mass, friction=OBJECT_FRICTION, condim=4, rgba=palette.OBJECT,
        )  # fmt: skip
        box.contype, box.conaffinity = OBJECT_CONTACT
        half_size = list(BUTTON_HALF_SIZE)
        add_button(pen, [self.half_length + half_size[0], 0, 0], [1, 0, 0], half_size, self.travel, self.stiffness)
