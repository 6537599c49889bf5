"""Zip files that are the same whenever the same files go into them, and are read without trust."""

import io
import json
import os
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

from morph_core import inside
from studio.export.errors import ExportError

_FIXED_TIME = (1980, 1, 1, 0, 0, 0)
_PACKED = (".3mf", ".mjz")
"""Endings of files that are archives themselves, which a second compression would only make slower."""
MAX_FILES, MAX_BYTES = 2000, 256 << 20
"""The largest archive that is read: number of files, and their bytes together."""


_ENTRY = b"PK\x01\x02"
"""What every entry of a zip's table of contents begins with."""
LONGEST_PATH = 255
"""Largest number of characters in the path of a file of an archive: every folder on the way there is looked at."""
MOST_ENTRIES = 10 * MAX_FILES
"""Largest number of such entries in a file, in the archives inside it too: the table is read as a whole."""


def json_file(document: object) -> bytes:
    """Return a document as a file of JSON that people can read."""
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False).encode() + b"\n"


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
    if content.count(_ENTRY) > MOST_ENTRIES:
        raise ExportError(
            f"it holds more than {MOST_ENTRIES} files, those of the archives in it counted: no bundle does"
        )
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
            return {entry.filename: _unpacked(archive, entry) for entry in wanted}
    except ExportError:
        raise
    except Exception as error:  # zlib, lzma, bz2 and zipfile each have errors of their own
        raise ExportError(f"this is no zip that can be read: {str(error) or type(error).__name__}") from error


def _unpacked(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """Return a file of an archive; no more is unpacked than it says, and where it holds more its checksum differs."""
    with archive.open(entry) as file:
        return file.read(entry.file_size)


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
    if len(name) > LONGEST_PATH:
        raise ExportError(f"it holds a file whose path has {len(name):,} characters: at most {LONGEST_PATH} are read")
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name or "\0" in name or not path.parts:
        raise ExportError(f"it holds a file with the path {name[:60]!r}: only plain relative paths are read")


def _read_folder(folder: Path) -> dict[str, bytes]:
    sizes = dict(_plain_files(folder))
    _check_size(len(sizes), sum(sizes.values()))
    return {name: inside.read(folder, name, size) for name, size in sorted(sizes.items())}


def _plain_files(folder: Path) -> Iterator[tuple[str, int]]:
    """Yield the path of each file in a folder, relative to it, and its size, until there are more than are read."""
    count, folders = 0, [""]
    while folders:
        at = folders.pop()
        with os.scandir(folder / at) as entries:
            for entry in entries:
                name = f"{at}{entry.name}"
                if entry.is_dir(follow_symlinks=False):
                    folders.append(f"{name}/")
                elif not entry.is_file(follow_symlinks=False):
                    raise ExportError(f"{folder} holds links or special files: only plain files are read")
                else:
                    yield name, entry.stat(follow_symlinks=False).st_size
                count += 1
                if count > MOST_ENTRIES:
                    raise ExportError(f"{folder} holds more than {MOST_ENTRIES} files and folders: no bundle does")


def _check_size(files: int, size: int, most: int = MAX_BYTES) -> None:
    if files > MAX_FILES or size > most:
        raise ExportError(f"it holds {files} files of {size >> 20} MiB: at most {MAX_FILES} and {most >> 20} are read")
