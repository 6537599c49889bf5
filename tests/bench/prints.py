"""How the prints of many random designs come out: how far they are from the collision shapes, and what a slicer says.

The corners of the box are the first designs. `--slice` gives every plate to PrusaSlicer.
"""

import itertools
import re
import resource
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

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
    """Slice the plates in place of measuring the distances, one design of each task after another."""
    log: Path | None = None
    """File to which a line for each design is added: with --slice, designs that it names are left out."""
    seconds: float = 3600.0
    """Seconds after which no further design is begun, of each task where the distances are measured."""


QUICKLY = (
    "--seam-position=rear", "--perimeter-generator=classic", "--perimeters=1", "--fill-density=0",
    "--top-solid-layers=0", "--bottom-solid-layers=0", "--layer-height=0.4", "--nozzle-diameter=0.5",
    "--resolution=0.05",
)  # fmt: skip
"""Options with which a plate takes a tenth of the time. It is read, repaired, laid on the bed, cut into layers and
written as before; left out are where the nozzle changes layers, which takes half of it, and all that fills a body:
what the slicer says of those is asked by the slow tests, with its own settings."""


def measure(task: Task, chosen: list[np.ndarray], options: Prints) -> None:
    """Print how far the prints of designs (d,) are from the collision shapes, at the start and in a random posture."""
    rng, begun = np.random.default_rng(5), time.monotonic()
    found: dict[bool, list[Deviation]] = {True: [], False: []}
    lengths = [p.unit == "m" for p in task.design_space.parameters]
    for number, phi in enumerate(chosen):
        if time.monotonic() - begun > options.seconds:
            break
        model = task.spec(phi).compile()
        low, high = np.where(model.jnt_limited[:, None], model.jnt_range, [-ARM.fold, ARM.fold]).T
        parts = robot_of(task).parts(phi)
        roomy = bool(phi[lengths].min() >= MILLIMETRE * (ARM if task.name == "reacher" else SIZES).roomy)
        both = [deviation(model, parts, qpos) for qpos in (None, rng.uniform(low, high))]
        found[roomy] += both
        said = ", ".join(f"{d.outside_max:.2f} {d.inside_max:.2f} {d.crotch_max:.1f} mm" for d in both)
        _tell(f"{task.name} {number}: out of shapes, from prints, in crotches: {said}", options.log)
    for roomy, those in found.items():
        if not those:
            continue
        said = "links with room for their joints" if roomy else "a shorter link"
        worst = {name: max(getattr(d, name) for d in those) for name in ("outside_max", "inside_max", "crotch_max")}
        middle = float(np.median([d.crotch_share for d in those]))
        within = sum(d.inside_max <= PROMISED for d in those)
        _tell(
            f"{task.name}, {len(those) // 2} designs with {said}: prints out of shapes at most "
            f"{worst['outside_max']:.2f} mm, shapes from prints at most {worst['inside_max']:.2f} mm "
            f"({within} of {len(those)} postures within {PROMISED:g}); crotches {middle:.1%} of the surface on the "
            f"median, at most {worst['crotch_max']:.1f} mm", options.log,
        )  # fmt: skip


def write_plates(task: Task, phi: np.ndarray, folder: Path) -> int:
    """Write the plates of a design (d,) as 3MF, and return how many there are."""
    prints = plan_prints(robot_of(task).parts(phi), DEFAULT, task.spec(phi).compile())
    plates = {path: content for path, content in print_files(prints).items() if re.match(r"plates/.*\.3mf$", path)}
    for path, content in plates.items():
        (folder / Path(path).name).write_bytes(content)
    return len(plates)


def slice_all(options: Prints) -> int:
    """Slice the plates of all designs, tell of each, and return the number of designs with a complaint."""
    slicer = shutil.which("prusa-slicer")
    if slicer is None:
        sys.exit("prusa-slicer is missing: install Debian's package of that name")
    told = options.log.read_text() if options.log and options.log.exists() else ""
    done = {tuple(words) for words in re.findall(r"^(\w+) (\d+): \d+ plates", told, re.MULTILINE)}
    tasks = {name: make_task(name) for name in options.tasks}
    chosen = {name: designs_with_corners(task, options.designs, options.seed) for name, task in tasks.items()}
    bad, plates, begun = 0, 0, time.monotonic()
    left = [it for it in itertools.product(range(options.designs), tasks) if (it[1], str(it[0])) not in done]
    for number, name in left:
        if time.monotonic() - begun > options.seconds:
            break
        with tempfile.TemporaryDirectory() as folder:
            count = write_plates(tasks[name], chosen[name][number], Path(folder))
            try:
                said = sliced(slicer, Path(folder), DEFAULT, *QUICKLY) if count else []
            except AssertionError as error:
                said = [" ".join(str(error).split())[:500] or "no G-code inside the printer"]
        plates, bad = plates + count, bad + bool(said)
        _tell(f"{name} {number}: {count} plates, {'; '.join(said) or 'no complaint'}", options.log)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    _tell(
        f"{plates} plates sliced, {bad} designs with a complaint, {used.ru_utime + used.ru_stime:.0f} s of computing "
        f"by the slicer; left out as done before: {len(done)} designs", options.log,
    )  # fmt: skip
    return bad


def _tell(line: str, log: Path | None) -> None:
    print(line, flush=True)
    if log is not None:
        with log.open("a") as file:
            file.write(f"{line}\n")


def main(options: Prints) -> int:
    """Measure or slice the designs of each task; return 1 where a plate was complained of."""
    if options.slice:
        return min(slice_all(options), 1)
    for name in options.tasks:
        task = make_task(name)
        measure(task, designs_with_corners(task, options.designs, options.seed), options)
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Prints)))
