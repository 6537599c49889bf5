"""A full disk pauses a run wherever it is met, and damaged checkpoints are named before anything is begun anew."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from morph_core import train
from morph_core.history import History
from morph_core.protocol import Progress, StateChanged
from morph_core.run_folder import RunFolder, RunFolderError
from morph_core.train import Trainer
from studio.cli.arguments import UsageError
from studio.cli.train import main
from tests.core.conftest import make_run

pytestmark = pytest.mark.usefixtures("short_episodes")

WRITERS = (
    (Path, "mkdir"), (Path, "open"), (Path, "rename"), (Path, "write_bytes"), (Path, "write_text"), (os, "pwrite")
)  # fmt: skip
"""What puts anything onto a disk; what is only handed to another library as bytes never does."""


class FullDisk:
    """A disk that is full from the `at`-th writing on, for three attempts."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: RunFolder, at: int) -> None:
        self.folder, self.calls, self.at, self.refused = folder.path, 0, at, 0
        for owner, name in WRITERS:
            monkeypatch.setattr(owner, name, self.failing(getattr(owner, name)))

    def failing(self, write: Callable[..., Any]) -> Callable[..., Any]:
        def attempt(*words: Any, **options: Any) -> Any:
            if isinstance(words[0], Path) and not words[0].is_relative_to(self.folder):
                return write(*words, **options)
            self.calls += 1
            if self.calls > self.at and self.refused < 3:
                self.refused += 1
                raise OSError(errno.ENOSPC, "No space left on device")
            return write(*words, **options)

        return attempt


def trained(folder: RunFolder, **words: Any) -> History:
    Trainer(folder, **words).run()
    return History(folder)


def learnt(history: History) -> list[tuple[list[float], float]]:
    return [(e.phi, e.episode_return) for e in history.events if isinstance(e, Progress)]


@pytest.mark.parametrize("every", [17, pytest.param(3, marks=pytest.mark.slow)])
def test_a_full_disk_pauses_the_run_wherever_it_is_met(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int
) -> None:
    monkeypatch.setattr(train, "RETRY_SECONDS", 0.0)
    folder = make_run(tmp_path, "whole", iterations=2)
    with monkeypatch.context() as patch:
        counted = FullDisk(patch, folder, at=10**9)
        whole = trained(folder)
    assert counted.calls > 20
    for at in range(0, counted.calls, every):  # three attempts fail in a row
        folder = make_run(tmp_path, f"full-{at}", iterations=2)
        with monkeypatch.context() as patch:
            disk = FullDisk(patch, folder, at)
            history = trained(folder)
        assert disk.refused == min(3, disk.calls - at)  # the last heartbeat is not tried again
        assert history.status == "finished"
        assert learnt(history) == learnt(whole)
        assert [e.seq for e in history.events] == list(range(1, len(history.events) + 1))
        weights = [h.folder.checkpoint(2) / "weights.safetensors" for h in (history, whole)]
        assert weights[0].read_bytes() == weights[1].read_bytes()
        assert not list(history.folder.path.rglob(".*"))


def flip(path: Path, at: int) -> None:
    """Flip the lowest bit of one byte: a digit stays a digit, and a weight a number."""
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "no weights": lambda path: (path / "weights.safetensors").unlink(),
    "a pickle": lambda path: (path / "weights.safetensors").write_bytes(b"\x80\x04K\x01."),
    "nothing in it": lambda path: (path / "weights.safetensors").write_bytes(b""),
    "cut": lambda path: os.truncate(path / "weights.safetensors", 500),
    "a lying header": lambda path: (path / "weights.safetensors").write_bytes(b"\xff" * 64),
    "another's state": lambda path: (path / "state.json").write_text("{}"),
    "a flipped bit": lambda path: flip(path / "weights.safetensors", -30),
    "a changed digit": lambda path: flip(path / "state.json", (path / "state.json").read_bytes().index(b'"rng"') + 60),
    "deep nonsense": lambda path: (path / "state.json").write_text("[" * 100_000),
    "a link": lambda path: (
        path.rename(path.with_name("x" + path.name)),
        path.symlink_to(path.with_name("x" + path.name)),
    ),
}


@pytest.fixture(scope="module")
def learnt_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of four iterations with checkpoints of the second and the fourth."""
    folder = make_run(tmp_path_factory.mktemp("runs"), iterations=4)
    trained(folder)
    return folder.path


def copied(source: Path, tmp_path: Path) -> RunFolder:
    return RunFolder(Path(shutil.copytree(source, tmp_path / source.name)))


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_named_and_so_is_the_older_one(learnt_once: Path, tmp_path: Path, damage: str) -> None:
    folder = copied(learnt_once, tmp_path)
    DAMAGES[damage](folder.checkpoint(4))
    history = trained(folder)
    said = [e.message for e in history.events if isinstance(e, StateChanged) and e.status == "starting"][-1]
    assert "from the checkpoint of iteration 2" in said
    assert "checkpoint 4 of run can't be read: " in said
    assert history.status == "finished"


@pytest.mark.parametrize("damage", [*DAMAGES, "removed"])
def test_beginning_anew_needs_a_yes(learnt_once: Path, tmp_path: Path, damage: str) -> None:
    folder = copied(learnt_once, tmp_path)
    for iteration in (2, 4):
        if damage == "removed":
            shutil.rmtree(folder.checkpoint(iteration))
        else:
            DAMAGES[damage](folder.checkpoint(iteration))
    with pytest.raises(RunFolderError, match="--from-start"):
        trained(folder)
    assert History(folder).iteration == 4  # nothing was given up
    history = trained(folder, from_start=True)
    assert [p.iteration for p in history.progress] == [1, 2, 3, 4]
    assert len(learnt(history)) == 8


def test_no_run_begins_anew_while_a_checkpoint_can_be_read(learnt_once: Path, tmp_path: Path) -> None:
    folder = copied(learnt_once, tmp_path)
    with pytest.raises(RunFolderError, match="checkpoint of iteration 4 can be read"):
        trained(folder, from_start=True)
    assert History(folder).iteration == 4


def test_a_new_run_does_not_begin_from_the_start_of_another() -> None:
    with pytest.raises(UsageError, match="--from-start goes with --resume"):
        main(["reacher", "--from-start"])
