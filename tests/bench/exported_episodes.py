"""Play the episodes of `exported_policy.py` with an export's own files, numpy and any MuJoCo; print the successes."""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np

folder = Path(sys.argv[1])
sys.path.insert(0, str(folder))
from policy import act, arrays, size  # noqa: E402 - the export's own

given = np.load(folder / "starts.npz")
rule = json.loads(str(given["rule"]))
plan = json.loads((folder / "control.json").read_text())["joints"]
model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
data = mujoco.MjData(model)
joints, fingers = rule["joints"], rule["fingers"]
starts = given["starts"].copy()
starts[:, :joints] -= [joint["zero"] for joint in plan.values()]
distal = [model.body(f"finger_{i + 1}_distal").id for i in range(fingers)]
targets = [model.body(name).id for name in ("button", "object")]


def touching() -> np.ndarray:
    """Return (2, fingers) whether each finger's distal link touches the button and the object."""
    found = np.zeros((2, fingers), bool)
    for contact in data.contact[: data.ncon]:
        pair = {int(model.geom_bodyid[contact.geom1]), int(model.geom_bodyid[contact.geom2])}
        for finger, link in enumerate(distal):
            for i, target in enumerate(targets):
                found[i, finger] |= pair == {link, target}
    return found


def at_goal() -> bool:
    """Tell whether the goal is reached now, by the task's own rule."""
    on_button, on_body = touching()
    w, x, y, z = data.qpos[joints + 3 : joints + 7]
    upright = np.abs([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    risen = data.qpos[joints + 2] - upright @ np.array(rule["half_extents"])
    pressed = on_button.any() and data.qpos[joints + 7] < rule["pressed_at"]
    lifted = risen > rule["lift_height"] and (on_button | on_body).sum() >= 2
    besides = any(on_button[f] and on_body.sum() - on_body[f] >= 2 for f in range(fingers))
    return bool(pressed and lifted and (besides or not rule["besides_presser"]))


solved = 0
for start in starts:
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:] = start[: model.nq], start[model.nq : model.nq + model.nv]
    mujoco.mj_forward(model, data)
    reached = []
    for _ in range(int(arrays["horizon"])):
        wanted = data.qpos[:joints] + act(data.qpos[:size].copy())
        data.ctrl[:joints] = np.clip(wanted, *model.actuator_ctrlrange[:joints].T)
        mujoco.mj_step(model, data, nstep=int(arrays["substeps"]))
        reached.append(at_goal())
    solved += np.mean(reached[-10:]) >= 0.5
print(f"MuJoCo {mujoco.__version__}: {solved} of {len(starts)} episodes succeed")
