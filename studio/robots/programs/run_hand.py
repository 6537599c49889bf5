"""Run the exported policy in MuJoCo, with numpy and mujoco alone: `python run_policy.py [--view]`."""

import sys
import time
from pathlib import Path

import mujoco
import mujoco.viewer
import numpy as np

here = Path(__file__).resolve().parent
policy = np.load(here / "policy.npz")
model = mujoco.MjModel.from_xml_path(str(here / "scene.xml"))
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
joints, pose = len(policy["action_scale"]), slice(len(policy["middle"]) - 4, len(policy["middle"]))


def act(qpos: np.ndarray) -> np.ndarray:
    """Return the change of each servo's target: the mean of the policy."""
    seen = qpos[: len(policy["middle"])].copy()
    seen[pose] *= -1 if seen[pose][0] < 0 else 1  # q and -q are the same orientation
    x = ((seen - policy["middle"]) / policy["spread"]).astype(np.float32)
    for i in range(3):
        x = policy[f"weight_{i}"] @ x + policy[f"bias_{i}"]
        x = np.tanh(x) if i < 2 else x
    return policy["action_scale"] * np.clip(x, -1, 1)


viewer = mujoco.viewer.launch_passive(model, data) if "--view" in sys.argv else None
for _ in range(int(policy["horizon"])):
    data.ctrl[:joints] = np.clip(data.qpos[:joints] + act(data.qpos), *model.actuator_ctrlrange[:joints].T)
    mujoco.mj_step(model, data, nstep=int(policy["substeps"]))
    if viewer:
        viewer.sync()
        time.sleep(int(policy["substeps"]) * model.opt.timestep)
print(f"object at {data.body('object').xpos.round(3)} m, button at {data.joint('button').qpos[0]:.4f} m")  # noqa: T201
