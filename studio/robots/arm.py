"""The arm as a thing: its foot and links, and a program that moves its joints in MuJoCo's kinematics."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morph_core.task import Task
from morph_core.tasks.printed import arm_link_inertial
from morph_core.tasks.servos import ServoLimits, ServoName
from studio.robots import bolted, geometry
from studio.robots.geometry import ARM
from studio.robots.parts import BASE, MILLIMETRE, Part, parts_of
from studio.robots.robot import Bought, Program, Quantity
from studio.robots.units import speeds_of, units_of


@dataclass(frozen=True)
class ArmRobot:
    """Foot and links of a task that moves an `Arm`."""

    task: Task

    file_name = "robot"
    printed = True
    has_parts = True
    about_parts = bolted.ABOUT_PARTS
    servo_joints = ()
    servo_limits: ServoLimits = "none"
    about_servos = ""

    def parts(self, phi: np.ndarray) -> list[Part]:
        """Return foot and links of a design (d,); ValueError for one that can't be put together."""
        self.task.check_buildable(phi)
        lengths = phi.tolist()
        # Both links of a joint have to have room for it.
        nearer = [min(pair) for pair in itertools.pairwise([lengths[0], *lengths, lengths[-1]])]
        joints = [ARM.joint(length / MILLIMETRE) for length in nearer]
        drawn, masses = {BASE: geometry.arm_base(joints[0])}, {}
        for i, length in enumerate(lengths, start=1):
            kind, root = "distal" if i == len(lengths) else "proximal", "foot" if i == 1 else "link"
            drawn[f"link_{i}"] = geometry.arm_link(kind, length / MILLIMETRE, *joints[i - 1 : i + 1], root)
            masses[f"link_{i}"] = arm_link_inertial(kind, length).mass
        return parts_of(drawn, masses)

    def bought(self, phi: np.ndarray, parts: Sequence[Part], servo: ServoName | None) -> list[Bought]:
        """Return the pins and drives of the joints."""
        return [bolted.pins(parts, ARM), bolted.drives(parts)]

    def zero(self, phi: np.ndarray) -> dict[str, float]:
        """Return nothing: stretched out along x the arm stands still, and its joints turn all the way round."""
        return {}

    @property
    def speeds(self) -> dict[str, float]:
        """Speed of each joint (rad/s): its largest change in a control step, over the step's time."""
        return {f"joint_{i}": speed for i, speed in enumerate(speeds_of(self.task), start=1)}

    def program(self, phi: np.ndarray) -> Program:
        """Return the program that runs the policy in MuJoCo's kinematics."""
        links = range(1, self.task.action_size + 1)
        turned = [Quantity(f"{wave} of the heading of link_{i}", "") for wave in ("sine", "cosine") for i in links]
        joints, tip = [Quantity(f"joint_{i}", "rad") for i in links], [Quantity(f"tip {axis}", "m") for axis in "xy"]
        return Program("run_arm.py", sees=[*turned, *joints, *tip], gives=joints, arrays=units_of(self.task))
