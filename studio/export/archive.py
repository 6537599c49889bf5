"""Zip files that are the same whenever the same files go into them, and are read without trust."""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from studio.export.errors import ExportError

_FIXED_TIME = (1980, 1, 1, 0, 0, 0)
_PACKED = (".3mf", ".mjz")
"""Endings of files that are archives themselves, which a second compression would only make slower."""
MAX_FILES, MAX_BYTES = 2000, 256 << 20
"""The largest archive that is read: number of files, and their bytes together."""


def zipped(files: Mapping[str, bytes], compress: bool = True) -> bytes:
    """Return a zip of files by their path, without the time at which it was made."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED) as archive:
        for path, content in files.items():
            entry = zipfile.ZipInfo(path, _FIXED_TIME)
            entry.compress_type = zipfile.ZIP_STORED if path.endswith(_PACKED) else archive.compression
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)
    return buffer.getvalue()


def read_files(path: Path) -> dict[str, bytes]:
    """Return what a zip or a folder holds, by relative path. Raise ExportError for anything hostile or unreadable."""
    try:
        if path.is_dir():
            return _read_folder(path)
        if not path.is_file():
            raise ExportError(f"{path} is no file and no folder that can be read")
        if path.stat().st_size > MAX_BYTES:
            raise ExportError(f"{path} is larger than {MAX_BYTES >> 20} MiB: no bundle is")
        return unzipped(path.read_bytes())
    except OSError as error:
        raise ExportError(f"{path} can't be read: {error.strerror or error}") from error


def unzipped(content: bytes, only: str = "", most: int = MAX_BYTES) -> dict[str, bytes]:
    """Return the files of a zip by their path, or `only` one of them; ExportError for anything hostile or unreadable.

    Paths are plain ones, none twice, and none inside another that is a file.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
            wanted = [entry for entry in entries if only in ("", entry.filename)]
            _check_size(len(entries), sum(entry.file_size for entry in wanted), most)
            for entry in entries:
                check_path(entry.filename)
            if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in wanted):
                raise ExportError("it is packed so that reading it may take any amount of memory: deflate it")
            _check_apart([entry.filename for entry in entries])
            return {entry.filename: archive.read(entry) for entry in wanted}
    except ExportError:
        raise
    except Exception as error:  # zlib, lzma, bz2 and zipfile each have errors of their own
        raise ExportError(f"this is no zip that can be read: {str(error) or type(error).__name__}") from error


def _check_apart(names: list[str]) -> None:
    """Raise ExportError where two files can't lie beside one another."""
    folders = {parent.as_posix() for name in names for parent in PurePosixPath(name).parents}
    for name in names:
        if names.count(name) > 1 or PurePosixPath(name).as_posix() in folders:
            raise ExportError(f"it holds {name[:60]!r} twice, or as a file and as a folder")


def unpack(files: Mapping[str, bytes], folder: Path) -> None:
    """Write files by their paths under `folder`; ExportError for a path that leads out of it."""
    for path, content in files.items():
        check_path(path)
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(content)


def check_path(name: str) -> None:
    """Raise ExportError unless `name` is a plain relative path."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name or "\0" in name or not path.parts:
        raise ExportError(f"it holds a file with the path {name[:60]!r}: only plain relative paths are read")


def _read_folder(folder: Path) -> dict[str, bytes]:
    paths = [path for path in sorted(folder.rglob("*")) if not path.is_dir()]
    if any(path.is_symlink() or not path.is_file() for path in paths):
        raise ExportError(f"{folder} holds links or special files: only plain files are read")
    _check_size(len(paths), sum(path.stat().st_size for path in paths))
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def _check_size(files: int, size: int, most: int = MAX_BYTES) -> None:
    if files > MAX_FILES or size > most:
        raise ExportError(f"it holds {files} files of {size >> 20} MiB: at most {MAX_FILES} and {most >> 20} are read")
