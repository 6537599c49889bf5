"""A bundle on disk: a zip or a folder that appears whole or not at all, and replaces an earlier export alone."""

import contextlib
from pathlib import Path

import msgspec

from morph_core import durable, inside
from morph_core.run_folder import SMALL_BYTES
from studio.export.archive import MAX_BYTES, unzipped
from studio.export.bundle import Bundle
from studio.export.errors import ExportError
from studio.export.proof import PROVENANCE
from studio.export.provenance import KIND, Provenance


def write_bundle(bundle: Bundle, out: Path) -> Path:
    """Write the export to `out`, a path that ends in .zip or a folder; it appears whole or not at all.

    An earlier export is replaced; ExportError if anything else is in the way.
    """
    check_place(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if _is_zip(out):
            durable.write_file(durable.where_written(out), bundle.content)
        else:
            with durable.replaced_folder(out) as draft:
                for path, content in bundle.files.items():
                    (draft / path).parent.mkdir(parents=True, exist_ok=True)
                    (draft / path).write_bytes(content)
    except OSError as error:
        raise ExportError(f"can't write {out}: {error.strerror or error}") from error
    return out


def check_place(out: Path) -> None:
    """Raise ExportError unless an export may be written to `out`: nothing is there, or an earlier one and no more."""
    if out.name in ("", ".."):
        raise ExportError(f"{out} has no name of its own: give the path of a new folder, or one that ends in .zip")
    try:
        if not out.exists() and (_is_zip(out) or not out.is_symlink()):
            return
        if _is_zip(out):
            _check_zip(out)
        else:
            _check_folder(out)
    except OSError as error:
        raise ExportError(f"can't write {out}: {error.strerror or error}") from error


def _is_zip(out: Path) -> bool:
    return out.suffix.lower() == ".zip" and not out.is_dir()


def _check_zip(out: Path) -> None:
    """Raise ExportError unless the file that is there is an earlier export."""
    earlier = None
    if out.is_file() and out.stat().st_size <= MAX_BYTES:
        with contextlib.suppress(ExportError):
            earlier = _provenance(unzipped(out.read_bytes(), only=PROVENANCE).get(PROVENANCE, b""))
    if earlier is None:
        raise ExportError(f"{out} is there and is no earlier export: choose another name")


def _check_folder(out: Path) -> None:
    """Raise ExportError unless the folder that is there is empty, or holds an earlier export and nothing else."""
    if not out.is_dir() or out.is_symlink():
        raise ExportError(f"{out} is there and is no folder: choose a path that ends in .zip, or another name")
    present = {path.relative_to(out).as_posix() for path in out.rglob("*") if not path.is_dir()}
    if not present:
        return
    earlier = _provenance(inside.read(out, PROVENANCE, SMALL_BYTES)) if PROVENANCE in present else None
    if earlier is None:
        raise ExportError(f"{out} holds other files: choose an empty or new folder")
    foreign = sorted(present - set(earlier.sha256) - {PROVENANCE})
    if foreign:
        raise ExportError(
            f"{out} holds an earlier export and other files ({', '.join(foreign[:3])}): choose another folder"
        )


def _provenance(content: bytes) -> Provenance | None:
    """Return where an export comes from, None for what is not that of one."""
    try:
        found = msgspec.json.decode(content, type=Provenance)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
    return found if found.kind == KIND else None
