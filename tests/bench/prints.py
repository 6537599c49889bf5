"""How the prints of many random designs come out: how far they are from the collision shapes, and what a slicer says.

The corners of the box are the first designs. `--slice` gives every plate to PrusaSlicer, which takes minutes a hand.
"""

import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import tyro

from morph_core.catalogue import TASKS, make_task
from morph_core.task import Task
from studio.export.plates import plan_prints, print_files
from studio.export.printers import DEFAULT
from studio.robots.chooser import robot_of
from studio.robots.deviation import PROMISED, Deviation, deviation
from studio.robots.geometry import ARM, SIZES
from studio.robots.parts import MILLIMETRE

_TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(_TESTS.parent), str(_TESTS / "studio")]

from test_export_proof import designs_with_corners  # noqa: E402
from test_plates import sliced  # noqa: E402


@dataclass(frozen=True)
class Prints:
    """How many designs, and what is asked of them."""

    designs: int = 100
    """Designs of each task."""
    tasks: tuple[str, ...] = tuple(sorted(TASKS))
    seed: int = 0
    slice: bool = False
    """Slice the plates in place of measuring the distances."""
    begin: int = 0
    """Number of the first design that is sliced: a part of them at a time, in several processes."""
    step: int = 1
    """Every so many designs are sliced."""
    seconds: float = 3600.0
    """Seconds for each task after which no further design is begun."""


def measure(task: Task, chosen: list[np.ndarray]) -> None:
    """Print how far the prints of designs (d,) are from the collision shapes, at the start and in a random posture."""
    rng = np.random.default_rng(5)
    found: dict[bool, list[Deviation]] = {True: [], False: []}
    lengths = [p.unit == "m" for p in task.design_space.parameters]
    for phi in chosen:
        model = task.spec(phi).compile()
        low, high = np.where(model.jnt_limited[:, None], model.jnt_range, [-ARM.fold, ARM.fold]).T
        parts = robot_of(task).parts(phi)
        roomy = bool(phi[lengths].min() >= MILLIMETRE * (ARM if task.name == "reacher" else SIZES).roomy)
        found[roomy] += [deviation(model, parts, qpos) for qpos in (None, rng.uniform(low, high))]
    for roomy, those in found.items():
        if not those:
            continue
        said = "links with room for their joints" if roomy else "a shorter link"
        worst = {name: max(getattr(d, name) for d in those) for name in ("outside_max", "inside_max", "crotch_max")}
        middle = float(np.median([d.crotch_share for d in those]))
        within = sum(d.inside_max <= PROMISED for d in those)
        print(
            f"{task.name}, {len(those) // 2} designs with {said}: prints out of shapes at most "
            f"{worst['outside_max']:.2f} mm, shapes from prints at most {worst['inside_max']:.2f} mm "
            f"({within} of {len(those)} postures within {PROMISED:g}); crotches {middle:.1%} of the surface on the "
            f"median, at most {worst['crotch_max']:.1f} mm",
            flush=True,
        )


def plates_of(task: Task, phi: np.ndarray) -> Iterator[bytes]:
    """Yield the plates of a design (d,) as 3MF."""
    model: mujoco.MjModel = task.spec(phi).compile()
    prints = plan_prints(robot_of(task).parts(phi), DEFAULT, model)
    for path, content in print_files(prints).items():
        if path.startswith("plates/") and path.endswith(".3mf"):
            yield content


def slice_all(task: Task, chosen: list[np.ndarray], options: Prints) -> int:
    """Slice the plates of designs (d,), print the complaints, and return the number of plates that had one."""
    slicer = shutil.which("prusa-slicer")
    if slicer is None:
        sys.exit("prusa-slicer is missing: install Debian's package of that name")
    begun, plates, bad, done = time.monotonic(), 0, 0, 0
    for number in range(options.begin, len(chosen), options.step):
        if time.monotonic() - begun > options.seconds:
            break
        for content in plates_of(task, chosen[number]):
            with tempfile.TemporaryDirectory() as folder:
                (Path(folder) / "plate.3mf").write_bytes(content)
                try:
                    said = sliced(slicer, Path(folder), DEFAULT)
                except AssertionError as error:
                    said = [str(error) or "no G-code inside the printer"]
            plates, bad = plates + 1, bad + bool(said)
            for line in said:
                print(f"{task.name} {number}: {line}", flush=True)
        done += 1
        print(f"{task.name} {number}: {plates} plates, {bad} with a complaint so far", flush=True)
    print(f"{task.name}: {plates} plates of {done} designs sliced, {bad} with a complaint", flush=True)
    return bad


def main(options: Prints) -> int:
    """Measure or slice the designs of each task; return 1 where a plate was complained of."""
    bad = 0
    for name in options.tasks:
        task = make_task(name)
        chosen = designs_with_corners(task, options.designs, options.seed)
        if options.slice:
            bad += slice_all(task, chosen, options)
        else:
            measure(task, chosen)
    return min(bad, 1)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Prints)))
