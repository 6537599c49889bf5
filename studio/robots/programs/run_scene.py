"""Run the exported policy in MuJoCo, with numpy and mujoco alone: `python run_policy.py`.

It drives the actuators of the scene; a robot without any is moved joint by joint, and nothing stops it.
"""

from pathlib import Path

import mujoco
import numpy as np

here = Path(__file__).resolve().parent
policy = np.load(here / "policy.npz")
model = mujoco.MjModel.from_xml_path(str(here / "scene.xml"))
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)


def act(seen: np.ndarray) -> np.ndarray:
    """Return what drives the robot, where it is at `seen` = (qpos, qvel, cut short): the mean of the policy."""
    x = ((seen - policy["middle"]) / policy["spread"]).astype(np.float32)
    for i in range(3):
        x = policy[f"weight_{i}"] @ x + policy[f"bias_{i}"]
        x = np.tanh(x) if i < 2 else x
    return policy["action_scale"] * np.clip(x, -1, 1)


for _ in range(int(policy["horizon"])):
    a = act(np.concatenate([data.qpos, data.qvel])[: len(policy["middle"])])
    if model.nu:
        data.ctrl[:] = a
        mujoco.mj_step(model, data, nstep=int(policy["substeps"]))
    else:
        mujoco.mj_integratePos(model, data.qpos, np.pad(a, (0, model.nv - len(a))), 1.0)
mujoco.mj_kinematics(model, data)
print(f"joints at {data.qpos.round(4).tolist()} after {int(policy['horizon'])} control steps")  # noqa: T201
