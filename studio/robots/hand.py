"""A hand as a thing: its palm and fingers, and a program that drives it in MuJoCo."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morph_core.task import Task
from morph_core.tasks.hand import Hand
from morph_core.tasks.printed import link_inertial, palm_inertial
from morph_core.tasks.simulation import SUBSTEPS
from studio.robots import bolted, geometry
from studio.robots.geometry import PALM, SIZES
from studio.robots.parts import MILLIMETRE, Part, parts_of
from studio.robots.robot import Bought, Program
from studio.robots.units import speeds_of, units_of

SERVO_MASS = 13.4  # g, of an MG90S


@dataclass(frozen=True)
class HandRobot:
    """Palm and fingers of a task that moves a `Hand`."""

    task: Task
    hand: Hand

    file_name = "hand"
    printed = True
    has_parts = True
    about_parts = bolted.ABOUT_PARTS

    def parts(self, phi: np.ndarray) -> list[Part]:
        """Return palm and links of a design (d,); ValueError for one that can't be put together."""
        self.task.check_buildable(phi)
        angles, lengths = self.hand.base_angles + phi[: self.hand.fingers], phi[self.hand.fingers :]
        joints = [SIZES.joint(float(length) / MILLIMETRE) for length in lengths]
        most = SIZES.radius if self.hand.servo == "none" else PALM.servo_joint
        shoulders = [min(joint, most) for joint in joints]
        drawn = {"palm": geometry.palm(tuple(angles.tolist()), tuple(shoulders), self.hand.servo)}
        masses = {"palm": palm_inertial(angles, self.hand.servo).mass}
        for i, length in enumerate(lengths.tolist(), start=1):
            joint = joints[i - 1]
            for kind, root, start in (("proximal", "palm", shoulders[i - 1]), ("distal", "link", joint)):
                drawn[f"finger_{i}_{kind}"] = geometry.link(kind, length / MILLIMETRE, start, joint, root)
                masses[f"finger_{i}_{kind}"] = link_inertial(kind, length).mass
        return parts_of(drawn, masses)

    def bought(self, parts: Sequence[Part]) -> list[Bought]:
        """Return bolts, pins and what drives the fingers."""
        bolts = ["bolt M6 x 20", 4, "palm", "", "steel", "", "", "flange ISO 9409-1-50-4-M6; not in the masses"]
        servos = [
            f"servo {self.hand.servo.upper()}", self.hand.fingers, "palm", "", "", SERVO_MASS, "",
            "screw into its pocket; its tendon runs down through the hole beside it; not in the masses; weaker "
            "than the drives that were simulated: control.json",
        ]  # fmt: skip
        return [bolted.pins(parts), bolts, *[servos] * (self.hand.servo != "none"), bolted.drives(parts)]

    def zero(self, phi: np.ndarray) -> dict[str, float]:
        """Return the start posture: with hanging fingers the palm would have to be higher than its slide goes."""
        return dict(zip(self._joints, self.hand.start(phi).tolist(), strict=True))

    @property
    def speeds(self) -> dict[str, float]:
        """Speed of each joint (m/s, rad/s): the largest change of its target, over the time of a control step."""
        return dict(zip(self._joints, speeds_of(self.task), strict=True))

    def program(self, phi: np.ndarray) -> Program:
        """Return the program that runs the policy in MuJoCo's physics, where joints are measured from `zero`."""
        units = units_of(self.task)
        middle = units["middle"].copy()
        middle[: self.hand.joints] -= self.hand.start(phi)
        return Program("run_hand.py", {**units, "middle": middle, "substeps": np.array(SUBSTEPS)})

    @property
    def _joints(self) -> list[str]:
        """Names of the joints, as in the task's model."""
        fingers = range(1, self.hand.fingers + 1)
        return ["palm", *(f"finger_{i}_{link}" for i in fingers for link in ("proximal", "distal"))]
