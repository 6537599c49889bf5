"""Run the exported policy in MuJoCo, with numpy and mujoco alone: `python run_policy.py`.

It drives the actuators of the scene; a robot without any is moved joint by joint, and nothing stops it.
"""

import sys

import mujoco
import numpy as np
from policy import act, arrays, compare, here, size

model = mujoco.MjModel.from_xml_path(str(here / "scene.xml"))
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
seen = []
for _ in range(int(arrays["horizon"])):
    seen.append(np.concatenate([data.qpos, data.qvel])[:size])
    a = act(seen[-1])
    if model.nu:
        data.ctrl[:] = a
        mujoco.mj_step(model, data, nstep=int(arrays["substeps"]))
    else:
        mujoco.mj_integratePos(model, data.qpos, np.pad(a, (0, model.nv - len(a))), 1.0)
mujoco.mj_kinematics(model, data)
print(f"joints at {data.qpos.round(4).tolist()} after {int(arrays['horizon'])} control steps")  # noqa: T201
print(compare(np.array(seen)), file=sys.stderr)  # noqa: T201
