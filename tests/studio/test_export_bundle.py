"""The exported zip or folder: whole, the same every time, and honest about where it comes from."""

import functools
import hashlib
import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import mujoco
import pytest

from morph_core import durable
from morph_core.history import History
from morph_core.protocol import (
    Acknowledged,
    DesignSpaceChanged,
    Evaluation,
    Progress,
    SetAlpha,
    SetBound,
    StateChanged,
)
from morph_core.run_folder import EventLog, RunFolder
from studio.export.archive import zipped
from studio.export.bundle import Bundle, build_bundle
from studio.export.errors import ExportError
from studio.export.place import check_place, write_bundle
from studio.new_run import StartRun, prepare_run
from tests.verifying import verify

FAST = ("mjcf", "urdf")
"""Formats for what is no matter of prints, which take longest."""
PHIS = {1: [3.0, 2.9, 2.8, 2.7, 2.6], 2: [2.5, 2.0, 1.5, 1.0, 0.05], 3: [2.2, 1.0, 1.6, 2.4, 1.4]}


def write_run(runs: Path) -> History:
    """Return a run of three iterations, the second evaluated best; after it link_1 was bounded."""
    folder = prepare_run(runs, StartRun(task="reacher", seed=7, settings={"alpha": 2.0}))
    log = EventLog(folder)
    log.append(StateChanged(status="running", iteration=0))
    log.append(Acknowledged(id=1, iteration=0, accepted=True, command=SetAlpha(3.0)))
    log.append(Acknowledged(id=2, iteration=0, accepted=False, command=SetAlpha(-3.0), message="no"))
    for iteration, phi in PHIS.items():
        log.append(Progress(iteration=iteration, env_steps=9, phi=phi, episode_return=0, success=0, policy_std=0.5))
        success = 0.9 if iteration == 2 else 0.1
        log.append(
            Evaluation(
                iteration=iteration, env_steps=9, phi=phi, sampled_success=success, sampled_return=0,
                deterministic_success=0, deterministic_return=0,
            )
        )  # fmt: skip
        if iteration == 2:
            space = History(folder).design_space.with_bound("link_1", 1.0, 2.3)
            log.append(DesignSpaceChanged(iteration=2, parameters=list(space.parameters)))
            log.append(Acknowledged(id=3, iteration=2, accepted=True, command=SetBound("link_1", 1.0, 2.3)))
    log.close()
    return History(folder)


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> History:
    """The run of which most is exported; nobody changes it."""
    return write_run(tmp_path_factory.mktemp("runs"))


@pytest.fixture
def changeable(tmp_path: Path) -> History:
    """A run of the same kind that a test may change."""
    return write_run(tmp_path / "runs")


@pytest.fixture(scope="module")
def built(history: History) -> Callable[..., Bundle]:
    """Export a design of that run, or give what was exported when it was last asked for."""
    return functools.cache(lambda which, formats=FAST: build_bundle(history, which, formats))


def unpack(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_a_design_changed_by_hand_is_exported_under_a_name_that_says_so(history: History) -> None:
    phi = [2.0, 1.0, 1.5, 2.5, 4.5]  # link_1 outside the bounds that are in force, inside the task's own box
    bundle = build_bundle(history, "3", ["mjcf", "urdf"], phi)
    files = unpack(bundle.content)
    assert bundle.name == f"{history.folder.id}-000003-changed-by-hand.zip"
    design = json.loads(files["design.json"])
    assert (design["design"], design["iteration"]) == ("3, changed by hand", 3)
    assert [p["value"] for p in design["parameters"]] == phi
    assert all(check.passed for check in verify(files))
    for wrong, said in (([9.0] * 5, "outside"), ([1.0], "5 are needed"), ([float("nan")] * 5, "outside")):
        with pytest.raises(ExportError, match=said):
            build_bundle(history, "3", None, wrong)


def test_the_zip_holds_robot_scene_design_and_provenance(history: History, built: Callable[..., Bundle]) -> None:
    bundle = built("best", None)
    files = unpack(bundle.content)
    assert bundle.name == f"{history.folder.id}-best-000002.zip"
    parts = {"base", *(f"link_{i}" for i in range(1, 6))}
    plates = {path for path in files if path.startswith("plates/")}
    assert {"plates/plate_1.3mf", "plates/plate_1.svg", "plates/pieces.csv", "plates/joints.csv"} <= plates
    assert set(files) - plates == {
        "README.txt", "LICENSE", "BOM.csv", "report.html", "design.json", "provenance.json", "control.json",
        "robot.urdf", "robot.xml", "robot.mjz", "scene.xml", "assembly.glb",
        *(f"parts/{part}.stl" for part in parts), *(f"3mf/{part}.3mf" for part in parts),
    }  # fmt: skip
    assert all(check.passed for check in verify(files))
    scene = mujoco.MjModel.from_xml_string(files["scene.xml"].decode(), files)
    geoms = [scene.geom(i).name for i in range(scene.ngeom)]
    assert any(name.startswith("goal") for name in geoms)
    assert any(name.startswith("wall") for name in geoms)


@pytest.mark.parametrize(("which", "iteration"), [("best", 2), ("latest", 3), ("1", 1)])
def test_the_chosen_design_is_the_one_written(built: Callable[..., Bundle], which: str, iteration: int) -> None:
    files = unpack(built(which).content)
    design = json.loads(files["design.json"])
    assert design["iteration"] == iteration
    assert [p["value"] for p in design["parameters"]] == PHIS[iteration]
    model = mujoco.MjModel.from_xml_string(files["robot.xml"].decode(), files)
    assert [2 * model.geom(f"link_{i + 1}").size[1] for i in range(5)] == pytest.approx(PHIS[iteration], rel=1e-15)


def test_iteration_0_is_the_initial_design(built: Callable[..., Bundle]) -> None:
    design = json.loads(unpack(built("0").content)["design.json"])
    assert [p["value"] for p in design["parameters"]] == [3.0] * 5


def test_bounds_and_commands_are_those_in_force_for_the_design(built: Callable[..., Bundle]) -> None:
    before, after = (unpack(built(which).content) for which in ("best", "latest"))
    bounds = [json.loads(files["design.json"])["parameters"][0] for files in (before, after)]
    assert [(p["lo"], p["hi"]) for p in bounds] == [(0.05, 5.0), (1.0, 2.3)]
    commands = [json.loads(files["provenance.json"])["commands"] for files in (before, after)]
    assert [[c["command"]["type"] for c in each] for each in commands] == [["set_alpha"], ["set_alpha", "set_bound"]]


def test_provenance_says_where_it_comes_from_and_digests_every_other_file(
    history: History, built: Callable[..., Bundle]
) -> None:
    files = unpack(built("latest").content)
    provenance = json.loads(files.pop("provenance.json"))
    assert provenance["sha256"] == {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    assert (provenance["run"], provenance["iteration"], provenance["seed"]) == (history.folder.id, 3, 7)
    assert provenance["config"] == history.record.config
    assert provenance["config"]["alpha"] == 2.0
    assert provenance["versions"] == history.record.versions
    assert provenance["git_dirty"] == history.record.git_dirty
    assert all("agrees" in check for check in provenance["checks"])
    assert len(provenance["checks"]) > 10


def test_two_exports_differ_in_nothing_but_the_time(history: History, built: Callable[..., Bundle]) -> None:
    first, second = (unpack(bundle.content) for bundle in (built("best", None), build_bundle(history, "best")))
    times = [json.loads(files.pop("provenance.json")).pop("exported") for files in (first, second)]
    assert all(time.endswith("Z") for time in times)
    assert first == second


def test_one_format_alone_leaves_the_other_out(built: Callable[..., Bundle]) -> None:
    assert "robot.xml" not in unpack(built("best", ("urdf",)).content)
    assert "robot.urdf" not in unpack(built("1", ("mjcf",)).content)


@pytest.mark.parametrize("formats", [["dwg"], ["mjcf", "3mff"], [""], []])
def test_other_formats_are_refused_with_the_list(history: History, formats: list[str]) -> None:
    with pytest.raises(ExportError, match="choose from: mjcf, urdf, stl, 3mf, glb, step"):
        build_bundle(history, "best", formats)


def test_a_printer_that_is_asked_for_must_hold_every_part(history: History) -> None:
    with pytest.raises(
        ExportError, match=r"link_1 is \d+ x 119 x 119 mm .* printers that are large enough: none of the t"
    ):
        build_bundle(history, "best", ["3mf"], printer="prusa_xl")
    with pytest.raises(ExportError, match=r"base is \d+ x \d+ x \d+ mm .* large enough: bambu_x1c.*, prusa_xl"):
        build_bundle(history, "best", ["3mf"], [0.3] * 5, printer="prusa_mini")
    files = build_bundle(history, "best", ["3mf"], [0.3] * 5, printer="300x300x200").files
    assert json.loads(files["provenance.json"])["printer"] == "300x300x200"
    assert b"printer 300 x 300 x 200 mm" in files["plates/plate_1.svg"]
    assert b"dowel pin 12 x 60 mm" in files["BOM.csv"]


@pytest.mark.parametrize("which", ["4", "newest", "../1", "-1", ""])
def test_a_design_that_is_not_there_is_refused(history: History, which: str) -> None:
    with pytest.raises(ExportError, match="choose best, latest"):
        build_bundle(history, which, FAST)


@pytest.mark.parametrize("phi", [[1e9, 1, 1, 1, 1], [0.0, 1, 1, 1, 1]])
def test_a_recorded_design_outside_the_task_is_refused(changeable: History, phi: list[float]) -> None:
    log = EventLog(changeable.folder)
    log.append(Progress(iteration=4, env_steps=9, phi=phi, episode_return=0, success=0, policy_std=0.5))
    changeable.poll()
    with pytest.raises(ExportError, match=r"the design (has|is)|of the design"):
        build_bundle(changeable, "latest", FAST)


def test_a_run_of_an_unknown_task_is_refused(changeable: History) -> None:
    record = msgspec.structs.replace(changeable.record, task="juggling")
    (changeable.folder.path / "run.json").write_bytes(msgspec.json.encode(record))
    with pytest.raises(ExportError, match=r"choose from: .*reacher"):
        build_bundle(History(changeable.folder), "best")


def test_a_hostile_run_name_does_not_reach_a_file_name(changeable: History) -> None:
    hostile = changeable.folder.path.with_name("..\\ a\n$(touch x)" + "é" * 60)
    changeable.folder.path.rename(hostile)
    bundle = build_bundle(History(RunFolder(hostile)), "best", FAST)
    name, content = bundle.name, bundle.content
    assert name.isascii()
    assert not set(name) & set("/\\\n $()")
    assert not name.startswith(".")
    assert len(name) < 130
    assert json.loads(unpack(content)["provenance.json"])["run"] == hostile.name


def test_a_zip_is_written_to_the_path(built: Callable[..., Bundle], tmp_path: Path) -> None:
    for which in ("1", "best"):  # the second takes the place of the first
        out = write_bundle(built(which), tmp_path / "new folder" / "arm.zip")
    assert all(check.passed for check in verify(unpack(out.read_bytes())))
    assert [p.name for p in out.parent.iterdir()] == ["arm.zip"]


def test_a_folder_is_written_and_an_earlier_export_replaced(built: Callable[..., Bundle], tmp_path: Path) -> None:
    out = tmp_path / "arm"
    write_bundle(built("1", ("mjcf",)), out)
    write_bundle(built("best", ("urdf",)), out)
    assert (out / "robot.urdf").exists()
    assert not (out / "robot.xml").exists()
    assert json.loads((out / "design.json").read_text())["iteration"] == 2
    assert [p.name for p in tmp_path.iterdir()] == ["arm"]


def test_a_folder_with_anything_else_in_it_is_left_alone(built: Callable[..., Bundle], tmp_path: Path) -> None:
    foreign = tmp_path / "thesis"
    foreign.mkdir()
    (foreign / "chapter.tex").write_text("years of work")
    with pytest.raises(ExportError, match="holds other files"):
        write_bundle(built("best"), foreign)
    earlier = write_bundle(built("best"), tmp_path / "arm")
    (earlier / "notes.txt").write_text("mine")
    with pytest.raises(ExportError, match=r"notes\.txt"):
        write_bundle(built("1"), earlier)
    assert (foreign / "chapter.tex").read_text() == "years of work"
    assert json.loads((earlier / "design.json").read_text())["iteration"] == 2


def test_a_file_where_the_folder_should_be_is_left_alone(built: Callable[..., Bundle], tmp_path: Path) -> None:
    (tmp_path / "arm").write_text("mine")
    with pytest.raises(ExportError, match="is no folder"):
        write_bundle(built("best"), tmp_path / "arm")
    with pytest.raises(ExportError, match="can't write"):
        write_bundle(built("best"), tmp_path / "arm" / "b.zip")
    assert (tmp_path / "arm").read_text() == "mine"


@pytest.mark.parametrize("out", ["", ".", "/", "..", "sub/..", "photos.zip", "pipe.zip", "notes.zip"])
def test_what_is_no_export_is_never_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: str) -> None:
    place = tmp_path / "here"
    (place / "sub").mkdir(parents=True)
    monkeypatch.chdir(place)
    (place / "photos.zip").write_bytes(zipped({"a.jpg": b"years of photos"}))
    (place / "notes.zip").write_text("no zip at all")
    os.mkfifo(place / "pipe.zip")
    before = {path: path.lstat().st_ino for path in tmp_path.rglob("*")}
    for write in (check_place, lambda path: write_bundle(Bundle("arm.zip", {}, [], b""), path)):
        with pytest.raises(ExportError, match=r"no name of its own|no earlier export"):
            write(Path(out))
    assert {path: path.lstat().st_ino for path in tmp_path.rglob("*")} == before
    with pytest.raises(IsADirectoryError):
        durable.write_file(Path(), b"")


@pytest.mark.parametrize("name", ["arm.zip", "arm"])
def test_a_full_disk_leaves_the_earlier_export_and_no_debris(
    built: Callable[..., Bundle], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    out = write_bundle(built("1"), tmp_path / name)
    before = out.read_bytes() if out.is_file() else (out / "design.json").read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ExportError, match="No space left"):
        write_bundle(built("best"), out)
    assert (out.read_bytes() if out.is_file() else (out / "design.json").read_bytes()) == before
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_a_replacement_that_fails_half_way_puts_the_earlier_export_back(
    built: Callable[..., Bundle], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = write_bundle(built("1"), tmp_path / "arm")
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.suffix == ".draft":
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(ExportError, match="Input/output error"):
        write_bundle(built("best"), out)
    assert json.loads((out / "design.json").read_text())["iteration"] == 1
