"""Run the exported policy in MuJoCo's kinematics, with numpy and mujoco alone: `python run_policy.py`.

The walls don't stop the arm here: how contact is resolved belongs to the task, not to the robot.
"""

import sys

import mujoco
import numpy as np
from policy import act, arrays, compare, here

model = mujoco.MjModel.from_xml_path(str(here / "scene.xml"))
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
seen = []
for _ in range(int(arrays["horizon"])):
    mujoco.mj_kinematics(model, data)
    heading = np.cumsum(data.qpos)
    seen.append(np.concatenate([np.sin(heading), np.cos(heading), data.qpos, data.site("tip").xpos[:2]]))
    data.qpos += act(seen[-1])
mujoco.mj_kinematics(model, data)
distance = np.linalg.norm(data.site("tip").xpos - data.geom("goal").xpos)
print(f"tip at {data.site('tip').xpos.round(3)} m, {distance:.3f} m from the goal")  # noqa: T201
print(compare(np.array(seen)), file=sys.stderr)  # noqa: T201
