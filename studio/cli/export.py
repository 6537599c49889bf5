"""`morph-studio export`: write a design for simulators, printers and people; checked before it is written."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import tyro

from morph_core.tasks.servos import SERVOS
from studio.cli.arguments import RunName, RunsArguments, UsageError, parse
from studio.cli.choice import check_design, open_run
from studio.cli.output import complain, say

DesignName = Annotated[str, tyro.conf.arg(metavar="best|latest|ITERATION")]


@dataclass(frozen=True)
class ExportArguments(RunsArguments):
    """Write a design for simulators, printers and people; the files are read back and compared first."""

    run: tyro.conf.Positional[RunName] = tyro.MISSING
    """Name of a run, or the path of its folder."""
    design: DesignName = "best"
    """Design to export: the best evaluated one, the latest one, or that of an iteration (0 is the initial one)."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="PATH.zip|DIR")] = None
    """Zip or folder to write; without it, a zip among the exports of the run."""
    formats: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="mjcf|urdf|stl|3mf|glb|step|ros|ros2_control")] = (
        None
    )
    """Formats to write; without it, all but step, which needs build123d, ros, a ROS 2 package, and ros2_control, which
    adds servos to the URDF."""
    servo: Annotated[str | None, tyro.conf.arg(metavar="|".join(SERVOS))] = None
    """Real servo with which what the policy needs of a hand's joints is compared; without it, the need chooses one."""
    printer: Annotated[str | None, tyro.conf.arg(metavar="NAME|XxYxZ")] = None
    """Printer that must be able to print every part, by name or size in mm; without it, 256x256x256, and parts that are
    too large are named."""


def main(words: Sequence[str]) -> int:
    """Run `morph-studio export` with these words; return the exit status."""
    arguments = parse(ExportArguments, words, "export")
    from studio.export.bundle import build_bundle, bundle_name, check_formats, default_formats, task_of
    from studio.export.errors import ExportError
    from studio.export.place import check_place, write_bundle
    from studio.export.servos import FILE, ServoTable, check_servo, servo_text

    history = open_run(arguments.runs, arguments.run)
    check_design(history, arguments.design)
    formats, printer = arguments.formats, arguments.printer
    try:
        task = task_of(history)
        if formats is not None or printer is not None:
            check_formats(default_formats(task) if formats is None else formats, task, printer)
        if arguments.servo is not None:
            check_servo(arguments.servo, task)
    except ExportError as error:
        raise UsageError(f"export: {error}") from error
    out = arguments.out or history.folder.exports / bundle_name(history, arguments.design)
    try:
        check_place(out)
        bundle = build_bundle(history, arguments.design, formats, servo=arguments.servo, printer=printer)
        written = write_bundle(bundle, out)
    except ExportError as error:
        complain(f"morph-studio: export: {error}")
        return 1
    if arguments.servo is not None and FILE in bundle.files:
        complain(servo_text(msgspec.json.decode(bundle.files[FILE], type=ServoTable)))
    say(written)
    return 0
