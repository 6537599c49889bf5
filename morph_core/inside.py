"""What lies inside a run folder, opened without trust: a folder from elsewhere may hold links, pipes or endless files.

The run folder itself may be reached by links; what is inside of it may not. A path inside is written with slashes.
"""

import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

_ALWAYS = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
"""A link is not followed, and a pipe is not waited for."""
_LINKED = (errno.ELOOP, errno.ENOTDIR, errno.EMLINK)
"""What systems answer where a link stands in for a file or a folder."""
_CHUNK = 1 << 20
LONGEST_LINE = 4 << 20
"""Bytes of the longest line that is read; an event has a few thousand."""


class NotPlainError(OSError):
    """Something in a run folder that is no plain file or folder, or is larger than is read; says which."""

    def __init__(self, sentence: str) -> None:
        """Take the sentence that is shown."""
        super().__init__(errno.EINVAL, sentence)

    def __str__(self) -> str:
        """Return the sentence alone."""
        return str(self.strerror)


def open_plain(root: Path, name: str, flags: int = os.O_RDONLY) -> int:
    """Return a descriptor of the plain file `name` inside `root`. Raise FileNotFoundError, NotPlainError or OSError.

    A file that is written to must have no second name elsewhere (a hard link).
    """
    *folders, last = PurePosixPath(name).parts
    at = _open_folder(root, folders)
    try:
        descriptor = os.open(last, flags | _ALWAYS, 0o666, dir_fd=at)
    except OSError as error:
        if error.errno in (*_LINKED, errno.ENXIO, errno.EISDIR):
            raise NotPlainError(f"{name} is no plain file, but a link, a folder, a pipe or a device") from None
        raise
    finally:
        os.close(at)
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            raise NotPlainError(f"{name} is no plain file, but a folder, a pipe or a device")
        if flags & (os.O_WRONLY | os.O_RDWR) and found.st_nlink > 1:
            raise NotPlainError(f"{name} has a second name (a hard link), under which it would be changed as well")
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def read(root: Path, name: str, most: int, offset: int = 0) -> bytes:
    """Return the plain file `name` inside `root` from `offset` on; NotPlainError if that is more than `most` bytes."""
    descriptor = open_plain(root, name)
    try:
        size = os.fstat(descriptor).st_size - offset
        if size > most:
            raise NotPlainError(f"{name} has {size:,} bytes, and at most {most:,} are read")
        parts, left = [], most
        while left and (part := os.pread(descriptor, min(left, _CHUNK), offset + most - left)):
            parts.append(part)
            left -= len(part)
        return b"".join(parts)
    finally:
        os.close(descriptor)


def whole_lines(root: Path, name: str, offset: int, most: int) -> Iterator[bytes]:
    """Yield the whole lines of a plain file inside `root` from `offset` on, many in one piece; a torn last one is left.

    Raise NotPlainError where the file has more than `most` bytes, or a line is longer than `LONGEST_LINE`.
    """
    descriptor = open_plain(root, name)
    try:
        if (size := os.fstat(descriptor).st_size) > most:
            raise NotPlainError(f"{name} has {size:,} bytes, and at most {most:,} are read")
        rest = b""
        while part := os.pread(descriptor, LONGEST_LINE, offset):
            offset += len(part)
            text = rest + part
            end = text.rfind(b"\n") + 1
            rest = text[end:]
            if len(rest) > LONGEST_LINE:
                raise NotPlainError(f"{name} has a line of more than {LONGEST_LINE:,} bytes")
            yield text[:end]
    finally:
        os.close(descriptor)


def names(root: Path, folder: str = "") -> list[str]:
    """Return the names in a folder inside `root`, sorted; none where there is no such folder.

    Raise NotPlainError where a link or a file stands in its place.
    """
    try:
        descriptor = _open_folder(root, PurePosixPath(folder).parts)
    except FileNotFoundError:
        return []
    try:
        return sorted(os.listdir(descriptor))  # noqa: PTH208 - the folder that was opened, not what its name leads to by now
    finally:
        os.close(descriptor)


def folder(root: Path, name: str) -> Path:
    """Return the path of a folder inside `root`, made if there is none; NotPlainError where it is a link or a file."""
    path = root / name
    path.mkdir(exist_ok=True)
    os.close(_open_folder(root, PurePosixPath(name).parts))
    return path


def touch(root: Path, name: str) -> None:
    """Make sure that there is a plain file of this name inside `root`."""
    os.close(open_plain(root, name, os.O_WRONLY | os.O_CREAT))


def write_at(descriptor: int, content: bytes, offset: int) -> None:
    """Write all of `content` at `offset` of a file; on OSError part of it may have been written."""
    view = memoryview(content)
    while view:
        written = os.pwrite(descriptor, view, offset)
        view, offset = view[written:], offset + written


def _open_folder(root: Path, folders: tuple[str, ...] | list[str]) -> int:
    at = os.open(root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    for name in folders:
        try:
            inner = os.open(name, os.O_RDONLY | os.O_DIRECTORY | _ALWAYS, dir_fd=at)
        except OSError as error:
            if error.errno in _LINKED:
                raise NotPlainError(f"{name} is no folder, but a link or a file") from None
            raise
        finally:
            os.close(at)
        at = inner
    return at
