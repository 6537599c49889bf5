"""Run the exported policy in MuJoCo, with numpy and mujoco alone: `python run_policy.py [--view]`."""

import sys
import time

import mujoco
import numpy as np
from policy import act, arrays, compare, here, size

model = mujoco.MjModel.from_xml_path(str(here / "scene.xml"))
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
joints = len(arrays["action_scale"])
seen = []
viewer = None
if "--view" in sys.argv:
    import mujoco.viewer  # a machine without a screen may lack what it needs

    viewer = mujoco.viewer.launch_passive(model, data)
for _ in range(int(arrays["horizon"])):
    seen.append(data.qpos[:size].copy())
    data.ctrl[:joints] = np.clip(data.qpos[:joints] + act(seen[-1]), *model.actuator_ctrlrange[:joints].T)
    mujoco.mj_step(model, data, nstep=int(arrays["substeps"]))
    if viewer:
        viewer.sync()
        time.sleep(int(arrays["substeps"]) * model.opt.timestep)
print(f"object at {data.body('object').xpos.round(3)} m, button at {data.joint('button').qpos[0]:.4f} m")  # noqa: T201
print(compare(np.array(seen)), file=sys.stderr)  # noqa: T201
