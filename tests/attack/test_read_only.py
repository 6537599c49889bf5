"""Folders that can be read and not written to: a sentence by every way, and no traceback."""

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from morph_core.history import History
from morph_core.run_folder import RunFolder
from studio.cli import run
from studio.inquest import start_child
from studio.settings import Settings
from tests.studio.conftest import NAME, Served, design_of, make_run, serving


@pytest.fixture(scope="module")
def read_only(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder of runs with one run in it, on a disk that nobody may write to."""
    place = tmp_path_factory.mktemp("disk")
    if os.geteuid() == 0:  # to whom a mode means nothing
        mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", place], capture_output=True)
        if mounted.returncode:
            pytest.skip("this user is root and may mount nothing")
    try:
        history = History(make_run(place))
        (place / "design.json").write_bytes(msgspec.json.encode(design_of(history, [2.7] * 5)))
        if os.geteuid() == 0:
            subprocess.run(["mount", "-o", "remount,ro", place], check=True)
        else:
            subprocess.run(["chmod", "-R", "a-w", place], check=True)
        yield place
    finally:
        if os.geteuid() == 0:
            subprocess.run(["umount", place], check=True)
        else:
            subprocess.run(["chmod", "-R", "u+w", place], check=True)


@pytest.mark.parametrize(
    "words",
    [
        f"train --resume {NAME}",
        "train reacher --iterations 1",
        f"train --branch {NAME}",
        f"import design.json --into {NAME}",
        "import design.json --start",
        f"export {NAME} --formats mjcf",
        "study reacher --methods morph --seeds 0 --env-steps 1e4 --out new",
        f"study --report {NAME}",
    ],
)
def test_a_command_says_in_one_line_why_it_can_not_be(
    read_only: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], words: str
) -> None:
    monkeypatch.chdir(read_only)
    monkeypatch.setenv("MORPH_RUNS", ".")
    assert run(words.split()) in (1, 2)
    said = capfd.readouterr().err
    assert "Traceback" not in said
    assert said.splitlines()[-1].startswith("morph-studio: ")
    assert len(said.splitlines()) <= 2, said


@pytest.mark.parametrize("words", ["runs", f"log {NAME}", "import design.json"])
def test_what_only_reads_works(
    read_only: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], words: str
) -> None:
    monkeypatch.chdir(read_only)
    assert run([*words.split(), "--runs", "."]) == 0
    assert capfd.readouterr().err == ""


@pytest.fixture(scope="module")
def shown(read_only: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    settings = Settings(port=0, runs=read_only, token="t" * 24, hosts=(), state=tmp_path_factory.mktemp("state"))
    with serving(settings) as served:
        served.client.headers["Authorization"] = f"Bearer {settings.token}"
        yield served


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", f"/api/runs/{NAME}/resume", {}),
        ("POST", "/api/runs", {"task": "reacher"}),
        ("POST", "/api/runs", {"branch": {"run": NAME}}),
        ("PATCH", f"/api/runs/{NAME}/marks", {"starred": True}),
        ("DELETE", f"/api/runs/{NAME}", None),
    ],
)
def test_the_page_is_told_in_a_sentence(shown: Served, method: str, path: str, body: dict[str, object] | None) -> None:
    answer = shown.client.request(method, path, json=body)
    assert answer.status_code in (422, 503), answer.text
    assert "read-only" in answer.json()["detail"].lower() or "permission" in answer.json()["detail"].lower()
    assert shown.client.get(f"/api/runs/{NAME}").json()["status"] == "stopped", "as it was"


def test_no_trainer_is_started_where_it_could_write_nothing(read_only: Path) -> None:
    with pytest.raises(PermissionError, match=f"{NAME} is read-only"):
        start_child(RunFolder(read_only / NAME), lambda: pytest.fail("it was started"))
