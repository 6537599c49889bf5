"""What a notebook shows of runs, designs and studies, and that nothing written in a run folder becomes HTML there."""

import errno
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from html import unescape
from pathlib import Path
from types import SimpleNamespace

import msgspec
import nbformat
import pytest
from conftest import ROOT, append, in_mood, make_run, progress, stand_in
from hypothesis import example, given
from hypothesis import strategies as st
from lxml import html

from morph_core.catalogue import make_task
from morph_core.hypertext import table
from morph_core.protocol import StateChanged
from morph_core.run_folder import RunFolder
from studio import notebook
from studio.cli.arguments import UsageError
from studio.notebook import Run, open_run, open_study, train
from studio.show.sheet import Page
from studio.study.plan import StudyError
from tests.hands import write_hand_run
from tests.studies import Made, write_study

NOTEBOOK = ROOT / "examples" / "notebook.ipynb"
LARGEST = 1 << 20
PAGE = """<p title="a 'b'">&amp; <script>1 < 2</script>"""
WORDS = st.text("<>&\"'/=;#ab1é", min_size=1)


def cells(written: str) -> list[list[str]]:
    """Return the text of each row of all tables."""
    return [[cell.text_content() for cell in row] for row in html.fromstring(f"<div>{written}</div>").iter("tr")]


@pytest.fixture
def reacher(tmp_path: Path) -> Run:
    return open_run(make_run(tmp_path).path)


@example([["<b>", "&amp;"]], "<i>&lt;")
@given(st.lists(st.lists(WORDS, min_size=2, max_size=2), min_size=1), WORDS)
def test_a_table_shows_any_text_as_text(rows: list[list[str]], caption: str) -> None:
    written = table(rows[0], rows[1:], caption)
    assert cells(written) == rows
    assert html.fromstring(written).findtext("caption") == caption


def test_a_design_space_shows_units_bounds_and_locks() -> None:
    space = make_task("pen_press").design_space.with_lock("length_1", 0.2)
    shown = dict(zip(space.names, cells(space._repr_html_())[1:], strict=True))
    heading = cells(space._repr_html_())[0]
    assert heading == ["parameter", "unit", "from", "to", "initial", "locked at"]
    assert shown["length_1"] == ["length_1", "m", "0.02", "0.4", "0.2", "0.2"]
    assert [row[1] for row in shown.values()] == [p.unit for p in space.parameters]
    assert shown["length_2"][-1] == ""
    assert cells(space.without_lock("length_1")._repr_html_())[0] == heading[:-1]


def test_a_run_shows_how_far_it_is_and_its_designs(reacher: Run) -> None:
    rows = cells(reacher._repr_html_())
    assert ["state", "stopped: as asked"] in rows
    assert ["iterations", "3 of 100"] in rows
    assert ["best evaluation", "iteration 3: success 50% sampled, 25% mean action"] in rows
    assert rows[-5] == ["link_1", "m", "0.05", "5", "3", "2.7", "2.7"]


def test_a_run_that_goes_on_shows_what_has_happened_since(reacher: Run) -> None:
    append(reacher.history.folder, progress(4, phi=[1.25] * 5))
    assert reacher.design("latest").phi.tolist() == [1.25] * 5
    append(reacher.history.folder, progress(5, phi=[1.5] * 5))
    assert ["iterations", "5 of 100"] in cells(reacher._repr_html_())


def test_an_iteration_and_an_evaluation_show_what_they_measured(reacher: Run) -> None:
    shown = dict(cells(progress(7, divergence=0.0123456, alpha=0.1)._repr_html_()))
    assert shown["divergence D"] == "0.01235"
    assert "cosine of g_task, g_hw" not in shown
    (evaluation,) = reacher.history.evaluations
    assert ["success [% of episodes]", "50", "25"] in cells(evaluation._repr_html_())


def test_nothing_in_a_run_folder_becomes_html(tmp_path: Path) -> None:
    hostile = "<script>alert(1)</script>"
    folder = make_run(tmp_path)
    record = folder.record()
    renamed = [msgspec.structs.replace(p, name=f"{hostile}{i}", unit=hostile) for i, p in enumerate(record.parameters)]
    odd = msgspec.structs.replace(record, parameters=renamed, method=hostile)
    (folder.path / "run.json").write_bytes(msgspec.json.encode(odd))
    run = open_run(folder.path)
    written = run._repr_html_() + run.design()._repr_html_() + run.plot()._repr_svg_()
    assert "<script" not in written
    assert written.count("&lt;script") > 5


def test_curves_have_a_panel_for_each_measure_with_units_and_the_names_of_phi(tmp_path: Path) -> None:
    write_study(tmp_path, [Made("studio", "morph")], [0], iterations=10)
    (path,) = (path for path in tmp_path.iterdir() if path.is_dir())
    axes = open_run(path).plot().figure.axes
    assert [panel.get_ylabel() for panel in axes] == [
        "success [% of episodes]", "return [reward]", "cosine of g_task, g_hw", "mean squared distance", "φ [m]",
    ]  # fmt: skip
    assert {panel.get_xlabel() for panel in axes} == {"environment steps [thousand]"}
    assert axes[-1].get_legend_handles_labels()[1] == make_task("reacher").design_space.names


def test_curves_of_a_run_without_a_proxy_leave_its_panels_out(tmp_path: Path) -> None:
    run = open_run(write_hand_run(tmp_path, "pen_press", make_task("pen_press").design_space.initial.tolist()).path)
    labels = [panel.get_ylabel() for panel in run.plot().figure.axes]
    assert labels == ["success [% of episodes]", "return [reward]", "φ [rad]", "φ [m]"]


def test_curves_of_a_run_that_has_not_begun_are_empty(tmp_path: Path) -> None:
    assert "success [% of episodes]" in open_run(make_run(tmp_path, ended=None).path).plot()._repr_svg_()


def test_without_matplotlib_curves_name_the_extra(reacher: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r'pip install "morph-studio\[notebook\]"'):
        reacher.plot()


def test_nothing_that_draws_or_learns_is_loaded_before_it_is_needed() -> None:
    program = "import sys, studio.notebook; print({'matplotlib', 'torch', 'IPython', 'pyarrow'} & set(sys.modules))"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert ended.stdout == "set()\n", ended.stderr


def test_a_design_shows_its_picture_its_numbers_and_its_success(reacher: Run) -> None:
    written = reacher.design()._repr_html_()
    assert written.startswith('<div style="max-width:480px"><svg')
    assert ["link_1", "m", "0.05", "5", "3", "2.7"] in cells(written)
    assert ["return [reward]", "0", "0"] in cells(written)
    assert "It was not evaluated." in reacher.design("1")._repr_html_()


def test_a_design_that_cant_be_built_shows_its_numbers_and_why(tmp_path: Path) -> None:
    phi = make_task("pen_press").design_space.initial.tolist()
    phi[0] = 1.5  # the first finger stands where the second one does
    written = open_run(write_hand_run(tmp_path, "pen_press", phi).path).design()._repr_html_()
    assert written.startswith("<p>It can't be built: fingers 1 and 2 stand")
    assert "<svg" in written
    assert ["placement_1", "rad", "-3.142", "3.142", "0", "1.5"] in cells(written)


@pytest.fixture
def hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """A run whose live page is short."""
    monkeypatch.setattr(notebook, "build_page", lambda _, which: Page(f"{PAGE}{which}".encode(), ""))
    phi = make_task("pen_press").design_space.initial.tolist()
    return open_run(write_hand_run(tmp_path, "pen_press", phi).path)


def test_a_hand_is_viewed_live_in_a_frame_that_reaches_nothing_else(hand: Run) -> None:
    (frame,) = html.fromstring(f"<div>{hand.design().view()._repr_html_()}</div>")
    assert frame.get("sandbox") == "allow-scripts"
    assert frame.get("srcdoc") == f"{PAGE}1"


def test_a_live_view_can_lie_in_a_file_beside_the_notebook(
    hand: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    written = hand.design().view(height=500, file="hand & co.html")._repr_html_()
    assert 'src="hand &amp; co.html"' in written
    assert "height:500px" in written
    assert Path("hand & co.html").read_text() == f"{PAGE}1"


def test_the_evolution_of_a_run_is_viewed_in_a_frame_too(reacher: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notebook, "build_evolution", lambda runs: Page(f"{PAGE}{runs[0].iteration}".encode(), ""))
    append(reacher.history.folder, progress(4))
    (frame,) = html.fromstring(f"<div>{reacher.view()._repr_html_()}</div>")
    assert (frame.get("sandbox"), frame.get("srcdoc")) == ("allow-scripts", f"{PAGE}4")


def test_what_cant_run_live_is_viewed_as_a_picture_and_a_table(reacher: Run) -> None:
    written = reacher.design().view()._repr_html_()
    assert "show is for hands that MuJoCo simulates, such as pen_press; this run is of reacher" in unescape(written)
    assert "<svg" in written
    assert "<iframe" not in written


def test_a_design_is_exported_where_it_is_asked_for(
    reacher: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(notebook, "build_bundle", lambda *asked: asked[1:])
    monkeypatch.setattr(notebook, "write_bundle", lambda bundle, path: (bundle, path))
    assert reacher.design("0").export(tmp_path / "arm", ["mjcf"]) == (("0", ["mjcf"]), tmp_path / "arm")
    assert reacher.design("3").export()[1].parent == reacher.history.folder.exports


def test_a_run_that_is_not_there_lists_the_choices(reacher: Run) -> None:
    runs = reacher.history.folder.path.parent
    with pytest.raises(UsageError, match=reacher.history.folder.id):
        open_run("nothing", runs)


def test_a_study_shows_the_table_of_its_report() -> None:
    rows = cells(open_study(ROOT / "docs" / "studies" / "pen")._repr_html_())
    assert rows[0][:2] == ["method", "solved at the end"]
    assert f"| {' | '.join(rows[1])} |" in (ROOT / "docs" / "comparison.md").read_text()


def test_the_curves_of_a_study_are_those_of_its_report(tmp_path: Path) -> None:
    write_study(tmp_path, [Made("direct", "direct")], [0, 1], iterations=10)
    assert len(open_study(tmp_path).plot().figure.axes) == 2
    with pytest.raises(StudyError, match="holds no curves of pen_press; its tasks are reacher"):
        open_study(tmp_path).plot("pen_press")


# --- training from a notebook -----------------------------------------------------------------------------------------


def test_a_training_that_fails_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notebook, "spawn_trainer", in_mood("dying"))
    with pytest.raises(RuntimeError, match="loss is NaN, says the stand-in"):
        train("reacher", runs=tmp_path)


def test_a_training_that_says_itself_that_it_fails_is_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(folder: RunFolder) -> subprocess.Popen[bytes]:
        append(folder, StateChanged(status="failed", iteration=0, message="the loss is not finite"))
        return subprocess.Popen(["true"])

    monkeypatch.setattr(notebook, "spawn_trainer", failing)
    with pytest.raises(RuntimeError, match="the loss is not finite"):
        train("reacher", runs=tmp_path)


def test_an_interrupt_stops_a_training_after_its_iteration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notebook, "spawn_trainer", stand_in)
    interrupted = SimpleNamespace(sleep=interrupting(time.sleep))  # for the notebook alone: other threads sleep, too
    monkeypatch.setattr(notebook, "time", interrupted)
    run = train("reacher", runs=tmp_path, iterations=7, seed=3)
    assert run.history.status == "stopped"
    assert (run.history.record.iterations, run.history.record.seed) == (7, 3)


def test_a_second_interrupt_ends_a_training_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asleep = subprocess.Popen(["sleep", "60"])
    monkeypatch.setattr(notebook, "spawn_trainer", lambda _: asleep)
    monkeypatch.setattr(notebook, "time", SimpleNamespace(sleep=interrupting(time.sleep, times=2)))
    with pytest.raises(RuntimeError):
        train("reacher", runs=tmp_path)
    assert asleep.returncode == -signal.SIGKILL


def interrupting(sleep: Callable[[float], None], times: int = 1) -> Callable[[float], None]:
    """Return a `sleep` that is interrupted the first times, as a user does."""
    naps = []

    def nap(seconds: float) -> None:
        naps.append(seconds)
        if len(naps) <= times:
            raise KeyboardInterrupt
        sleep(seconds)

    return nap


def test_a_wish_that_is_not_allowed_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="iterations"):
        train("reacher", runs=tmp_path, iterations=0)
    assert not list(tmp_path.iterdir())


# --- what is asked wrongly --------------------------------------------------------------------------------------------

WRONG: dict[str, tuple[Callable[[Run], object], str]] = {
    "a height of nothing": (lambda run: run.view(height=0), "height takes a whole number of pixels from 50 to 10000"),
    "a height in words": (lambda run: run.design().view(height='1px" onload="x'), "height takes a whole number"),  # pyright: ignore[reportArgumentType]
    "a height that is true": (lambda run: run.view(height=True), "height takes a whole number"),
    "a file outside": (lambda run: run.view(file="../x.html"), "file lies outside"),
    "a file at the root": (lambda run: run.design().view(file="/x.html"), "file lies outside"),
    "a file in no folder": (lambda run: run.view(file="none/x.html"), "in a folder that is there"),
    "a file that is no page": (lambda run: run.view(file="run.py"), "ends in .html"),
    "a file without a name": (lambda run: run.view(file=""), "file takes the path of"),
    "a file with a NUL": (lambda run: run.view(file="a\0.html"), "file takes the path of"),
    "a number as file": (lambda run: run.view(file=5), "file takes the path of a file or a folder, not 5"),  # pyright: ignore[reportArgumentType]
    "a design that is none": (lambda run: run.design("77"), "has no iteration 77"),
    "an iteration that is none": (lambda run: run.design(77), "has no iteration 77"),
    "a design before all": (lambda run: run.design(-1), 'no design "-1"'),
    "no design": (lambda run: run.design(None), "which takes"),  # pyright: ignore[reportArgumentType]
    "a true design": (lambda run: run.design(True), "which takes"),
    "a format alone": (lambda run: run.design().export("x.zip", "mjcf"), "formats takes a list of names"),
    "numbers as formats": (lambda run: run.design().export("x.zip", [5]), "formats takes a list of names"),  # pyright: ignore[reportArgumentType]
    "a number as place": (lambda run: run.design().export(5), "out takes the path of"),  # pyright: ignore[reportArgumentType]
    "no run": (lambda _: open_run(None), "run takes the path of"),  # pyright: ignore[reportArgumentType]
    "a home of nobody": (lambda _: open_run("~nobody-of-that-name/run"), "there is no such home"),
    "runs that are no folder": (lambda _: open_run("x", "none"), "none is no folder of runs"),
    "a number as runs": (lambda _: train("reacher", runs=5), "runs takes the path of"),  # pyright: ignore[reportArgumentType]
    "a study that is none": (lambda _: open_study("."), "holds no study"),
    "a number as study": (lambda _: open_study(5), "directory takes the path of"),  # pyright: ignore[reportArgumentType]
    "an unknown task": (lambda _: train("walker", runs="runs"), 'unknown task "walker"'),
    "a number as task": (lambda _: train(5, runs="runs"), 'unknown task "5"'),  # pyright: ignore[reportArgumentType]
    "an unknown method": (lambda _: train("reacher", method="best", runs="runs"), "unknown method"),
    "an unknown preset": (lambda _: train("reacher", preset="best", runs="runs"), "preset"),
    "an unknown setting": (lambda _: train("reacher", settings={"speed": 1}, runs="runs"), "speed"),
    "a setting without a name": (lambda _: train("reacher", settings={5: 1}, runs="runs"), "settings takes"),  # pyright: ignore[reportArgumentType]
    "settings in words": (lambda _: train("reacher", settings="fast", runs="runs"), "settings takes names and values"),  # pyright: ignore[reportArgumentType]
    "a setting that is no number": (lambda _: train("reacher", settings={"alpha": "x"}, runs="runs"), "alpha"),
    "iterations in words": (lambda _: train("reacher", iterations="5", runs="runs"), "iterations must be"),  # pyright: ignore[reportArgumentType]
    "half a seed": (lambda _: train("reacher", seed=0.5, runs="runs"), "seed must be"),  # pyright: ignore[reportArgumentType]
    "runs in a file": (lambda run: train("reacher", runs=run.history.folder.path / "run.json"), "no run can be"),
}  # fmt: skip


@pytest.mark.parametrize("asked", WRONG)
def test_what_is_asked_wrongly_is_refused_in_a_sentence_and_leaves_nothing(
    reacher: Run, asked: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        pytest.fail("it is made all the same")

    for name in ("build_page", "build_evolution", "build_bundle", "spawn_trainer"):
        monkeypatch.setattr(notebook, name, never)
    here = tmp_path / "notebooks"
    here.mkdir()
    monkeypatch.chdir(here)
    before = set(tmp_path.rglob("*"))
    ask, sentence = WRONG[asked]
    with pytest.raises(ValueError, match=re.escape(sentence)):
        ask(reacher)
    assert set(tmp_path.rglob("*")) == before


def test_a_page_that_the_disk_does_not_take_is_said_and_leaves_nothing(
    reacher: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(notebook, "build_evolution", lambda _: Page(PAGE.encode(), ""))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.html").write_text("an earlier one")
    before = set(tmp_path.rglob("*"))
    with monkeypatch.context() as within:
        within.setattr(os, "fsync", full)
        with pytest.raises(ValueError, match=r"x\.html can't be written: No space left on device"):
            reacher.view(file="x.html")
    assert set(tmp_path.rglob("*")) == before
    assert (tmp_path / "x.html").read_text() == "an earlier one"


# --- the example ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def committed() -> nbformat.NotebookNode:
    return nbformat.read(NOTEBOOK, as_version=4)


def test_the_example_is_committed_with_its_outputs(committed: nbformat.NotebookNode) -> None:
    code = [cell for cell in committed.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, 11))
    assert all(cell.outputs for cell in code[1:])
    assert not [output for cell in code for output in cell.outputs if output.output_type == "error"]
    assert NOTEBOOK.stat().st_size < LARGEST
    assert not re.findall(r"/(?:work|tmp|home|root)/", NOTEBOOK.read_text())


@pytest.mark.slow
def test_the_example_runs_from_training_to_export(
    committed: nbformat.NotebookNode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    short = nbformat.from_dict(committed)
    (training,) = (cell for cell in short.cells if "iterations=" in cell.source and cell.cell_type == "code")
    training.source = re.sub(r"iterations=\d+", "iterations=4", training.source)
    NotebookClient(short, timeout=200, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [str(cell.outputs) for cell in short.cells if cell.cell_type == "code"]
    assert "4 of 4" in shown[2]
    assert "image/svg+xml" in shown[3]
    assert (tmp_path / "design.zip").is_file()
