"""The chosen design as one zip or folder: MJCF, URDF, the design's numbers and where they come from."""

import contextlib
import io
import json
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import mujoco
import numpy as np

from morph_core.history import History
from morph_core.run_folder import RunFolderError
from morph_core.tasks import make_task
from studio.export.errors import ExportError
from studio.export.mjcf import write_mjcf
from studio.export.provenance import KIND, Provenance, design_space_at, provenance_of
from studio.export.urdf import write_urdf
from studio.export.verify import verify

FORMATS = ("mjcf", "urdf")
PLANNED_FORMATS = ("stl", "3mf", "glb")
_FIXED_TIME = (1980, 1, 1, 0, 0, 0)
_README = """\
MJCF: mujoco.MjModel.from_xml_path("robot.xml"), or scene.xml for the robot with obstacles and goal.
URDF: yourdfpy.URDF.load("robot.urdf"), or any other reader; effort or velocity 1e6 means that the task sets no limit.
"""


def build_bundle(history: History, which: str, formats: Sequence[str] = FORMATS) -> tuple[str, bytes]:
    """Return (file name, zip) of the design `which`: "best", "latest" or an iteration.

    The files are read back and compared with the simulated robot first. Raise ExportError with what disagrees, or
    with what is allowed.
    """
    name = bundle_name(history, which)
    files = build_files(history, which, formats)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, content in sorted(files.items()):
            entry = zipfile.ZipInfo(path, _FIXED_TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)
    return name, buffer.getvalue()


def write_bundle(history: History, which: str, out: Path, formats: Sequence[str] = FORMATS) -> Path:
    """Write the export to `out`, a path that ends in .zip or a folder; it appears whole or not at all.

    An earlier export is replaced; ExportError if anything else is in the way.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if out.suffix.lower() == ".zip" and not out.is_dir():
            _replace_file(out, build_bundle(history, which, formats)[1])
        else:
            _check_replaceable(out)
            _replace_folder(out, build_files(history, which, formats))
    except OSError as error:
        raise ExportError(f"can't write {out}: {error.strerror or error}") from error
    return out


def build_files(history: History, which: str, formats: Sequence[str] = FORMATS) -> dict[str, bytes]:
    """Return the exported files by their path."""
    check_formats(formats)
    iteration, phi = _chosen(history, which)
    try:
        task = make_task(history.record.task, history.record.task_options)
        phi = _check_phi(history, phi)
    except (ValueError, TypeError) as error:
        raise ExportError(str(error)) from error
    robot, scene = task.spec(phi), task.scene(phi)
    try:
        model = robot.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ExportError(f"MuJoCo can't build this design: {error}") from error
    files: dict[str, bytes] = {}
    if "mjcf" in formats:
        files |= write_mjcf(robot, "robot.xml", "meshes") | write_mjcf(scene, "scene.xml", "meshes_scene")
    if "urdf" in formats:
        files |= write_urdf(model, "robot.urdf", task.name)
    checks = verify(files, model, only_mujoco=True)
    if not all(check.passed for check in checks):
        raise ExportError("; ".join(str(check) for check in checks if not check.passed))
    files["design.json"] = _design(history, which, iteration, phi)
    files["README.txt"] = _README.encode()
    provenance = provenance_of(history, iteration, files, [str(check) for check in checks])
    files["provenance.json"] = _json(msgspec.to_builtins(provenance))
    return files


def bundle_name(history: History, which: str) -> str:
    """Return the name of the zip: run and design, safe as a file name whatever the run is called."""
    iteration, _ = _chosen(history, which)
    label = f"{iteration:06d}" if which == str(iteration) else f"{which}-{iteration:06d}"
    run = re.sub(r"[^A-Za-z0-9._-]+", "_", history.folder.id)[:100].lstrip(".") or "run"
    return f"{run}-{label}.zip"


def check_formats(formats: Sequence[str]) -> None:
    """Raise ExportError that lists the available formats unless all of `formats` are."""
    for name in formats:
        if name in PLANNED_FORMATS:
            raise ExportError(f"the format {name} is not available yet; choose from: {', '.join(FORMATS)}")
        if name not in FORMATS:
            raise ExportError(f'unknown format "{name[:40]}"; choose from: {", ".join(FORMATS)}')
    if not formats:
        raise ExportError(f"no format given; choose from: {', '.join(FORMATS)}")


def _chosen(history: History, which: str) -> tuple[int, np.ndarray]:
    try:
        return history.design(which)
    except RunFolderError as error:
        raise ExportError(str(error)) from error


def _check_phi(history: History, phi: np.ndarray) -> np.ndarray:
    """Return phi (d,), or raise ValueError unless it is finite and inside the task's own box."""
    parameters = history.record.parameters
    if phi.shape != (len(parameters),):
        raise ValueError(f"the recorded design has {phi.size} entries; {len(parameters)} are needed")
    for p, value in zip(parameters, phi, strict=True):
        if not p.hard_lo <= value <= p.hard_hi:
            raise ValueError(f"{p.name} of the recorded design is {value:g}, outside [{p.hard_lo:g}, {p.hard_hi:g}]")
    return phi


def _design(history: History, which: str, iteration: int, phi: np.ndarray) -> bytes:
    parameters = [
        {"name": p.name, "value": float(value), "unit": p.unit, "lo": p.lo, "hi": p.hi, "locked_at": p.locked_at,
         "hard_lo": p.hard_lo, "hard_hi": p.hard_hi, "initial": p.initial}
        for p, value in zip(design_space_at(history, iteration).parameters, phi, strict=True)
    ]  # fmt: skip
    return _json({"run": history.folder.id, "design": which, "iteration": iteration, "parameters": parameters})


def _json(document: object) -> bytes:
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False).encode() + b"\n"


@contextlib.contextmanager
def _draft(out: Path) -> Iterator[Path]:
    """Give a folder beside `out` that is gone afterwards."""
    folder = Path(tempfile.mkdtemp(prefix=f".{out.name[:80]}.", dir=out.parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _replace_file(out: Path, content: bytes) -> None:
    with _draft(out) as draft:
        _write(draft / "zip", content)
        (draft / "zip").replace(out)


def _replace_folder(out: Path, files: dict[str, bytes]) -> None:
    with _draft(out) as draft:
        for path, content in files.items():
            (draft / "new" / path).parent.mkdir(parents=True, exist_ok=True)
            _write(draft / "new" / path, content)
        if out.exists():
            out.rename(draft / "old")
        try:
            (draft / "new").rename(out)
        except OSError:
            if (draft / "old").exists():
                (draft / "old").rename(out)
            raise


def _write(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _check_replaceable(out: Path) -> None:
    """Raise ExportError unless `out` is not there, is empty, or holds an earlier export and nothing else."""
    if not out.exists() and not out.is_symlink():
        return
    if not out.is_dir() or out.is_symlink():
        raise ExportError(f"{out} is there and is no folder: choose a path that ends in .zip, or another name")
    present = {path.relative_to(out).as_posix() for path in out.rglob("*") if not path.is_dir()}
    if not present:
        return
    try:
        earlier = msgspec.json.decode((out / "provenance.json").read_bytes(), type=Provenance)
    except (OSError, msgspec.DecodeError):
        earlier = None
    if earlier is None or earlier.kind != KIND:
        raise ExportError(f"{out} holds other files: choose an empty or new folder")
    foreign = sorted(present - set(earlier.sha256) - {"provenance.json"})
    if foreign:
        raise ExportError(
            f"{out} holds an earlier export and other files ({', '.join(foreign[:3])}): choose another folder"
        )
