"""The parametrised arm: links in a plane, one behind the other, on a foot that stands still."""

from dataclasses import dataclass

import mujoco
import numpy as np

from morph_core.tasks import palette
from morph_core.tasks.printed import arm_link_inertial, set_inertial

LINK_RADIUS = 0.06  # m
FOOT_RADIUS, FOOT_THICKNESS = 2 * LINK_RADIUS, 0.03  # m
FOOT_CLEARANCE = 0.002  # m: between the foot and the link that turns above it
JOINT_DAMPING = 1.0  # N m s/rad
JOINT_ARMATURE = 0.1  # kg m^2
SERVO_KP = 2000.0  # N m/rad
SERVO_KV = 400.0  # N m s/rad
SERVO_TORQUE = 500.0  # N m


@dataclass(frozen=True, eq=False)
class Arm:
    """The arm as it is shown and exported, with phi = [length of each link (m)]."""

    start: np.ndarray
    """(links,) rad: joint angles of the start posture."""

    def spec(self, phi: np.ndarray, name: str) -> mujoco.MjSpec:
        """Return the arm alone with design phi (links,)."""
        spec = mujoco.MjSpec()
        spec.modelname = name
        body = spec.worldbody
        foot = body.add_geom(
            name="base", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[FOOT_RADIUS, FOOT_THICKNESS / 2, 0],
            pos=[0, 0, -LINK_RADIUS - FOOT_CLEARANCE - FOOT_THICKNESS / 2], rgba=palette.BASE,
        )  # fmt: skip
        foot.contype = foot.conaffinity = 0  # it carries the first link, which no engine takes for neighbours
        for i, length in enumerate(phi):
            body = body.add_body(name=f"link_{i + 1}", pos=[phi[i - 1] if i else 0.0, 0.0, 0.0])
            body.add_joint(
                name=f"joint_{i + 1}", axis=[0, 0, 1], damping=[JOINT_DAMPING, 0, 0], armature=JOINT_ARMATURE
            )
            geom = body.add_geom(
                name=f"link_{i + 1}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, length, 0, 0],
                size=[LINK_RADIUS, 0, 0], mass=0, rgba=palette.PARTS[i % len(palette.PARTS)],
            )  # fmt: skip
            set_inertial(body, arm_link_inertial("distal" if i == len(phi) - 1 else "proximal", length))
            geom.contype, geom.conaffinity = 1, 2  # neighbouring links share a joint: they never collide
            servo = spec.add_actuator(name=f"joint_{i + 1}", target=f"joint_{i + 1}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=SERVO_KP, kv=SERVO_KV)
            servo.forcerange, servo.forcelimited = [-SERVO_TORQUE, SERVO_TORQUE], True
        body.add_site(name="tip", pos=[phi[-1], 0, 0], size=[LINK_RADIUS, 0, 0])
        spec.add_key(name="start", qpos=self.start)
        return spec

    def lengths_of(self, model: mujoco.MjModel) -> np.ndarray:
        """Return phi (links,) of a compiled arm, or of a scene with it."""
        ends = [model.body(f"link_{i}").pos[0] for i in range(2, len(self.start) + 1)]
        return np.array([*ends, model.site("tip").pos[0]])
