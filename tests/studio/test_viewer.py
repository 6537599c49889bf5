"""The viewer on a real viser server, driven through `show`, by its handles, and by a browser's raw messages."""

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from conftest import NAME, Page, append, design_of, eventually, make_hand_run, make_run, progress

from morph_core.protocol import (
    InjectDesign,
    StateChanged,
)
from morph_core.run_folder import RunFolder
from studio.new_run import StartRun


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_run(tmp_path / "runs", NAME, ended="finished")


def test_the_viewer_turns_to_an_iteration_and_follows_no_longer(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    page.viewer.turn_to(2)
    take = page.take(lambda take: take.shot.phi[0] == pytest.approx(2.8))
    assert (take.shot.episode, page.viewer.timeline.follow.value) == (None, False)
    page.viewer.turn_to(999)
    assert page.viewer.timeline.shown_iteration == 3


# --- without a run ---


def test_a_page_without_runs_shows_the_initial_design_and_the_start_panel(page: Page) -> None:
    page.viewer.show({}, {}, None)
    assert page.viewer.start.folder.visible
    assert not page.viewer.tabs.visible
    assert "press Start" in page.viewer.traces.note.content
    assert not page.viewer.traces.charts
    take = page.take()
    assert set(take.robot.names) == {"base", *(f"link_{i}" for i in range(1, 6))}
    assert "goal" in take.scenery.names
    assert take.frames == 1


def test_start_asks_for_what_the_form_says_and_opens_the_run(page: Page) -> None:
    form = page.viewer.start
    form.options["reacher"]["tunnel"].value = "paper"
    form.seed.value, form.iterations.value, form.settings.alpha.value = 7, 50, 2.5
    form.settings.projection.value, form.settings.exploration.value = "one_sided", "gaussian"
    form.submit(None)
    assert page.started == [
        StartRun(
            task="reacher", preset="studio", method="morph", seed=7, iterations=50, task_options={"tunnel": "paper"},
            settings={"alpha": 2.5, "projection": "one_sided", "exploration": "gaussian"},
        )
    ]  # fmt: skip
    assert page.viewer.selected == NAME
    assert "starting" in page.viewer.run.state.content


def test_another_tunnel_is_seen_before_the_start(page: Page) -> None:
    page.viewer.show({}, {}, None)
    page.take()
    page.viewer.start.options["reacher"]["tunnel"].value = "paper"
    assert len(page.take(lambda take: len(take.scenery) > 5).scenery) == 9


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("alpha", math.nan, "alpha must be finite"),
        ("alpha", -1.0, "alpha must lie in [0, 1000000]"),
        ("seed", -1, "seed must be a whole number from 0"),
        ("iterations", 0, "iterations must be a whole number from 1"),
        ("iterations", 10**9, "iterations must be a whole number from 1 to 1000000"),
        ("projection", "sideways", "choose from: none, one_sided, as_printed"),
        ("exploration", "hope", "choose from: design, gaussian"),
        ("method", "magic", "choose from: morph"),
        ("task", "reach", "choose from:"),
    ],
)
def test_bad_start_values_start_nothing_and_say_what_is_allowed(
    page: Page, name: str, value: object, sentence: str
) -> None:
    form = page.viewer.start
    getattr(form if hasattr(form, name) else form.settings, name)._impl.value = value
    page.viewer.start.submit(None)
    assert not page.started
    assert page.viewer.selected is None
    assert sentence in page.viewer.start.notice.content.replace("&quot;", '"')


def test_a_refused_start_leaves_the_start_panel(page: Page) -> None:
    page.refusal = "two runs are running already"
    page.viewer.start.submit(None)
    assert "two runs are running already" in page.viewer.start.notice.content
    assert page.viewer.selected is None
    assert not page.viewer.start.start.disabled


# --- a run ---


def test_a_run_is_shown_with_its_numbers_charts_and_episode(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    assert "iteration <b>3</b> of 100" in page.viewer.run.state.content
    assert "50 %" in page.viewer.run.numbers.content
    take = page.take(lambda take: take.frames > 1)
    assert take.duration == pytest.approx(0.3)
    assert take.ghost is not None
    np.testing.assert_allclose(take.robot.sizes[1:, 2], 1.35)
    np.testing.assert_allclose(take.ghost.sizes[1:, 2], 1.5)


def test_charts_are_never_given_empty_arrays_and_wait_for_their_first_value(page: Page, tmp_path: Path) -> None:
    folder = make_run(tmp_path / "new", NAME, ended=None)
    page.show(folder)
    assert set(page.viewer.traces.charts) == {"Design φ"}
    for event in (
        StateChanged(status="starting", iteration=0),
        progress(1),
        progress(2, cosine=-0.5, cosine_negative=0.75, divergence=0.3),
        progress(3, cosine=0.5, cosine_negative=0.25, divergence=0.0, search_cost=0.1),
    ):
        append(folder, event)
        page.show(folder)
        for chart in page.viewer.traces.charts.values():
            assert len({len(column) for column in chart.data}) == 1
            assert len(chart.data[0]) >= 2
    assert "Success on Hw-Phy" not in page.viewer.traces.charts
    links = page.viewer.traces.charts["Design φ"]
    assert eventually(
        lambda: page.show(folder) and links.data[1].tolist() == [3, 2, 2, 2, 2, 2, 2]
    )  # charts rest between
    cosines = page.viewer.traces.charts["Agreement of g_task and g_hw"]
    marked = [[2, 3, 3, 3, 3], [-0.5, *[0.5] * 4], [0.75, *[0.25] * 4], [-1, -1, 2, -1, -1]]
    np.testing.assert_allclose(cosines.data, marked)
    assert "Agreement by design parameter" not in page.viewer.traces.charts  # not defined so far
    append(folder, progress(4, cosine_by_parameter=[-0.5, None, 0.5, 1.0, -1.0]), progress(5))
    assert eventually(lambda: page.show(folder) and "Agreement by design parameter" in page.viewer.traces.charts)
    shares = page.viewer.traces.charts["Agreement by design parameter"].data
    assert shares[1][0] == -0.5
    assert np.isnan(shares[2]).all()
    distances = page.viewer.traces.charts["Proxy against Hw-Phy: mean squared distance"].data
    assert np.isnan(distances[1][1])  # no zero on a logarithmic axis


def test_charts_go_when_a_run_without_their_values_is_opened(page: Page, folder: RunFolder, tmp_path: Path) -> None:
    page.show(folder)
    chart = page.viewer.traces.charts["Success on Hw-Phy"]
    assert chart.visible
    page.show(make_run(tmp_path / "other", "20260202-000000-reacher-morph-s1", ended=None))
    assert not chart.visible
    page.show(folder)
    page.viewer.select(None)
    assert not any(chart.visible for chart in page.viewer.traces.charts.values())


def test_a_failed_run_says_why_in_html_that_harms_nobody(page: Page, folder: RunFolder) -> None:
    page.show(folder, "failed", "loss is NaN <img src=x onerror=alert(1)>")
    failure = page.viewer.run.failure
    assert failure.visible
    assert "failed: loss is NaN &lt;img" in failure.content
    assert "<img" not in failure.content + page.viewer.run.state.content


def test_an_unreadable_run_says_why(page: Page) -> None:
    page.viewer.show({}, {"foreign": ("unreadable", "run.json can't be read")}, "foreign")
    assert "unreadable: run.json can&#x27;t be read" in page.viewer.run.failure.content
    assert not page.viewer.run.pause.visible


def test_a_rollout_that_is_damaged_is_reported_and_the_next_design_is_shown(page: Page, folder: RunFolder) -> None:
    folder.episode(3).write_bytes(b"no zip at all")
    page.show(folder)
    assert eventually(lambda: "can&#x27;t be shown" in page.viewer.notice.content)
    page.viewer.timeline.follow.value = False
    page.viewer.timeline.iteration.value = 2
    page.show(folder)
    np.testing.assert_allclose(page.take(lambda take: take.shot.phi[0] == 2.8).robot.sizes[1:, 2], 1.4)


# --- choosing ---


def test_what_the_studio_suggests_is_opened_once_and_a_choice_then_stays(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    assert page.viewer.selected == NAME
    page.viewer.open(None)
    page.show(folder)
    assert page.viewer.selected is None
    assert page.viewer.start.folder.visible
    page.viewer.open(NAME)
    assert page.viewer.selected == NAME


def test_an_unknown_run_is_said_to_be_unknown(page: Page, folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    page.show(folder)
    monkeypatch.setattr("studio.viewer.choice._START_PATIENCE", -1.0)
    page.viewer.open("../../<etc>")
    assert "../../&lt;etc&gt; has not shown up" in page.viewer.run.failure.content
    assert not page.viewer.run.pause.visible


# --- export ---


def test_the_chosen_design_is_exported_in_the_chosen_formats(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    export = page.viewer.export
    assert not export.download.visible
    for which in ("best", "latest"):
        export.design.value = which
        export.submit()
    export.design.value, export.iteration.value = "iteration", 2
    assert export.iteration.visible
    for name in ("mjcf", "3mf", "glb"):
        export.formats[name].value = False
    export.submit()
    everything = ["mjcf", "urdf", "stl", "3mf", "glb"]
    assert page.exported == [
        (NAME, "best", everything), (NAME, "latest", everything), (NAME, "2", ["urdf", "stl"]),
    ]  # fmt: skip
    assert not export.notice.visible


def test_a_servo_is_chosen_where_the_robot_takes_servos(page: Page, folder: RunFolder, tmp_path: Path) -> None:
    export, hand = page.viewer.export, make_hand_run(tmp_path / "hands", "pen_press")
    page.show(folder)
    assert not export.servo.visible
    page.show(hand)
    assert export.servo.visible
    export.submit()
    export.servo.value = "XM430-W350"
    assert not export.download.visible  # it was prepared without one
    export.submit()
    assert page.servos == ["XM430-W350"]


def test_a_printer_is_asked_for_only_by_who_prints_on_another(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    export = page.viewer.export
    for word in ("prusa_xl", " 300x300x400 ", "", "256x256x256"):
        export.printer.value = word
        export.submit()
    export.printer.value, export.formats["3mf"].value = "prusa_xl", False
    export.submit()
    assert page.printers == ["prusa_xl", "300x300x400", None, None, None]


def test_what_was_compared_is_shown_and_a_change_of_mind_takes_it_away(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    export = page.viewer.export
    export.submit()
    assert "1 comparisons agree" in export.result.content
    assert "design.zip" in export.result.content, "which run and design it is"
    assert "mjcf" in export.result.content
    assert "0 kB" in export.download.label
    assert export.download.visible
    export.formats["stl"].value = False
    assert not export.download.visible
    assert not export.result.visible


def test_a_design_that_is_brought_along_is_injected(page: Page, folder: RunFolder) -> None:
    history = page.show(folder)
    design = design_of(history, [1.0, 2.0, 3.0, 2.0, 1.0])
    page.viewer.wishes.go_on_from(msgspec.json.encode(design), None)
    assert page.commands == [(NAME, InjectDesign([1.0, 2.0, 3.0, 2.0, 1.0]))]
    page.viewer.wishes.go_on_from(msgspec.json.encode(msgspec.structs.replace(design, task="pen_press")), None)
    assert "design for pen_press, not for reacher" in page.viewer.notice.content
    page.viewer.wishes.go_on_from(b"<mujoco/>", None)
    assert "no design.json" in page.viewer.notice.content
    assert len(page.commands) == 1


@pytest.mark.parametrize(("which", "iteration"), [("iteration", 99), ("iteration", -1), ("finest", 0)])
def test_a_design_that_is_not_there_is_not_exported(page: Page, folder: RunFolder, which: str, iteration: int) -> None:
    page.show(folder)
    page.viewer.export.design._impl.value = which
    page.viewer.export.iteration.value = iteration
    page.viewer.export.submit()
    assert page.exported == []
    assert "choose" in page.viewer.export.notice.content


def test_an_export_that_is_refused_says_why(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    page.refusal = "the files don't agree"
    page.viewer.export.submit()
    assert "the files don&#x27;t agree" in page.viewer.export.notice.content
    assert not page.viewer.export.check.disabled
    assert not page.viewer.export.download.visible
