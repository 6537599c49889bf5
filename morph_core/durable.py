"""Files and folders that are there whole or not at all, whenever the machine or the process goes down."""

import contextlib
import errno
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

_ASIDE = re.compile(r"\.(?P<target>[^.]+)(\.[0-9a-f]{1,8})?\.(?P<kind>draft|old)")
"""Pattern of the names of drafts, and of what was moved aside; older versions gave them no random part."""
_NAME = 40
"""Number of characters of a target's name that its drafts carry, so that the longest name has drafts, too."""


def write_file(path: Path, content: bytes) -> None:
    """Write a file; an earlier one stays until the new one is whole. A link there is replaced, not followed.

    FileExistsError where anything else is there, such as a folder, a device or a pipe.
    """
    draft = _beside(path, "draft")
    with contextlib.suppress(FileNotFoundError):
        mode = path.lstat().st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISLNK(mode):
            raise FileExistsError(errno.EEXIST, "something is there that is no plain file", str(path))
    try:
        with draft.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def where_written(path: Path) -> Path:
    """Return where a file that a person has named is to be written: a link of theirs is followed."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


@contextlib.contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """Give a folder to be filled, which is then named `target`; OSError if one with content is there."""
    with _draft(target) as draft:
        yield draft
        _sync_all(draft)
        draft.rename(target)
        _sync(target.parent)


@contextlib.contextmanager
def replaced_folder(target: Path) -> Iterator[Path]:
    """Give a folder to be filled, which then takes the place of `target`; an earlier one stays until then.

    A process that dies between the two renamings leaves the earlier one aside: `recover` brings it back.
    """
    old = _beside(target, "old")
    with _draft(target) as draft:
        yield draft
        _sync_all(draft)
        if target.exists():
            target.rename(old)
        try:
            draft.rename(target)
        except BaseException:
            if old.exists():
                old.rename(target)
            raise
        _sync(target.parent)
    shutil.rmtree(old, ignore_errors=True)


def move(source: Path, target: Path) -> None:
    """Give a file or folder another place on the same file system; OSError, both unchanged, if `target` is there."""
    if target.exists():
        raise FileExistsError(f"{target} is there already")
    source.rename(target)
    _sync(target.parent)
    _sync(source.parent)


def remove_folder(target: Path) -> None:
    """Remove a folder; a process that dies meanwhile leaves no half of it, but a draft, which `recover` clears away."""
    aside = _beside(target, "draft")
    target.rename(aside)
    shutil.rmtree(aside, ignore_errors=True)


def recover(parent: Path, target: re.Pattern[str]) -> None:
    """Tidy up after a writer that died: what was moved aside comes back, drafts go; nothing else is touched.

    `target` is the pattern of the names, of at most 40 characters and without a dot, that are written in `parent`.
    """
    found = [(path, match) for path in parent.iterdir() if (match := _ASIDE.fullmatch(path.name))]
    for path, match in sorted(found, key=lambda entry: entry[0].lstat().st_mtime, reverse=True):
        if not target.fullmatch(match["target"]):
            continue
        original = parent / match["target"]
        if path.is_symlink() or not path.is_dir():
            path.unlink(missing_ok=True)
        elif match["kind"] == "old" and not original.exists():
            path.rename(original)
        else:
            shutil.rmtree(path, ignore_errors=True)  # follows no links


def _beside(target: Path, suffix: str) -> Path:
    """Return a hidden path that nobody else uses; its name says whose it is. OSError for a path without a name."""
    if target.name in ("", ".."):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target))
    return target.with_name(f".{target.name[:_NAME]}.{secrets.token_hex(4)}.{suffix}")


@contextlib.contextmanager
def _draft(target: Path) -> Iterator[Path]:
    draft = _beside(target, "draft")
    draft.mkdir(parents=True)
    try:
        yield draft
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise


def _sync_all(folder: Path) -> None:
    for path in (*folder.rglob("*"), folder):
        _sync(path)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
