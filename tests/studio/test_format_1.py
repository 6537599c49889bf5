"""A bundle that was exported while settings were one flat list is still one robot, and a run can begin with it."""

import zipfile
from pathlib import Path

import msgspec
import pytest

from morph_core.protocol import Parent
from studio.cli import run
from studio.export.design_file import load_design, read_design, starting_from
from studio.export.errors import ExportError
from studio.export.proof import prove
from studio.new_run import StartRun

BUNDLE = Path(__file__).parents[1] / "data" / "format_1" / "reacher.zip"


def test_of_an_old_bundle_it_is_said_that_its_arm_jumps_and_that_the_rest_agrees() -> None:
    with zipfile.ZipFile(BUNDLE) as archive:
        checks = prove({name: archive.read(name) for name in archive.namelist()}, episodes=8)
    failed = [check.name for check in checks if not check.passed]
    assert any("stands for 1 s" in name for name in failed)  # its foot collided with the first link
    drawn_anew = ("parts", "as it is drawn (share of its volume)", "what the program is told")
    others = [name for name in failed if name.split(": ")[-1] not in drawn_anew]
    assert not [name for name in others if name.startswith(("design.json", "parts/", "policy", "robot.urdf"))]
    assert any(check.passed and check.name.startswith("policy") for check in checks)


def test_an_old_bundle_is_verified_to_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["verify", str(BUNDLE)]) == 1
    assert "stands for 1 s" in " ".join(capsys.readouterr().out.split())


def test_a_run_can_begin_with_an_old_design() -> None:
    design = load_design(BUNDLE)
    wish = starting_from(design, StartRun())
    assert [p.initial for p in wish.parameters or []] == [p.value for p in design.parameters]
    assert (wish.task, wish.parent) == (design.task, Parent(design.run, design.iteration))


def test_a_design_of_a_newer_format_is_refused_with_what_reads_it() -> None:
    fields = msgspec.to_builtins(load_design(BUNDLE)) | {"format": 2, "parameters": "in another form"}
    newer = msgspec.json.encode(fields)
    with pytest.raises(ExportError, match="has format 2; this version knows 1: read it with a newer morph-studio"):
        read_design(newer)
