"""Where the joints of an exported robot are at zero: every reader begins there, so that zero must be allowed."""

from collections.abc import Mapping

import mujoco
import numpy as np

_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def nearest_zero(model: mujoco.MjModel) -> np.ndarray:
    """Return for each joint (njnt,) the allowed value that is nearest to its own zero, in m or rad."""
    zero = np.zeros(model.njnt)
    for j in range(model.njnt):
        if model.jnt_limited[j] and model.jnt_type[j] in _SCALAR:
            zero[j] = np.clip(0.0, *model.jnt_range[j])
    return zero


def zero_of(model: mujoco.MjModel, zero: Mapping[str, float]) -> np.ndarray:
    """Return for each joint (njnt,) the value which files call zero: that of `zero`, or the nearest allowed one."""
    found = nearest_zero(model)
    for name, value in zero.items():
        found[model.joint(name).id] = value
    return found


def moved_zero(spec: mujoco.MjSpec, zero: Mapping[str, float]) -> mujoco.MjSpec:
    """Return the same robot, whose joints are at zero where they were at `zero`, by their names.

    Bodies stand there, and limits, targets and keyframes follow. ValueError for a joint that shares its body.
    """
    spec = spec.copy()
    model = spec.compile()
    for name, value in zero.items():
        joint = spec.joint(name)
        body = joint.parent
        if len(body.joints) != 1 or int(joint.type) not in _SCALAR:
            raise ValueError(f"the zero of {name} can't be moved: only a hinge or slide that is alone on its body's")
        _move_body(body, joint, value)
        joint.range = np.subtract(joint.range, value)
        for actuator in spec.actuators:
            if actuator.target == name and is_servo(actuator):
                actuator.ctrlrange = np.subtract(actuator.ctrlrange, value)
    places = {name: int(model.joint(name).qposadr[0]) for name in zero}
    for key in spec.keys:
        qpos, ctrl = np.array(key.qpos), np.array(key.ctrl)
        for name, value in zero.items():
            qpos[places[name]] -= value
        for i, actuator in enumerate(spec.actuators):
            if len(ctrl) and is_servo(actuator):
                ctrl[i] -= zero.get(actuator.target, 0.0)
        key.qpos, key.ctrl = qpos, ctrl
    return spec


def hold_keyframes(spec: mujoco.MjSpec) -> None:
    """Let the servos of keyframes that command nothing hold their posture: no command sends a servo to zero."""
    model = spec.compile()
    for key in spec.keys:
        if not len(key.ctrl) and len(key.qpos):
            key.ctrl = servo_targets(model, np.array(key.qpos))


def servo_targets(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return the commands (nu,) with which servos hold a posture (nq,); 0 for every other actuator."""
    targets = np.zeros(model.nu)
    for a in held(model):
        targets[a] = qpos[model.jnt_qposadr[model.actuator_trnid[a, 0]]] * model.actuator_gear[a, 0]
    return targets


def held(model: mujoco.MjModel) -> list[int]:
    """Return which actuators are position servos of a hinge or slide."""
    return [
        a for a in range(model.nu)
        if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        and model.jnt_type[model.actuator_trnid[a, 0]] in _SCALAR
        and _follows(model.actuator_biastype[a], model.actuator_gainprm[a], model.actuator_biasprm[a])
    ]  # fmt: skip


def is_servo(actuator: mujoco.MjsActuator) -> bool:
    """Tell whether an actuator is a position servo of a joint."""
    at_joint = actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT
    return at_joint and _follows(actuator.biastype, actuator.gainprm, actuator.biasprm)


def _follows(biastype: int | mujoco.mjtBias, gain: np.ndarray, bias: np.ndarray) -> bool:
    """Tell whether a force is kp (target - position) - kv velocity."""
    return biastype == mujoco.mjtBias.mjBIAS_AFFINE and gain[0] > 0 and bias[0] == 0 and bias[1] == -gain[0]


def _move_body(body: mujoco.MjsBody, joint: mujoco.MjsJoint, value: float) -> None:
    """Put a body where its joint takes it at `value`."""
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    move = value * axis if joint.type == mujoco.mjtJoint.mjJNT_SLIDE else np.zeros(3)
    if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
        turn, arm = np.zeros(4), np.zeros(3)
        mujoco.mju_axisAngle2Quat(turn, axis, value)
        mujoco.mju_rotVecQuat(arm, np.array(joint.pos), turn)
        move = np.array(joint.pos) - arm
    placed = np.zeros(3)
    mujoco.mju_rotVecQuat(placed, move, np.array(body.quat))
    body.pos = np.array(body.pos) + placed
    if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
        quat = np.zeros(4)
        mujoco.mju_mulQuat(quat, np.array(body.quat), turn)
        body.quat = quat
