"""A zip from elsewhere takes no more memory than its design.json, and however many are sent, one is read at a time."""

import io
import threading
import time
import tracemalloc
import zipfile
from pathlib import Path

import pytest

from studio.export import design_file
from studio.export.archive import read_files, unzipped
from studio.export.design_file import FILE, LARGEST, load_design, read_design
from studio.export.errors import ExportError
from tests.attack.test_folders import put, within


def archive(method: int, entries: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as written:
        for name, content in entries.items():
            written.writestr(name, content)
    return buffer.getvalue()


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_what_may_take_any_amount_of_memory_is_not_unpacked(method: int) -> None:
    with pytest.raises(ExportError, match="any amount of memory: deflate it"):
        read_design(archive(method, {FILE: b"{}"}))


def test_a_design_that_is_larger_than_any_is_not_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    bomb = archive(zipfile.ZIP_DEFLATED, {FILE: bytes(LARGEST + 1)})
    monkeypatch.setattr(zipfile.ZipFile, "open", lambda *_: pytest.fail("unpacked"))
    with pytest.raises(ExportError):
        read_design(bomb)


def test_nothing_but_the_design_is_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    unpacked, sent = list[str](), archive(zipfile.ZIP_DEFLATED, {FILE: b"{}", "stl/part.stl": bytes(1 << 24)})
    monkeypatch.setattr(zipfile.ZipFile, "open", lambda _, entry: unpacked.append(entry.filename) or io.BytesIO(b"{}"))
    with pytest.raises(ExportError):
        read_design(sent)
    assert unpacked == [FILE]


def memory_to_refuse(sent: bytes, why: str) -> int:
    """Return the bytes that it takes to refuse a design."""
    tracemalloc.start()
    try:
        with pytest.raises(ExportError, match=why):
            read_design(sent)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_a_file_that_holds_more_than_it_says_is_not_unpacked_beyond_that() -> None:
    size = 64 << 20
    lying = archive(zipfile.ZIP_DEFLATED, {FILE: bytes(size)}).replace(size.to_bytes(4, "little"), b"\x0a\0\0\0")
    assert memory_to_refuse(lying, "no zip that can be read") < 4 << 20


def test_a_path_of_any_length_takes_no_memory() -> None:
    deep = archive(zipfile.ZIP_STORED, {FILE: b"{}", "a/" * 30_000 + "b": b""})
    assert memory_to_refuse(deep, "path has 60,001 characters") < 4 << 20


def test_a_table_of_contents_without_end_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zipfile, "ZipFile", lambda *_: pytest.fail("opened"))
    with pytest.raises(ExportError, match="more than 20000 files"):
        unzipped(b"PK\x01\x02" * 20_001)


@pytest.mark.parametrize("kind", ["pipe", "link to zeros", "socket", "huge"])
def test_a_design_in_a_folder_from_elsewhere_is_a_plain_file_of_sensible_size(tmp_path: Path, kind: str) -> None:
    put(tmp_path / "bundle" / FILE, kind, tmp_path)
    for read in (load_design, read_files):
        with within(5), pytest.raises(ExportError, match=r"plain|are read|is read"):
            read(tmp_path / "bundle")


def test_a_folder_that_is_deeper_than_python_calls_is_read(tmp_path: Path) -> None:
    folders = [tmp_path / "bundle"]
    for _ in range(1200):
        folders.append(folders[-1] / "d")
    try:
        for folder in folders:
            folder.mkdir()
        (folders[-1] / "robot.xml").write_text("<mujoco/>")
        assert list(read_files(folders[0]).values()) == [b"<mujoco/>"]
    finally:
        (folders[-1] / "robot.xml").unlink(missing_ok=True)
        for folder in reversed(folders):
            folder.rmdir()


def test_one_zip_is_unpacked_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    inside, most = [0], [0]

    def unzipped(*_: object, **__: object) -> dict[str, bytes]:
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        time.sleep(0.02)
        inside[0] -= 1
        return {FILE: b"{}"}

    def read() -> None:
        with pytest.raises(ExportError):
            read_design(b"PK")

    monkeypatch.setattr(design_file, "unzipped", unzipped)
    readers = [threading.Thread(target=read) for _ in range(6)]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join()
    assert most == [1]
