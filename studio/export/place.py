"""A bundle on disk: a zip or a folder that appears whole or not at all, and replaces an earlier export alone."""

from pathlib import Path

import msgspec

from morph_core import durable
from studio.export.bundle import Bundle
from studio.export.errors import ExportError
from studio.export.proof import PROVENANCE
from studio.export.provenance import KIND, Provenance


def write_bundle(bundle: Bundle, out: Path) -> Path:
    """Write the export to `out`, a path that ends in .zip or a folder; it appears whole or not at all.

    An earlier export is replaced; ExportError if anything else is in the way.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if out.suffix.lower() == ".zip" and not out.is_dir():
            durable.write_file(out, bundle.content)
        else:
            _check_replaceable(out)
            with durable.replaced_folder(out) as draft:
                for path, content in bundle.files.items():
                    (draft / path).parent.mkdir(parents=True, exist_ok=True)
                    (draft / path).write_bytes(content)
    except OSError as error:
        raise ExportError(f"can't write {out}: {error.strerror or error}") from error
    return out


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
        earlier = msgspec.json.decode((out / PROVENANCE).read_bytes(), type=Provenance)
    except (OSError, msgspec.DecodeError):
        earlier = None
    if earlier is None or earlier.kind != KIND:
        raise ExportError(f"{out} holds other files: choose an empty or new folder")
    foreign = sorted(present - set(earlier.sha256) - {PROVENANCE})
    if foreign:
        raise ExportError(
            f"{out} holds an earlier export and other files ({', '.join(foreign[:3])}): choose another folder"
        )
