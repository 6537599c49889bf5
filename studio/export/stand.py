"""What a person does first with a file: load it, reset it, press play. The robot must be allowed to stand, and stay.

MuJoCo begins where all joints are at zero, without a command for any servo, or in the keyframe "start".
"""

import mujoco
import numpy as np

from studio.export.check import Check, worst
from studio.export.zero import held

DRIFT_ALLOWED = {"rad": 0.01, "m": 0.001}
"""How far a hinge (rad) or a slide (m) may move while its robot stands."""
STANDING = 1.0  # s
DEPTH_ALLOWED = 1e-9
"""m: how deep two links of a robot may be in each other, which is rounding where they touch."""
_LEGAL_ALLOWED = 1e-9  # rad or m


def check_standing(file: str, model: mujoco.MjModel, own: set[str]) -> list[Check]:
    """Check a robot in each posture with which a file begins; its bodies, by name, are `own`,."""
    starts = {"after a reset": -1} | {f'at key "{model.key(k).name}"': k for k in range(model.nkey)}
    checks = []
    for where, key in starts.items():
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, key)  # without one it is a plain reset
        mujoco.mj_forward(model, data)
        said = f"{file} in MuJoCo {where}"
        checks += [_check_legal(said, model, data), _check_apart(said, model, data, own)]
        checks.append(_check_held(said, model, data, own))
    return checks


def _check_legal(said: str, model: mujoco.MjModel, data: mujoco.MjData) -> Check:
    out = {}
    for j in np.flatnonzero(model.jnt_limited):
        value, (lo, hi) = data.qpos[model.jnt_qposadr[j]], model.jnt_range[j]
        out[model.joint(j).name] = float(max(lo - value, value - hi, 0.0))
    return worst(f"{said}: joints within their limits", _LEGAL_ALLOWED, out)


def _check_apart(said: str, model: mujoco.MjModel, data: mujoco.MjData, own: set[str]) -> Check:
    """Check that no two links are in each other, as far as those collide at all."""
    depths = {}
    for contact in data.contact:
        pair = _bodies(model, contact)
        if own.issuperset(pair):
            depths[" and ".join(pair)] = float(max(-contact.dist, 0.0))
    return worst(f"{said}: links apart (m)", DEPTH_ALLOWED, depths)


def _check_held(said: str, model: mujoco.MjModel, data: mujoco.MjData, own: set[str]) -> Check:
    """Let the servos hold the robot, unless it begins against something else, which pushes it away."""
    name = f"{said}: stands for {STANDING:g} s (of what is allowed)"
    touched = [pair for c in data.contact if c.dist < 0 and len(own.intersection(pair := _bodies(model, c))) == 1]
    if touched:
        return Check(name, 0.0, 1.0, f"not asked: it begins with {' in '.join(touched[0])}")
    joints = sorted({int(model.actuator_trnid[a, 0]) for a in held(model)})
    before = data.qpos.copy()
    while data.time < STANDING:
        mujoco.mj_step(model, data)
    moved = {}
    for j in joints:
        place = int(model.jnt_qposadr[j])
        unit = "m" if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE else "rad"
        moved[model.joint(j).name] = float(abs(data.qpos[place] - before[place])) / DRIFT_ALLOWED[unit]
    return worst(name, 1.0, moved)


def _bodies(model: mujoco.MjModel, contact: mujoco.MjContact) -> tuple[str, str]:
    first, second = (model.body(model.geom_bodyid[geom]).name for geom in (contact.geom1, contact.geom2))
    return first, second
