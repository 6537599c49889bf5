"""How many random designs read alike in every reader: 100 of each task, corners included, every file of the robot.

The readers of this environment are asked by the functions that test the bundle. Other interpreters (Drake, urchin,
older MuJoCos) are given a folder of URDFs with what the simulated robots say: `--beside PATH/python`, several times.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
import tyro

from morph_core.catalogue import TASKS, make_task
from morph_core.task import Task
from studio.export.bundle import robot_files
from studio.export.proof import unpack
from studio.export.urdf import urdf_names
from studio.export.zero import zero_of
from studio.robots.chooser import robot_of

_TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(_TESTS.parent), str(_TESTS / "studio")]

from test_export_proof import designs_with_corners, faults_of  # noqa: E402

POSTURES = 5


@dataclass(frozen=True)
class Readers:
    """How many designs, and which other interpreters read them."""

    designs: int = 100
    """Designs of each task; the corners are the first of them."""
    tasks: tuple[str, ...] = tuple(sorted(TASKS))
    seed: int = 0
    here: bool = True
    """Read with the readers of this environment too, which takes some seconds for each design."""
    beside: list[Path] = field(default_factory=list)
    """Interpreters that can import Drake, urchin or MuJoCo; each reads with all that it has."""


def expected(task: Task, phi: np.ndarray) -> dict[str, object]:
    """Return what the simulated robot says: masses [kg], limits [rad or m], places [m] of bodies in random postures."""
    model = task.spec(phi).compile()
    zero, names, rng = zero_of(model, robot_of(task).zero(phi)), urdf_names(model).joints, np.random.default_rng(1)
    data, postures = mujoco.MjData(model), []
    bodies = [model.body(b).name for b in range(1, model.nbody)]
    for _ in range(POSTURES):
        lo, hi = np.where(model.jnt_limited[:, None], model.jnt_range, [-3.0, 3.0]).T
        data.qpos[: model.njnt] = rng.uniform(lo, hi)
        mujoco.mj_kinematics(model, data)
        q = dict(zip(names, (data.qpos[: model.njnt] - zero[: model.njnt]).tolist(), strict=True))
        postures.append({"q": q, "places": dict(zip(bodies, data.xpos[1:].tolist(), strict=True))})
    limits = {names[j]: (model.jnt_range[j] - zero[j]).tolist() for j in range(model.njnt) if model.jnt_limited[j]}
    return {
        "masses": dict(zip(bodies, model.body_mass[1:].tolist(), strict=True)), "limits": limits, "postures": postures,
    }  # fmt: skip


def main(options: Readers) -> int:
    """Read every design with every reader, print the faults and how many designs were read alike."""
    failed = 0
    with tempfile.TemporaryDirectory() as place:
        for name in options.tasks:
            task = make_task(name)
            chosen = designs_with_corners(task, options.designs, options.seed)
            if options.here:
                failed += read_here(task, chosen)
            for number, phi in enumerate(chosen):
                folder = Path(place) / f"{name}_{number:03d}"
                unpack(robot_files(task, phi, robot_of(task).parts(phi), ("mjcf", "urdf")), folder)
                (folder / "robot.txt").write_text(robot_of(task).file_name)
                (folder / "expected.json").write_text(json.dumps(expected(task, phi)))
        program = Path(__file__).with_name("reader.py")
        for python in options.beside:
            ended = subprocess.run([python, program, place], check=False)
            failed += ended.returncode
    return min(failed, 1)


def read_here(task: Task, chosen: Sequence[np.ndarray]) -> int:
    """Print what the readers of this environment find wrong with designs (d,), and return with how many."""
    faulty = 0
    for number, phi in enumerate(chosen):
        faults = faults_of(task, phi)
        faulty += bool(faults)
        for fault in faults:
            print(f"{task.name} {number}: {fault}", flush=True)
        if number % 10 == 9:
            print(f"{task.name}: {number + 1 - faulty} of {number + 1} so far", flush=True)
    print(f"{task.name}: {len(chosen) - faulty} of {len(chosen)} designs alike in this environment", flush=True)
    return faulty


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Readers)))
