"""The parametrised hand: a palm on a vertical slide, and fingers of two hinges round it."""

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from morph_core.design import DesignSpace
from morph_core.protocol import Parameter
from morph_core.tasks import palette
from morph_core.tasks.printed import Servo, link_inertial, palm_inertial, set_inertial
from morph_core.tasks.servos import SERVOS, ServoLimits

PALM_RADIUS = 0.06  # m
PALM_THICKNESS = 0.024  # m
PALM_RANGE = (0.06, 0.75)  # m: height of the slide
PALM_KP, PALM_KV, PALM_FORCE = 1500.0, 120.0, 100.0  # N/m, N s/m, N
PALM_DAMPING = 20.0  # N s/m
FINGER_RADIUS = 0.015  # m
FINGER_FRICTION = (1.2, 0.02, 0.0005)  # rubber on plastic; sliding, torsional, rolling
PROXIMAL_RANGE = (-0.9, 1.7)  # rad, outward
DISTAL_RANGE = (-0.6, 2.2)  # rad, inward
JOINT_KP, JOINT_KV, JOINT_TORQUE = 8.0, 0.6, 4.0  # N m/rad, N m s/rad, N m
JOINT_DAMPING, JOINT_ARMATURE = 0.1, 0.01  # N m s/rad, kg m^2
SPACING: dict[Servo, float] = {"none": 2 * FINGER_RADIUS, "mg90s": 0.0445}
"""Least distance of neighbouring fingers on the palm in m, with which neither they nor their servos overlap."""
START_PROXIMAL, START_DISTAL = 1.45, 0.25  # rad: fingers spread out and down
START_CLEARANCE = 0.09  # m: between table and fingertips
LENGTH_BOX = (0.02, 0.4)  # m
PLACEMENT_BOX = (-np.pi, np.pi)  # rad

# Who collides with whom: (contype, conaffinity). Fingers with fingers, table and object; the palm with the object.
FINGER_CONTACT = (1, 1)
PALM_CONTACT = (4, 0)
OBJECT_CONTACT = (2, 1 | 4)
TABLE_CONTACT = (0, 1 | 2)


@dataclass(frozen=True)
class Hand:
    """A hand with phi = [change of each finger's placement angle (rad), length of both links of each finger (m)]."""

    fingers: int
    initial_length: float
    start_clearance: float = START_CLEARANCE
    servo: Servo = "none"
    servo_limits: ServoLimits = "none"

    @cached_property
    def base_angles(self) -> np.ndarray:
        """Angles (n,) in rad at which the fingers of the initial design stand round the palm."""
        return 2 * np.pi * np.arange(self.fingers) / self.fingers

    @property
    def joints(self) -> int:
        """Number of joints: the palm's slide and two hinges per finger."""
        return 1 + 2 * self.fingers

    @property
    def joint_torque(self) -> float:
        """Largest torque (N m) of a finger's joint: the stall torque of the servo that limits the hand, if one does."""
        return JOINT_TORQUE if self.servo_limits == "none" else SERVOS[self.servo_limits].stall_torque

    @property
    def joint_range(self) -> np.ndarray:
        """Lower and upper limit of each joint, (joints, 2) in m or rad."""
        return np.array([PALM_RANGE, *[PROXIMAL_RANGE, DISTAL_RANGE] * self.fingers])

    @property
    def design_space(self) -> DesignSpace:
        """Box of phi (d,): placement angles, then link lengths, of all fingers."""
        fingers = range(1, self.fingers + 1)
        (near, far), (short, long) = PLACEMENT_BOX, LENGTH_BOX
        return DesignSpace(
            (
                *(
                    Parameter(f"placement_{i}", "rad", near, far, 0.0, near, far, scale=0.15, part=f"finger_{i}")
                    for i in fingers
                ),
                *(
                    Parameter(
                        f"length_{i}",
                        "m",
                        short,
                        long,
                        self.initial_length,
                        short,
                        long,
                        scale=0.08,
                        group="length",
                        part=f"finger_{i}",
                    )
                    for i in fingers
                ),
            )
        )

    def interpenetrates(self, phi: np.ndarray) -> np.ndarray:
        """Tell (...) for designs phi (..., d) whether two fingers, or their servos, are mounted inside each other.

        The start posture spreads the fingers, so that neighbours are closest at their base.
        """
        return np.any(self._distances(phi) < SPACING[self.servo], axis=-1)

    def check_spacing(self, phi: np.ndarray) -> None:
        """Raise ValueError that names the fingers of a design (d,) which interpenetrate."""
        distances = self._distances(phi)
        nearest = int(distances.argmin())
        if distances[nearest] < SPACING[self.servo]:
            first, second = (int(k[nearest]) + 1 for k in np.triu_indices(self.fingers, 1))
            raise ValueError(
                f"fingers {first} and {second} stand {1e3 * distances[nearest]:.3g} mm apart on the palm, "
                f"{1e3 * SPACING[self.servo]:g} mm are needed: this hand can't be assembled"
            )

    def _distances(self, phi: np.ndarray) -> np.ndarray:
        """Return how far apart (..., pairs) m on the palm the fingers of designs phi (..., d) are."""
        angle = self.base_angles + phi[..., : self.fingers]
        i, j = np.triu_indices(self.fingers, 1)
        return 2 * PALM_RADIUS * np.abs(np.sin((angle[..., i] - angle[..., j]) / 2))

    def start(self, phi: np.ndarray) -> np.ndarray:
        """Return the start posture (..., joints) of designs phi (..., d): fingertips above the object."""
        longest = phi[..., self.fingers :].max(-1)
        reach = longest * (np.cos(START_PROXIMAL) + np.cos(START_PROXIMAL - START_DISTAL))
        q = np.empty((*phi.shape[:-1], self.joints))
        q[..., 0] = np.clip(self.start_clearance + reach, *PALM_RANGE)
        q[..., 1::2], q[..., 2::2] = START_PROXIMAL, START_DISTAL
        return q

    def spec(self, phi: np.ndarray, name: str) -> mujoco.MjSpec:
        """Return the hand alone with design phi (d,)."""
        spec = mujoco.MjSpec()
        spec.modelname = name
        spec.compiler.degree = False
        palm = spec.worldbody.add_body(name="palm", gravcomp=1)
        palm.add_joint(
            name="palm", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], range=PALM_RANGE,
            damping=[PALM_DAMPING, 0, 0],
        )  # fmt: skip
        disc = palm.add_geom(
            name="palm", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[PALM_RADIUS, PALM_THICKNESS / 2, 0],
            pos=[0, 0, FINGER_RADIUS], mass=0, rgba=palette.BASE,
        )  # fmt: skip
        disc.contype, disc.conaffinity = PALM_CONTACT
        _add_servo(spec, "palm", PALM_RANGE, PALM_KP, PALM_KV, PALM_FORCE)
        for i in range(self.fingers):
            self._add_finger(spec, palm, i)
        self.set_design(spec, phi)
        spec.add_key(name="start", qpos=self.start(phi), ctrl=self.start(phi))
        return spec

    def set_design(self, spec: mujoco.MjSpec, phi: np.ndarray) -> None:
        """Give the hand in a spec, alone or in a scene, the design phi (d,)."""
        angles, lengths = self.base_angles + phi[: self.fingers], phi[self.fingers :]
        set_inertial(spec.body("palm"), palm_inertial(angles, self.servo))
        for i, (angle, length) in enumerate(zip(angles.tolist(), lengths.tolist(), strict=True)):
            name = _finger_name(i)
            proximal, distal = spec.body(f"{name}_proximal"), spec.body(f"{name}_distal")
            proximal.pos = [PALM_RADIUS * np.cos(angle), PALM_RADIUS * np.sin(angle), 0]
            proximal.quat = [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]
            distal.pos = [0, 0, -length]
            set_inertial(proximal, link_inertial("proximal", length))
            set_inertial(distal, link_inertial("distal", length))
            for body in (proximal, distal):
                spec.geom(body.name).fromto = [0, 0, 0, 0, 0, -length]

    def _add_finger(self, spec: mujoco.MjSpec, palm: mujoco.MjsBody, i: int) -> None:
        """Add a finger whose x points outward, without a design; it hangs down where its joints are at 0."""
        name, colour = _finger_name(i), palette.PARTS[i % len(palette.PARTS)]
        proximal = palm.add_body(name=f"{name}_proximal", gravcomp=1)
        distal = proximal.add_body(name=f"{name}_distal", gravcomp=1)
        for body, part, axis, joint_range, shade in (
            (proximal, "proximal", -1, PROXIMAL_RANGE, colour),
            (distal, "distal", 1, DISTAL_RANGE, palette.lighter(colour)),
        ):
            joint = f"{name}_{part}"
            body.add_joint(
                name=joint, axis=[0, axis, 0], range=joint_range, damping=[JOINT_DAMPING, 0, 0], armature=JOINT_ARMATURE
            )
            link = body.add_geom(
                name=joint, type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[FINGER_RADIUS, 0, 0], mass=0,
                friction=FINGER_FRICTION, condim=4, rgba=shade,
            )  # fmt: skip
            link.contype, link.conaffinity = FINGER_CONTACT
            _add_servo(spec, joint, joint_range, JOINT_KP, JOINT_KV, self.joint_torque)


def _finger_name(i: int) -> str:
    return f"finger_{i + 1}"


def _add_servo(
    spec: mujoco.MjSpec, joint: str, ctrlrange: tuple[float, float], kp: float, kv: float, force: float
) -> None:
    servo = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=kp, kv=kv)
    servo.forcerange, servo.forcelimited = [-force, force], True
    servo.ctrlrange, servo.ctrllimited = ctrlrange, True
