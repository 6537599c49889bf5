"""Run the exported policy in MuJoCo's kinematics, with numpy and mujoco alone: `python run_policy.py`.

The walls don't stop the arm here: how contact is resolved belongs to the task, not to the robot.
"""

from pathlib import Path

import mujoco
import numpy as np

here = Path(__file__).resolve().parent
policy = np.load(here / "policy.npz")
model = mujoco.MjModel.from_xml_path(str(here / "scene.xml"))
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)


def act(q: np.ndarray, tip: np.ndarray) -> np.ndarray:
    """Return the change of each joint angle: the mean of the policy."""
    heading = np.cumsum(q)
    seen = np.concatenate([np.sin(heading), np.cos(heading), q, tip])
    x = ((seen - policy["middle"]) / policy["spread"]).astype(np.float32)
    for i in range(3):
        x = policy[f"weight_{i}"] @ x + policy[f"bias_{i}"]
        x = np.tanh(x) if i < 2 else x
    return policy["action_scale"] * np.clip(x, -1, 1)


for _ in range(int(policy["horizon"])):
    mujoco.mj_kinematics(model, data)
    data.qpos += act(data.qpos, data.site("tip").xpos[:2])
mujoco.mj_kinematics(model, data)
distance = np.linalg.norm(data.site("tip").xpos - data.geom("goal").xpos)
print(f"tip at {data.site('tip').xpos.round(3)} m, {distance:.3f} m from the goal")  # noqa: T201
