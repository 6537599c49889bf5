"""Read a folder of exported robots with what this interpreter has: Drake, urchin, MuJoCo; for `readers.py`."""

import importlib.util
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

Facts = Mapping[str, Any]


def off(name: str, found: Mapping[str, object], right: Mapping[str, object], allowed: float) -> Iterator[str]:
    """Yield every entry that is missing or differs by more than is allowed."""
    for key, value in right.items():
        if key not in found or not np.allclose(np.asarray(found[key]), np.asarray(value), rtol=0, atol=allowed):
            yield f"{name} of {key}: {found.get(key)} instead of {value}"


def drake(folder: Path, robot: str, facts: Facts) -> Iterator[str]:
    """Compare masses, limits and places as Drake has them."""
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(0.001)
    Parser(plant).AddModels(str(folder / f"{robot}.urdf"))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    yield from off("mass", {b: plant.GetBodyByName(b).default_mass() for b in facts["masses"]}, facts["masses"], 1e-6)
    joints = {name: plant.GetJointByName(name) for name in facts["postures"][0]["q"]}
    limits = {
        name: [joint.position_lower_limits()[0], joint.position_upper_limits()[0]] for name, joint in joints.items()
    }
    yield from off("limits", limits, facts["limits"], 1e-12)
    for posture in facts["postures"]:
        positions = plant.GetPositions(context).copy()
        for name, value in posture["q"].items():
            positions[joints[name].position_start()] = value
        plant.SetPositions(context, positions)
        poses = {b: plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(b)) for b in posture["places"]}
        yield from off("place", {b: pose.translation() for b, pose in poses.items()}, posture["places"], 1e-9)


def urchin(folder: Path, robot: str, facts: Facts) -> Iterator[str]:
    """Compare masses, limits and places as urchin has them."""
    from urchin import URDF

    model = URDF.load(str(folder / f"{robot}.urdf"), lazy_load_meshes=True)
    links = {link.name: link for link in model.links}
    yield from off("mass", {b: links[b].inertial.mass for b in facts["masses"]}, facts["masses"], 1e-6)
    limits = {j.name: [j.limit.lower, j.limit.upper] for j in model.joints if j.limit and j.name in facts["limits"]}
    yield from off("limits", limits, facts["limits"], 1e-12)
    for posture in facts["postures"]:
        poses = model.link_fk(cfg=posture["q"])
        places = {link.name: pose[:3, 3] for link, pose in poses.items()}
        yield from off("place", places, posture["places"], 1e-9)


def mujoco(folder: Path, robot: str, facts: Facts) -> Iterator[str]:
    """Compare masses of the MJCF, and masses, limits and places of the URDF, as this version of MuJoCo has them."""
    import mujoco as mj

    mjcf = mj.MjModel.from_xml_path(str(folder / f"{robot}.xml"))
    yield from off("mass", {b: mjcf.body(b).mass[0] for b in facts["masses"]}, facts["masses"], 1e-6)
    model = mj.MjModel.from_xml_path(str(folder / f"{robot}.urdf"))
    yield from off("mass", {b: model.body(b).mass[0] for b in facts["masses"]}, facts["masses"], 1e-6)
    yield from off("limits", {j: model.joint(j).range for j in facts["limits"]}, facts["limits"], 1e-12)
    data = mj.MjData(model)
    for posture in facts["postures"]:
        for name, value in posture["q"].items():
            data.joint(name).qpos[0] = value
        mj.mj_kinematics(model, data)
        yield from off("place", {b: data.body(b).xpos for b in posture["places"]}, posture["places"], 1e-9)


READERS: dict[str, Callable[[Path, str, Facts], Iterator[str]]] = {
    "pydrake": drake, "urchin": urchin, "mujoco": mujoco,
}  # fmt: skip


def main(place: Path) -> int:
    """Read every robot with every reader that is here; return how many of them found a fault."""
    failing = 0
    for library, read in READERS.items():
        if importlib.util.find_spec(library) is None:
            continue
        wrong, folders = 0, sorted(path.parent for path in place.glob("*/expected.json"))
        for folder in folders:
            facts = json.loads((folder / "expected.json").read_text())
            try:
                faults = list(read(folder, (folder / "robot.txt").read_text(), facts))
            except Exception as error:  # whatever a reader raises is its verdict on the file
                faults = [f"{type(error).__name__}: {error}"]
            wrong += bool(faults)
            for fault in faults[:3]:
                print(f"{library}: {folder.name}: {fault}")
        version = getattr(sys.modules.get(library), "__version__", "")
        print(f"{library} {version}: {len(folders) - wrong} of {len(folders)} designs alike", flush=True)
        failing += bool(wrong)
    return failing


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
