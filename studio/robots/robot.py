"""What the studio knows of a kind of robot: the protocol that export and viewer are written against."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from morph_core.tasks.servos import ServoLimits, ServoName
from studio.robots.parts import Part

PROGRAMS = Path(__file__).parent / "programs"


@dataclass(frozen=True)
class Program:
    """The program that is shipped with a policy and runs it, with numpy and mujoco alone."""

    file: str
    """File name of the program's source in `PROGRAMS`."""
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Arrays that the program reads from policy.npz beside the policy itself, by name."""
    command: str = "python run_policy.py"
    about: Sequence[str] = ()
    """Lines that README.txt says of the program beside the command."""

    @property
    def source(self) -> bytes:
        """Source text of the program, as bytes."""
        return (PROGRAMS / self.file).read_bytes()


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
