"""A zip from elsewhere takes no more memory than its design.json, and however many are sent, one is read at a time."""

import io
import threading
import time
import zipfile

import pytest

from studio.export import design_file
from studio.export.design_file import FILE, LARGEST, read_design
from studio.export.errors import ExportError


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
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *_: pytest.fail("unpacked"))
    with pytest.raises(ExportError):
        read_design(bomb)


def test_nothing_but_the_design_is_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    unpacked: list[str] = []
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda _, entry: unpacked.append(entry.filename) or b"{}")
    with pytest.raises(ExportError):
        read_design(archive(zipfile.ZIP_DEFLATED, {FILE: b"{}", "stl/part.stl": bytes(1 << 24)}))
    assert unpacked == [FILE]


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
