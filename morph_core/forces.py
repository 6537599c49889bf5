"""Contact forces of a recorded episode, worked out by MuJoCo from its postures, velocities and controls."""

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from morph_core.task import Task

_SMALLEST = 1e-3
"""Force in N below which a contact does not count."""


@dataclass(frozen=True)
class ContactForces:
    """Contacts at T + 1 instants, up to C at each; NaN where there are fewer.

    A force acts on what is carried: on the object where it touches robot or table, on the robot where that touches
    what never moves.
    """

    points: np.ndarray
    """Where something touches, (T + 1, C, 3) m."""
    forces: np.ndarray
    """The force there, (T + 1, C, 3) N in the world's axes."""


def contact_forces(task: Task, phi: np.ndarray, episode: Mapping[str, np.ndarray]) -> ContactForces:
    """Return the contact forces at every posture of an episode with design phi (d,).

    Those of posture t + 1 are under the control of step t, at the end of which it was reached. Raise ValueError where
    MuJoCo does not simulate the task, or the episode was recorded without velocities.
    """
    if "qvel" not in episode or "ctrl" not in episode:
        raise ValueError(
            f"no contact forces are known: {task.name} isn't simulated by MuJoCo, or the episode was recorded by an "
            "earlier version, without velocities"
        )
    model, robot = task.scene(phi).compile(), task.spec(phi).compile()
    carried = carried_first(model, {robot.body(i).name for i in range(1, robot.nbody)})
    ctrl = np.concatenate([episode["ctrl"][:1], episode["ctrl"]])
    return forces_at(model, carried, episode["qpos"], episode["qvel"], ctrl)


def carried_first(model: mujoco.MjModel, robot: set[str]) -> np.ndarray:
    """Return a rank (nbody,) for each body: 0 for what never moves, 1 for the robot's bodies, 2 for objects."""
    rank = np.array([1 if model.body(i).name in robot else 2 for i in range(model.nbody)])
    rank[model.body_weldid == 0] = 0
    return rank


def forces_at(
    model: mujoco.MjModel, rank: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray
) -> ContactForces:
    """Return the contact forces at instants with qpos (T, nq), qvel (T, nv) and ctrl (T, nu).

    Of the two bodies of a contact the force acts on that of the higher `rank` (nbody,), on the second of two alike.
    """
    data = mujoco.MjData(model)
    instants = []
    for position, velocity, control in zip(qpos, qvel, ctrl, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = position, velocity, control
        data.qacc_warmstart[:] = 0  # an instant must not depend on the one that was worked out before it
        mujoco.mj_forward(model, data)
        instants.append([_force(model, data, i, rank) for i in range(data.ncon)])
    felt = [[(p, f) for p, f in found if np.linalg.norm(f) > _SMALLEST] for found in instants]
    filled = np.full((len(felt), max(map(len, felt), default=0), 2, 3), np.nan)
    for t, found in enumerate(felt):
        if found:
            filled[t, : len(found)] = found
    return ContactForces(filled[:, :, 0], filled[:, :, 1])


def _force(model: mujoco.MjModel, data: mujoco.MjData, contact: int, rank: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return point (3,) and force (3,) of a contact in the world's axes."""
    wrench, touching = np.zeros(6), data.contact[contact]
    mujoco.mj_contactForce(model, data, contact, wrench)
    on_second = touching.frame.reshape(3, 3).T @ wrench[:3]
    first, second = rank[model.geom_bodyid[touching.geom]]
    return touching.pos.copy(), -on_second if first > second else on_second
