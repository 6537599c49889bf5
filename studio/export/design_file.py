"""design.json: phi with its names, units and bounds; written into every bundle and read back to go on from it."""

import codecs
import threading
from pathlib import Path

import msgspec
import numpy as np

from morph_core import inside
from morph_core.catalogue import make_task
from morph_core.design import DesignSpace
from morph_core.protocol import Measure, Parent, Whole
from studio.export.archive import MAX_BYTES, unzipped
from studio.export.errors import ExportError
from studio.new_run import StartRun
from studio.robots.parts import DENSITY

FILE = "design.json"
KIND = "morph-studio design"
FORMAT = 1
"""Format of design.json, which has not changed since the first version."""
LARGEST = 4 << 20
"""Largest design.json that is read, in bytes; the largest of today's tasks writes a few thousand."""
_one_at_a_time = threading.Lock()  # however many send one, the memory of a single zip is used
DESIGN_TYPES = "application/json,application/zip"
"""Types of the files that a browser offers for an upload: a design.json, or a bundle."""


class Value(msgspec.Struct, frozen=True, kw_only=True):
    """One design parameter; all numbers in `unit`."""

    name: str
    value: Measure
    unit: str
    lo: Measure
    hi: Measure
    locked_at: Measure | None
    hard_lo: Measure
    hard_hi: Measure
    initial: Measure


class PartEntry(msgspec.Struct, frozen=True):
    """A printed part, and the links that are made from it."""

    name: str
    links: list[str]
    mass: float
    """kg: the mass of one copy of the part."""
    density: float = DENSITY
    """kg/m^3: the mass over the volume: less than the material's where a part is printed with infill."""


class _Head(msgspec.Struct, frozen=True):
    """Fields that a design.json of any format has."""

    kind: str
    format: int


class Design(msgspec.Struct, frozen=True, kw_only=True):
    """Content of design.json: phi with its names, units and bounds, and where it comes from."""

    kind: str = KIND
    format: int = FORMAT
    task: str
    task_options: dict[str, object]
    robot: str
    """Word with which the names of the robot's files begin."""
    run: str
    design: str
    iteration: Whole
    parameters: list[Value]
    parts: list[PartEntry] = []

    @property
    def phi(self) -> np.ndarray:
        """Design phi (d,) in the order of the file."""
        return np.array([p.value for p in self.parameters])


def read_design(content: bytes) -> Design:
    """Return the design of a design.json or of a bundle, as bytes; nothing else of a bundle is looked at.

    Raise ExportError that says what is wrong.
    """
    if content.startswith(b"PK"):
        with _one_at_a_time:
            files = unzipped(content, only=FILE, most=LARGEST)
        if FILE not in files:
            raise ExportError(f"this zip holds no {FILE}: it is no bundle of morph-studio")
        content = files[FILE]
    content = content.removeprefix(codecs.BOM_UTF8)  # which some editors put in front
    try:
        head = msgspec.json.decode(content, type=_Head)
        if head.kind != KIND:
            raise ExportError(f"this is no {FILE} of morph-studio: its kind is {head.kind[:40]!r}")
        if head.format > FORMAT:
            raise ExportError(
                f"this {FILE} has format {head.format}; this version knows {FORMAT}: read it with a newer morph-studio"
            )
        return msgspec.json.decode(content, type=Design)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ExportError(f"this is no {FILE} of morph-studio: {error}") from error


def load_design(path: Path) -> Design:
    """Return the design of a design.json, a bundle's zip or a bundle's folder."""
    try:
        if path.is_dir():
            return read_design(inside.read(path, FILE, LARGEST))
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)  # a device has no size and no end
        if len(content) > MAX_BYTES:
            raise ExportError(f"{path} is too large to be a design")
        return read_design(content)
    except OSError as error:
        raise ExportError(f"{path} can't be read: {error.strerror or error}") from error


def phi_for(design: Design, task: str, space: DesignSpace) -> np.ndarray:
    """Return the design as phi (d,) of `space`, whatever its order; ExportError unless it fits task and bounds."""
    if design.task != task:
        raise ExportError(f"this is a design for {design.task[:40]}, not for {task}")
    values = {p.name: p for p in design.parameters}
    for p in space.parameters:
        if p.name not in values:
            raise ExportError(f"the design lacks {p.name}; needed are: {', '.join(space.names)}")
        if values[p.name].unit != p.unit:
            raise ExportError(f"{p.name} must be in {p.unit}, not in {values[p.name].unit[:20]}")
    foreign = sorted(set(values) - set(space.names))
    if foreign or len(design.parameters) != len(space):
        raise ExportError(f"the design names {', '.join(foreign)[:80] or 'a parameter twice'}; needed are: "
                          f"{', '.join(space.names)}")  # fmt: skip
    try:
        return space.check([values[name].value for name in space.names])
    except ValueError as error:
        raise ExportError(str(error)) from error


def starting_from(design: Design, wish: StartRun, task_options: dict[str, object] | None = None) -> StartRun:
    """Return the wish for a run of its task that starts from the design, with the bounds and locks wished for.

    `task_options` are by default those of the design. Raise ExportError unless the design fits its task.
    """
    options = design.task_options if task_options is None else task_options
    try:
        space = make_task(design.task, options).design_space
    except (ValueError, TypeError) as error:
        raise ExportError(f"this design is for a task that can't be had: {error}") from error
    phi = phi_for(design, design.task, space)
    wanted = {p.name: p for p in wish.parameters or ()}
    held = zip(space.parameters, phi.tolist(), strict=True)
    begun = [msgspec.structs.replace(wanted.get(p.name, p), initial=value) for p, value in held]
    return msgspec.structs.replace(
        wish, task=design.task, task_options=options, parameters=begun,
        parent=Parent(design.run, design.iteration),
    )  # fmt: skip
