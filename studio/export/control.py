"""What URDF can't hold: servo gains, armature, contact settings and solver options, as JSON beside it."""

from collections.abc import Mapping

import mujoco
import numpy as np

from studio.export.urdf import urdf_names
from studio.export.zero import nearest_zero


def control_settings(
    robot: mujoco.MjModel, scene: mujoco.MjModel, zero: Mapping[str, float] | None = None
) -> dict[str, object]:
    """Return the settings by the names that joints and links have in the URDF; SI units.

    `zero` holds where the task has the joints, by their names in the model, which are at 0 there.
    """
    option, names, nearest = scene.opt, urdf_names(robot), nearest_zero(robot)
    places = [(zero or {}).get(robot.joint(j).name, 0.0) + float(nearest[j]) for j in range(robot.njnt)]
    return {
        "about": "force = kp (target - q) - kd qd, within +- max_force; q and targets as in the URDF, where the task's "
        "joint is at q + zero; SI units; the MJCF holds all of it",
        "solver": {
            "timestep": option.timestep,
            "integrator": _name(mujoco.mjtIntegrator, option.integrator),
            "cone": _name(mujoco.mjtCone, option.cone),
            "impratio": option.impratio,
            "iterations": int(option.iterations),
            "gravity": option.gravity.tolist(),
        },
        "joints": {names.joints[j]: _joint(robot, j, float(nearest[j]), places[j]) for j in range(robot.njnt)},
        "links": {names.links[b]: _link(robot, b) for b in range(1, robot.nbody)},
    }


def _joint(model: mujoco.MjModel, joint: int, nearest: float, zero: float) -> dict[str, object]:
    dof = int(model.jnt_dofadr[joint])
    servos = [
        {
            "kp": float(model.actuator_gainprm[a, 0]),
            "kd": float(-model.actuator_biasprm[a, 2]),
            "max_force": float(np.abs(model.actuator_forcerange[a]).max()) if model.actuator_forcelimited[a] else None,
            "targets": (model.actuator_ctrlrange[a] - nearest).tolist() if model.actuator_ctrllimited[a] else None,
        }
        for a in range(model.nu)
        if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[a, 0] == joint
    ]
    return {
        "zero": zero,
        "armature": float(model.dof_armature[dof]),
        "damping": float(model.dof_damping[dof]),
        "friction": float(model.dof_frictionloss[dof]),
        "servos": servos,
    }


def _link(model: mujoco.MjModel, body: int) -> dict[str, object]:
    first = int(model.body_geomadr[body])
    touching = [
        g for g in range(first, first + int(model.body_geomnum[body]))
        if model.geom_contype[g] or model.geom_conaffinity[g]
    ]  # fmt: skip
    contact = [
        {
            "sliding_torsional_rolling_friction": model.geom_friction[g].tolist(),
            "condim": int(model.geom_condim[g]),
            "solref": model.geom_solref[g].tolist(),
            "solimp": model.geom_solimp[g].tolist(),
        }
        for g in touching
    ]
    return {"gravity_compensation": float(model.body_gravcomp[body]), "contact": contact}


def _name(kind: type, value: int) -> str:
    return kind(value).name.split("_")[-1].lower()
