"""What the studio knows of a kind of robot: the protocol that export and viewer are written against."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from morph_core.tasks.servos import ServoLimits, ServoName
from studio.robots.parts import Part

PROGRAMS = Path(__file__).parent / "programs"


class Quantity(NamedTuple):
    """One entry of what a policy sees or gives."""

    name: str
    unit: str
    """Unit of the entry; empty for a number without one."""


@dataclass(frozen=True)
class Program:
    """The program that is shipped with a policy and runs it, with numpy and mujoco alone."""

    file: str
    """File name of the program's source in `PROGRAMS`."""
    sees: Sequence[Quantity]
    """What the policy sees, in its order."""
    gives: Sequence[Quantity]
    """What the policy gives, in its order."""
    orientation: int | None = None
    """Index of w of the quaternion among what the policy sees, which is the same orientation as its negative; None
    without any."""
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Arrays that the program reads from policy.npz beside the policy itself, by name. Without "middle" and
    "spread" it sees numbers as they are, without "action_scale" it gives them from -1 to 1."""
    command: str = "python run_policy.py"
    about: Sequence[str] = ()
    """Lines that README.txt says of the program beside the command."""

    @property
    def sources(self) -> dict[str, bytes]:
        """Texts of the program and of the policy as a function, by their paths in a bundle."""
        files = {"run_policy.py": self.file, "policy.py": "policy.py"}
        return {path: (PROGRAMS / file).read_bytes() for path, file in files.items()}

    @property
    def units(self) -> dict[str, np.ndarray]:
        """Middle and spread (o,) of what the policy sees, and the scale (a,) of what it gives."""
        known = {"middle": np.zeros(len(self.sees)), "spread": np.ones(len(self.sees))}
        known["action_scale"] = np.ones(len(self.gives))
        return known | {name: array for name, array in self.arrays.items() if name in known}


@dataclass(frozen=True)
class Bought:
    """One kind of thing that a robot needs beside its printed parts."""

    item: str
    quantity: int
    links: str = ""
    material: str = ""
    mass: float | None = None
    """Mass of each in kg; None where it is not known."""
    size: str = ""
    """Size in mm."""
    price: tuple[float, float] | None = None
    """Price class: USD each, from and to; None where it is not known."""
    note: str = ""


class Robot(Protocol):
    """One kind of robot, for all its designs."""

    @property
    def file_name(self) -> str:
        """Word with which the names of the robot's files begin."""
        ...

    @property
    def printed(self) -> bool:
        """Whether the parts are drawn for a printer, as heavy as simulated, and shown in place of collision shapes;
        otherwise the parts are those shapes."""
        ...

    @property
    def has_parts(self) -> bool:
        """Whether there is anything to make mesh files from."""
        ...

    def parts(self, phi: np.ndarray) -> list[Part]:
        """Return the parts of a design (d,); ValueError for one that can't be put together."""
        ...

    def bought(self, phi: np.ndarray, parts: Sequence[Part], servo: ServoName | None) -> list[Bought]:
        """Return what a design (d,) needs beside its printed parts, with the servo that was chosen to drive it."""
        ...

    @property
    def servo_joints(self) -> Sequence[str]:
        """Names of the joints that one servo each could drive; none where the torques of joints are not simulated."""
        ...

    @property
    def servo_limits(self) -> ServoLimits:
        """Servo within whose limits the task keeps these joints."""
        ...

    @property
    def about_servos(self) -> str:
        """Sentences about what is assumed between such a servo and its joint."""
        ...

    @property
    def about_parts(self) -> str:
        """Text of report.html below the table of parts, as HTML."""
        ...

    def zero(self, phi: np.ndarray) -> Mapping[str, float]:
        """Return the joint values (m, rad) of design phi (d,) which the exported files call zero, by the joints' names.

        Every reader begins at zero, and a servo without a command goes there. A joint without an entry keeps its own
        zero.
        """
        ...

    @property
    def speeds(self) -> Mapping[str, float]:
        """Fastest speed (m/s, rad/s) that the task asks of each joint, by its name; no limit without an entry."""
        ...

    def program(self, phi: np.ndarray) -> Program:
        """Return the program that runs the policy on design phi (d,)."""
        ...
