"""The chosen design as one zip or folder: what other tools read, the numbers behind it, and where they come from."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import msgspec
import mujoco
import numpy as np

from morph_core.catalogue import make_task
from morph_core.config import flattened
from morph_core.history import History
from morph_core.protocol import Evaluation
from morph_core.run_folder import RunFolderError
from morph_core.task import Task
from morph_core.tasks.servos import ServoName
from studio.export import onnx_policy, servos
from studio.export.archive import json_file, zipped
from studio.export.check import Check
from studio.export.design_file import FILE, Design, PartEntry, Value
from studio.export.errors import ExportError
from studio.export.materials import bill_csv, bill_html, bill_of_materials
from studio.export.meshes import glb
from studio.export.mjcf import oldest_reader
from studio.export.plates import Prints, plan_prints, print_files, printers_for
from studio.export.policy import Policy, Score, policy_at, policy_files
from studio.export.printers import DEFAULT, printer_of
from studio.export.prints_page import prints_html
from studio.export.proof import PROVENANCE, check_onnx, prove_robot
from studio.export.provenance import provenance_of
from studio.export.report import Section, Sheet, report
from studio.export.ros import package_name
from studio.export.servos import ServoTable, check_servo, servo_html, verdict
from studio.export.simulated import simulated_files
from studio.export.step import step_files
from studio.export.trial import Runner, Trial, is_long
from studio.export.views import views_of
from studio.export.zero import moved_zero
from studio.robots.chooser import robot_of
from studio.robots.deviation import Deviation, deviation
from studio.robots.parts import Part, colours_of
from studio.robots.robot import Robot

FORMATS = ("mjcf", "urdf", "stl", "3mf", "glb")
OPTIONAL_FORMATS = ("step", "ros", "ros2_control")
"""Formats that are written only where they are asked for: STEP needs build123d and takes long, the rest is for ROS."""
ALL_FORMATS = (*FORMATS, *OPTIONAL_FORMATS)
MESH_FORMATS = ("stl", "3mf", "glb", "step")
"""Formats that are made of parts."""
BY_HAND = "changed by hand"
"""Words behind the name of a design that no run has recorded."""
EPISODES = 256
"""Number of episodes that measure the policy's success on the exported files, and what it needs of servos: 32 of them
miss peaks, and more would make an export wait."""
_POINTS = 200
"""Random points of each link at which the distance between print and collision shapes is measured."""
_SHIPPED = Path(__file__).parent / "shipped"


@dataclass(frozen=True)
class Bundle:
    """An export that has been checked."""

    name: str
    """File name of the zip."""
    files: Mapping[str, bytes]
    checks: Sequence[Check]
    content: bytes
    """The bytes of the zip."""


def build_bundle(
    history: History,
    which: str,
    formats: Sequence[str] | None = None,
    phi: Sequence[float] | None = None,
    servo: str | None = None,
    printer: str | None = None,
) -> Bundle:
    """Return the design `which`: "best", "latest" or an iteration; `phi`, where it is given, takes its place.

    The files are read back and compared with the simulated robot first. Raise ExportError with what disagrees, or
    with what is allowed. What the policy needs is measured in the episodes that prove it, and compared with the `servo`
    that is named, or with one of the table that these episodes choose. A `printer` that is asked for, by
    name or size, must be able to print every part; parts that are too large for the default one are named.
    """
    files, checks = _build(history, which, formats, None if phi is None else np.array(phi, float), servo, printer)
    name = bundle_name(history, which, by_hand=phi is not None)
    return Bundle(name, files, checks, zipped(dict(sorted(files.items()))))


def default_formats(task: Task) -> tuple[str, ...]:
    """Return the formats that are written unless others are asked for."""
    return FORMATS if robot_of(task).has_parts else tuple(f for f in FORMATS if f not in MESH_FORMATS)


def _build(
    history: History,
    which: str,
    formats: Sequence[str] | None,
    other_phi: np.ndarray | None,
    servo: str | None,
    printer: str | None,
) -> tuple[dict[str, bytes], list[Check]]:
    iteration, phi = _chosen(history, which)
    task = task_of(history)
    if other_phi is not None:
        phi, which = other_phi, f"{which}, {BY_HAND}"
    _check_phi(history, phi)
    _check_buildable(task, phi)
    formats = default_formats(task) if formats is None else formats
    check_formats(formats, task, printer)
    wanted = None if servo is None else check_servo(servo, task)
    if wanted and "mjcf" not in formats:
        raise ExportError("what a policy needs of a servo is measured on scene.xml: choose the format mjcf with it")
    robot = robot_of(task)
    policy = policy_at(history, iteration, phi)
    program = robot.program(phi) if policy and "mjcf" in formats else None
    recorded = next(
        (e for e in reversed(history.evaluations) if e.iteration == iteration and e.phi == phi.tolist()), None
    )
    promised = _promised(history, recorded, policy) if policy and program else []
    # Episodes take seconds: the rest is made meanwhile.
    with Runner(apart=program is not None and is_long(task, EPISODES)) as runner:
        parts = parts_of_design(robot, phi)
        design = _design(history, task, which, iteration, phi, parts)
        try:
            files = simulated_files(task, phi, parts, formats)
        except (ValueError, mujoco.FatalError) as error:
            raise ExportError(f"MuJoCo can't build this design: {error}") from error
        if policy and program:
            files |= policy_files(policy, program, task.horizon)
            options = design.task_options
            runner.begin(Trial(files.copy(), task.name, options, phi.tolist(), promised, wanted, EPISODES))
        files |= seen_files(task, phi, parts, formats)
        prints = _prints(task, phi, parts, printer) if "3mf" in formats else None
        files |= print_files(prints) if prints else {}
        checks = prove_robot(files, design, task, phi, only_mujoco=True)
        if policy and program and onnx_policy.is_available():
            files[onnx_policy.FILE] = onnx_policy.onnx_file(policy, program, _facts(task, history, iteration))
            checks.append(check_onnx(files, task, phi))
        off = deviation(task.spec(phi).compile(), parts, points=_POINTS) if robot.printed else None
        views = views_of(task.spec(phi).compile(), parts) if parts else None
        came = runner.outcome()
    checks += came.checks
    if not all(check.passed for check in checks):
        raise ExportError("; ".join(str(check) for check in checks if not check.passed))
    scores = [*([msgspec.structs.replace(came.score, where="at export")] if came.score else []), *promised]
    files[FILE] = json_file(msgspec.to_builtins(design))
    oldest = _oldest(files)
    sheet = Sheet(
        title=task.title, design=design, robot=robot, parts=parts, views=views,
        formats=[*formats, *(["onnx"] if onnx_policy.FILE in files else [])], scores=scores, recorded=recorded,
        episodes=_episodes(history, recorded) if recorded else None, program=program,
        no_onnx="" if onnx_policy.is_available() else onnx_policy.MISSING,
    )  # fmt: skip
    files |= _papers(sheet, phi, prints, off, oldest, came.table, wanted)
    said, bed = [str(check) for check in checks], prints.printer.name if prints else ""
    provenance = provenance_of(history, iteration, files, said, scores, oldest, bed)
    files[PROVENANCE] = json_file(msgspec.to_builtins(provenance))
    return files, checks


def _facts(task: Task, history: History, iteration: int) -> dict[str, object]:
    """Return what a reader of the policy alone wants to know of it."""
    about = "the policy's mean, asked once in each control step; run_policy.py of the bundle shows how it is used"
    return {
        "about": about, "control_step_s": task.control_dt, "task": task.name, "run": history.folder.id,
        "iteration": iteration,
    }  # fmt: skip


def _prints(task: Task, phi: np.ndarray, parts: Sequence[Part], printer: str | None) -> Prints:
    """Return how the parts are printed; ExportError where a printer that is asked for can't print one."""
    model = task.spec(phi).compile() if robot_of(task).printed else None
    prints = plan_prints(parts, DEFAULT if printer is None else printer_of(printer), model)
    if printer is not None and prints.problems:
        able = ", ".join(printers_for(parts)) or "none of the table"
        raise ExportError(f"{'; '.join(prints.problems.values())}; printers that are large enough: {able}")
    return prints


def parts_of_design(robot: Robot, phi: np.ndarray) -> list[Part]:
    """Return the parts of a design (d,); ExportError for one that can't be put together."""
    try:
        return robot.parts(phi)
    except ValueError as error:
        raise ExportError(str(error)) from error


def robot_files(task: Task, phi: np.ndarray, parts: Sequence[Part], formats: Sequence[str]) -> dict[str, bytes]:
    """Return the robot in every format; where its parts are printed, it shows the files that are printed."""
    return simulated_files(task, phi, parts, formats) | seen_files(task, phi, parts, formats)


def seen_files(task: Task, phi: np.ndarray, parts: Sequence[Part], formats: Sequence[str]) -> dict[str, bytes]:
    """Return the robot in the formats in which people look at it."""
    files: dict[str, bytes] = {}
    if "glb" in formats:
        model = moved_zero(task.spec(phi), robot_of(task).zero(phi)).compile()
        files["assembly.glb"] = glb(parts, model, colours_of(model, parts))
    if "step" in formats:
        files |= step_files(parts)
    return files


def _papers(
    sheet: Sheet,
    phi: np.ndarray,
    prints: Prints | None,
    off: Deviation | None,
    oldest: str,
    table: ServoTable | None,
    wanted: ServoName | None,
) -> dict[str, bytes]:
    """Return what is written for people: what is on the `sheet`, and what was measured besides."""
    papers = {
        "README.txt": _readme(sheet, oldest, table).encode(),
        "LICENSE": (_SHIPPED / "LICENSE").read_bytes(),
    }
    more = [Section("Printed and simulated", f"<p>{escape(off.words)}")] if off else []
    more += [Section("Print it", prints_html(prints))] if prints else []
    if table:
        papers[servos.FILE] = json_file(msgspec.to_builtins(table))
        more.append(Section("Servos", servo_html(table)))
    if sheet.robot.printed:
        lines = bill_of_materials(sheet.robot, phi, sheet.parts, table.servo if table else wanted, prints)
        papers["BOM.csv"] = bill_csv(lines)
        more.append(Section("Bill of materials", bill_html(lines)))
    papers["report.html"] = report(dataclasses.replace(sheet, more=more))
    return papers


def _oldest(files: Mapping[str, bytes]) -> str:
    """Return the oldest MuJoCo that reads the MJCF files of a bundle; "" without any."""
    texts = [content for path, content in files.items() if path.endswith(".xml") and "/" not in path]
    return oldest_reader(texts) if texts else ""


def _readme(sheet: Sheet, oldest: str, table: ServoTable | None) -> str:
    robot, program = sheet.robot, sheet.program
    name, package = robot.file_name, package_name(sheet.design.task)
    printed = "Print:   parts/*.stl (mm), one file for each part; BOM.csv says how many"
    shapes = "Shapes:  parts/*.stl (mm), the collision shapes of each link, which stand in for parts"
    lines = {
        "mjcf": f'MuJoCo:  mujoco.MjModel.from_xml_path("{name}.xml"), or scene.xml for the robot with its task;\n'
        f"         python -m mujoco.viewer --mjcf=scene.xml, or drop {name}.mjz on live.mujoco.org;\n"
        f"         MuJoCo {oldest} and newer read the .xml files, 3.8 and newer the .mjz",
        "urdf": f'URDF:    yourdfpy.URDF.load("{name}.urdf"), or any other reader; effort or velocity 1e6 means\n'
        "         that the task sets no limit; gains, armature, contact settings, and where a joint is in the\n"
        "         task at zero, are in control.json",
        "ros": f"ROS 2:   copy ros/{package} into the src folder of a workspace; colcon build;\n"
        f"         ros2 launch {package} display.launch.py",
        "ros2_control": "         each servo has a transmission and a ros2_control interface, of mock hardware as yet",
        "stl": printed if robot.printed else shapes,
        "3mf": "         3mf/*.3mf (mm), each part as often as it is needed, on its widest side; plates/*.3mf, all of\n"
        "         them laid out on a printer; plates/*.svg shows that, plates/*.csv is what was measured"
        + "\n         print pin_coupon first: its bores have 0, 0.1 ... 0.4 mm play for a pin"
        * robot.printed,
        "glb": "Look:    assembly.glb (m)",
        "step": "CAD:     step/*.step (mm), plane faces",
    }
    said = [lines[kind] for kind in lines if kind in sheet.formats]
    if program:
        graph = "policy.onnx is the same, as one graph in physical units: python policy.py compares both"
        graph = graph if "onnx" in sheet.formats else f"no policy.onnx: {onnx_policy.MISSING}"
        said.append("\n         ".join([f"Policy:  {program.command}", *program.about, graph]))
    if table:
        said.append(f"Servos:  {verdict(table)};\n         report.html and {servos.FILE} say more")
    return "\n".join([*said, "Check:   morph-studio verify THIS_BUNDLE", "More:    report.html", ""])


def _promised(history: History, recorded: Evaluation | None, policy: Policy) -> list[Score]:
    """Return what training has measured with this very policy."""
    if recorded is None or policy.iteration != recorded.iteration:
        return []
    episodes = _episodes(history, recorded)
    return [Score(episodes, recorded.sampled_success, "in training")] if episodes else []


def _episodes(history: History, recorded: Evaluation) -> int | None:
    """Return over how many episodes training has measured success; None where nobody wrote it down."""
    episodes = recorded.episodes or flattened(history.record.config).get("evaluation.episodes")
    return episodes if isinstance(episodes, int) else None


def bundle_name(history: History, which: str, *, by_hand: bool = False) -> str:
    """Return the name of the zip: run and design, safe as a file name whatever the run is called."""
    iteration, _ = _chosen(history, which)
    label = f"{iteration:06d}" if which == str(iteration) else f"{which}-{iteration:06d}"
    run = re.sub(r"[^A-Za-z0-9._-]+", "_", history.folder.id)[:100].lstrip(".") or "run"
    return f"{run}-{label}{'-' + BY_HAND.replace(' ', '-') if by_hand else ''}.zip"


def check_formats(formats: Sequence[str], task: Task, printer: str | None = None) -> None:
    """Raise ExportError that lists what is available unless all of `formats` and the printer are."""
    has_parts = robot_of(task).has_parts
    allowed = (*default_formats(task), *(f for f in OPTIONAL_FORMATS if has_parts or f not in MESH_FORMATS))
    for name in formats:
        if name in MESH_FORMATS and name not in allowed:
            raise ExportError(f"{task.name} has no shapes for {name}; choose from: {', '.join(allowed)}")
        if name not in allowed:
            raise ExportError(f'unknown format "{name[:40]}"; choose from: {", ".join(allowed)}')
    if "ros2_control" in formats and not {"urdf", "ros"} & set(formats):
        raise ExportError("ros2_control is a part of a URDF: choose urdf or ros with it")
    if printer is not None:
        printer_of(printer)
        if "3mf" not in formats:
            raise ExportError(f"a printer is for the format 3mf, and the formats are: {', '.join(formats)}")
    if not formats:
        raise ExportError(f"no format given; choose from: {', '.join(allowed)}")


def _chosen(history: History, which: str) -> tuple[int, np.ndarray]:
    try:
        return history.design(which)
    except RunFolderError as error:
        raise ExportError(str(error)) from error


def task_of(history: History) -> Task:
    """Return the task of a run; raise ExportError if there is none like it here."""
    try:
        return make_task(history.record.task, history.record.task_options)
    except (ValueError, TypeError) as error:
        raise ExportError(str(error)) from error


def _check_phi(history: History, phi: np.ndarray) -> None:
    """Raise ExportError unless phi (d,) is finite and inside the task's own box."""
    parameters = history.record.parameters
    if phi.shape != (len(parameters),):
        raise ExportError(f"the design has {phi.size} entries; {len(parameters)} are needed")
    for p, value in zip(parameters, phi, strict=True):
        if not p.hard_lo <= value <= p.hard_hi:
            raise ExportError(f"{p.name} of the design is {value:g}, outside [{p.hard_lo:g}, {p.hard_hi:g}]")


def _check_buildable(task: Task, phi: np.ndarray) -> None:
    try:
        task.check_buildable(phi)
    except ValueError as error:
        raise ExportError(str(error)) from error


def _design(history: History, task: Task, which: str, iteration: int, phi: np.ndarray, parts: Sequence[Part]) -> Design:
    parameters = [
        Value(name=p.name, value=float(value), unit=p.unit, lo=p.lo, hi=p.hi, locked_at=p.locked_at,
              hard_lo=p.hard_lo, hard_hi=p.hard_hi, initial=p.initial)
        for p, value in zip(history.at(iteration).space.parameters, phi, strict=True)
    ]  # fmt: skip
    return Design(
        task=task.name,
        task_options=history.record.task_options,
        robot=robot_of(task).file_name,
        run=history.folder.id,
        design=which,
        iteration=iteration,
        parameters=parameters,
        parts=[PartEntry(part.name, list(part.links), part.inertial.mass, part.density) for part in parts],
    )
