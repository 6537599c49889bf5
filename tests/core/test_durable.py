"""Files and folders are there whole or not at all: whenever a process dies, the old one stands or the new one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from morph_core import durable
from morph_core.run_folder import CHECKPOINT

KILLED = """
import os, pathlib, shutil, sys
from morph_core import durable

target, left = pathlib.Path(sys.argv[1]), int(sys.argv[2])

def dying(action):
    def act(*words, **options):
        global left
        if left == 0:
            os._exit(9)
        left -= 1
        return action(*words, **options)
    return act

os.fsync, pathlib.Path.rename, shutil.rmtree = map(dying, (os.fsync, pathlib.Path.rename, shutil.rmtree))
if sys.argv[3] == "file":
    durable.write_file(target, b"new" * 100_000)
else:
    with durable.replaced_folder(target) as draft:
        for name in ("weights", "state"):
            (draft / name).write_text("new")
"""


def dies(target: Path, after: int, kind: str) -> bool:
    """Write anew in a process that dies after so many calls that matter; tell whether it died."""
    ended = subprocess.run([sys.executable, "-c", KILLED, str(target), str(after), kind], timeout=60)
    assert ended.returncode in (0, 9)
    return ended.returncode == 9


def hidden(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


def test_what_is_no_plain_file_is_never_replaced(tmp_path: Path) -> None:
    pipe, folder, link, loop = (tmp_path / name for name in ("pipe", "folder", "link", "loop"))
    os.mkfifo(pipe)
    folder.mkdir()
    for path in (pipe, folder):
        with pytest.raises(FileExistsError, match="no plain file"):
            durable.write_file(path, b"new")
    assert pipe.is_fifo()
    (tmp_path / "theirs").write_bytes(b"old")
    link.symlink_to(tmp_path / "theirs")
    durable.write_file(durable.where_written(link), b"named")
    assert link.is_symlink()
    assert (tmp_path / "theirs").read_bytes() == b"named"
    durable.write_file(link, b"in a folder that is not trusted")
    assert (tmp_path / "theirs").read_bytes() == b"named"
    loop.symlink_to(loop)
    durable.write_file(durable.where_written(loop), b"new")
    assert loop.read_bytes() == b"new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "link", "loop", "pipe", "theirs"]


def test_a_folder_is_the_old_or_the_new_one_whenever_its_writer_dies(tmp_path: Path) -> None:
    seen = []
    for after in range(30):
        parent = tmp_path / str(after)
        (parent / "000001").mkdir(parents=True)
        for name in ("weights", "state"):
            (parent / "000001" / name).write_text("old")
        died = dies(parent / "000001", after, "folder")
        durable.recover(parent, CHECKPOINT)
        assert hidden(parent) == []
        contents = [(parent / "000001" / name).read_text() for name in ("weights", "state")]
        assert contents in (["old"] * 2, ["new"] * 2)
        seen.append(contents[0])
        if not died:
            break
    assert seen == sorted(seen, reverse=True)
    assert {"old", "new"} == set(seen)
    assert len(seen) > 5


def test_a_file_is_the_old_or_the_new_one_whenever_its_writer_dies(tmp_path: Path) -> None:
    path, seen = tmp_path / "file", []
    for after in range(10):
        path.write_bytes(b"old")
        died = dies(path, after, "file")
        seen.append(path.read_bytes())
        if not died:
            break
    assert seen[:2] == [b"old"] * 2
    assert seen[-1] == b"new" * 100_000


@pytest.mark.parametrize("earlier", [True, False])
def test_a_disk_that_refuses_leaves_what_was_there_and_no_draft(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, earlier: bool
) -> None:
    def refuse(_: int) -> None:
        raise OSError(28, "No space left on device")

    path, folder = tmp_path / "file", tmp_path / "folder"
    if earlier:
        path.write_bytes(b"old")
        folder.mkdir()
        (folder / "old").touch()
    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OSError, match="No space"):
        durable.write_file(path, b"new")
    with pytest.raises(OSError, match="No space"), durable.replaced_folder(folder) as draft:
        (draft / "new").touch()
    assert sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")) == (
        ["file", "folder", "folder/old"] if earlier else []
    )


def test_a_folder_that_can_not_be_named_gives_the_earlier_one_its_name_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename = Path.rename

    def refuse(path: Path, target: Path) -> Path:
        if path.suffix == ".draft":
            raise OSError(5, "Input/output error")
        return rename(path, target)

    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "old").touch()
    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(OSError, match="Input/output"), durable.replaced_folder(tmp_path / "folder"):
        pass
    assert [p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")] == ["folder", "folder/old"]


def test_a_new_folder_never_replaces_another(tmp_path: Path) -> None:
    with durable.new_folder(tmp_path / "run") as draft:
        assert not (tmp_path / "run").exists()
        (draft / "first").touch()
    with pytest.raises(OSError, match="not empty"), durable.new_folder(tmp_path / "run") as draft:
        (draft / "second").touch()
    assert [p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")] == ["run", "run/first"]


def test_what_its_filler_raises_leaves_nothing(tmp_path: Path) -> None:
    for folder in (durable.new_folder, durable.replaced_folder):
        with pytest.raises(KeyboardInterrupt), folder(tmp_path / "run"):
            raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_the_latest_of_several_moved_aside_comes_back(tmp_path: Path) -> None:
    for age, name in ((100, ".000001.a.old"), (0, ".000001.b.old"), (200, ".000001.c.old"), (0, ".000002.old")):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{age} s ago").touch()
        os.utime(tmp_path / name, (10_000 - age, 10_000 - age))
    durable.recover(tmp_path, CHECKPOINT)
    assert sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.glob("*/*")) == [
        "000001/0 s ago", "000002/0 s ago",
    ]  # fmt: skip
    assert hidden(tmp_path) == []


@pytest.mark.parametrize("name", ["x" * 255, "ü" * 127, "a.b.c", "file.zip"])
def test_any_name_that_a_file_may_have_can_be_written(tmp_path: Path, name: str) -> None:
    for content in (b"one", b"two"):
        durable.write_file(tmp_path / name, content)
    assert (tmp_path / name).read_bytes() == b"two"
    (tmp_path / name).unlink()
    with durable.replaced_folder(tmp_path / name) as draft:
        (draft / "x").touch()
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_files_and_folders_are_as_readable_as_any_other(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    (tmp_path / "folder").mkdir()
    durable.write_file(tmp_path / "durable", b"")
    with durable.replaced_folder(tmp_path / "replaced"):
        pass
    mode = {p.name: p.stat().st_mode for p in tmp_path.iterdir()}
    assert mode["durable"] == mode["plain"]
    assert mode["replaced"] == mode["folder"]
