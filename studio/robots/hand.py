"""A hand as a thing: its palm and fingers, and a program that drives it in MuJoCo."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morph_core.task import Task
from morph_core.tasks.hand import PALM_RADIUS, Hand
from morph_core.tasks.printed import link_inertial, palm_inertial
from morph_core.tasks.servos import SERVOS, ServoLimits, ServoName
from morph_core.tasks.simulation import SUBSTEPS
from studio.robots import bolted, geometry
from studio.robots.geometry import PALM, SIZES
from studio.robots.parts import MILLIMETRE, Part, parts_of
from studio.robots.robot import Bought, Program, Quantity
from studio.robots.units import speeds_of, units_of

IN_POCKET = (
    "screw into its pocket; its tendon runs down through the hole beside it; weaker than the drives that were "
    "simulated (control.json), and not in the masses"
)
ABOUT_SERVOS = (
    "Assumed: one servo for each finger joint, 1:1, without loss. In the simulation the torque acts on the joint "
    "itself. A tendon over pulleys of one radius at servo and joint passes torque and speed on as they are; a ratio of "
    "r multiplies the torque by r and divides the speed by it. Friction of a tendon takes its share, which nobody has "
    "measured here, and a proximal joint that pulls the distal one's tendon along is not simulated. Rotor inertia and "
    "friction are those of control.json, not the servo's, and the servos are not in the masses."
)


@dataclass(frozen=True)
class HandRobot:
    """Palm and fingers of a task that moves a `Hand`."""

    task: Task
    hand: Hand

    file_name = "hand"
    printed = True
    has_parts = True
    about_parts = bolted.ABOUT_PARTS
    about_servos = ABOUT_SERVOS

    def parts(self, phi: np.ndarray) -> list[Part]:
        """Return palm and links of a design (d,); ValueError for one that can't be put together."""
        self.task.check_buildable(phi)
        angles, lengths = self.hand.base_angles + phi[: self.hand.fingers], phi[self.hand.fingers :]
        joints = [SIZES.joint(float(length) / MILLIMETRE) for length in lengths]
        most = SIZES.radius if self.hand.servo == "none" else PALM.servo_joint
        shoulders = [min(joint, most) for joint in joints]
        drawn = {"palm": geometry.palm(tuple(angles.tolist()), tuple(shoulders), self.hand.servo)}
        masses = {"palm": palm_inertial(angles, self.hand.servo).mass}
        for i, (length, shoulder, elbow) in enumerate(zip(lengths.tolist(), shoulders, joints, strict=True), start=1):
            millimetres = length / MILLIMETRE
            drawn[f"finger_{i}_proximal"] = geometry.link("proximal", millimetres, shoulder, elbow, "palm")
            drawn[f"finger_{i}_distal"] = geometry.link("distal", millimetres, elbow, elbow, "link")
            masses[f"finger_{i}_proximal"] = link_inertial("proximal", length).mass
            masses[f"finger_{i}_distal"] = link_inertial("distal", length).mass
        return parts_of(drawn, masses)

    @property
    def servo_joints(self) -> list[str]:
        """Names of the fingers' joints; the palm is moved by the arm that carries the hand."""
        return self._joints[1:]

    @property
    def servo_limits(self) -> ServoLimits:
        """Servo within whose limits the hand has learned."""
        return self.hand.servo_limits

    def bought(self, phi: np.ndarray, parts: Sequence[Part], servo: ServoName | None) -> list[Bought]:
        """Return bolts, pins and what drives the fingers."""
        flange = "flange ISO 9409-1-50-4-M6; not in the masses that were simulated"
        things = [bolted.pins(parts), Bought("bolt M6 x 20", 4, "palm", "steel", note=flange)]
        pocketed = self.hand.servo.upper()  # "NONE" without pockets
        if servo is None:
            own = [_servos(name, self.hand.fingers, "palm", IN_POCKET) for name in SERVOS if name == pocketed]
            return [*things, *own, *self._pocket_screws(), bolted.drives(parts)]
        inside = self.hand.fingers if servo == pocketed else 0
        places = f"{inside} in the palm's pockets, the others outside" if inside else "outside of the hand"
        note = f"one for each joint, {places}; not in the masses that were simulated"
        driven = _servos(servo, len(self.servo_joints), " ".join(self.servo_joints), note)
        supplied = "one for each servo outside of the hand, as its maker supplies or asks for"
        screws = Bought("set of mounting screws", len(self.servo_joints) - inside, note=supplied)
        return [*things, driven, *(self._pocket_screws() if inside else []), screws, self._tendon(phi)]

    def _pocket_screws(self) -> list[Bought]:
        """Return the screws of the palm's pockets, where it has some."""
        _, pilot, deep = PALM.servo_screws
        name = f"self-tapping screw for a pilot hole of {pilot:g} x {deep:g} mm"
        screws = Bought(name, 2 * self.hand.fingers, "palm", "steel", note="two for each servo in a pocket")
        return [screws] * (self.hand.servo != "none")

    def _tendon(self, phi: np.ndarray) -> Bought:
        """Return the tendons, each there and back between the palm's middle and its joint."""
        lengths = phi[self.hand.fingers :]
        shortest = 2 * (2 * PALM_RADIUS * len(lengths) + float(lengths.sum()))
        note = (
            f"at least {shortest:.2f} m in all: there and back from the palm's middle to each joint; pulleys and "
            "guides are not drawn"
        )
        return Bought("tendon", len(self.servo_joints), " ".join(self.servo_joints), note=note)

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
        joints = [Quantity(name, "rad" if i else "m") for i, name in enumerate(self._joints)]
        place = [Quantity(f"object {axis}", "m") for axis in "xyz"]
        orientation = [Quantity(f"object q{axis}", "") for axis in "wxyz"]
        return Program(
            "run_hand.py", sees=[*joints, *place, *orientation], gives=joints, orientation=len(joints) + len(place),
            arrays={**units, "middle": middle, "substeps": np.array(SUBSTEPS)},
        )  # fmt: skip

    @property
    def _joints(self) -> list[str]:
        """Names of the joints, as in the task's model."""
        fingers = range(1, self.hand.fingers + 1)
        return ["palm", *(f"finger_{i}_{link}" for i in fingers for link in ("proximal", "distal"))]


def _servos(name: ServoName, quantity: int, links: str, note: str) -> Bought:
    """Return a servo of the table as what is bought."""
    sheet = SERVOS[name]
    size = " x ".join(f"{1000 * side:.4g}" for side in sheet.size)
    return Bought(f"servo {name}", quantity, links, mass=sheet.mass, size=size, price=sheet.price, note=note)
