"""How runs of hands read: the change of each part, units, milestones, rules, and what the forms allow."""

import dataclasses
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from conftest import Page, design_of, make_hand_run, make_run
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from morph_core.catalogue import TASKS, make_task
from morph_core.design import DesignSpace
from morph_core.history import History
from morph_core.protocol import Lock, Parameter, SetBound
from morph_core.run_folder import RunFolder
from studio.viewer.change import change_table
from studio.viewer.charts import MARK
from studio.viewer.parts import Unit, quantities_of, split_name, unit_of
from studio.viewer.rules import rules_of
from studio.viewer.traces import _traces_of
from tests.foreign import Pointer

HANDS = sorted(name for name in TASKS if name != "reacher")


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_hand_run(tmp_path / "runs", "pen_press")


def words_of(table: str) -> list[str]:
    """Return the text of an HTML table."""
    return [words for words in re.split(r"(?:<[^>]*>|\s)*<[^>]*>(?:<[^>]*>|\s)*", table) if words]


def test_a_hand_shows_its_printed_parts_until_somebody_wants_its_collision_shapes(
    page: Page, folder: RunFolder
) -> None:
    page.show(folder)
    assert set(page.take(lambda take: take.shot.task == "pen_press").robot.kinds) == {"mesh"}
    page.viewer.looks.printed.value = False
    assert set(page.take(lambda take: "mesh" not in take.robot.kinds).robot.kinds) == {"capsule", "cylinder"}
    page.viewer.select(None)
    assert "mesh" not in page.take(lambda take: take.shot.task == "reacher").robot.kinds  # threads among metres


def test_a_robot_without_printed_parts_offers_none_to_be_seen(
    page: Page, folder: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(TASKS._loaded(), Pointer.name, Pointer)
    page.show(folder)
    assert page.viewer.looks.printed.visible
    page.show(make_hand_run(tmp_path / "others", Pointer.name, "a-pointer"))
    assert not page.viewer.looks.printed.visible
    assert page.viewer.looks.ghost.visible


# --- parts and units ---


@pytest.mark.parametrize("task", HANDS)
def test_each_finger_has_a_placement_in_degrees_and_a_length_in_centimetres(tmp_path: Path, task: str) -> None:
    placement, length = quantities_of(History(make_hand_run(tmp_path, task)))
    assert (placement.name, placement.unit.name) == ("placement", "°")
    assert (length.name, length.unit.name) == ("length", "cm")
    fingers = [f"finger {i}" for i in range(1, TASKS[task].fingers + 1)]
    assert [e.part for e in placement.entries] == [e.part for e in length.entries] == fingers
    assert sorted(e.index for q in (placement, length) for e in q.entries) == list(range(2 * len(fingers)))
    assert len({e.colour for e in length.entries}) == len(fingers)


def test_links_of_metres_stay_in_metres(tmp_path: Path) -> None:
    (link,) = quantities_of(History(make_run(tmp_path)))
    assert link.unit == Unit("m", 1.0, 2)
    assert [entry.part for entry in link.entries] == [f"link {i}" for i in range(1, 6)]


def test_lengths_that_are_named_as_their_parts_are_one_quantity(tmp_path: Path) -> None:
    history = History(make_run(tmp_path))
    history.record = msgspec.structs.replace(history.record, task="gone")
    names = (("upper_arm", "m", "upper_arm"), ("forearm", "m", "forearm"), ("tilt", "rad", "upper_arm"))
    parameters = tuple(Parameter(name, unit, 0, 0.5, 0.2, 0, 0.5, part=part) for name, unit, part in names)
    history.in_force = dataclasses.replace(history.in_force, space=DesignSpace(parameters))
    lengths, tilt = quantities_of(history)
    assert (lengths.name, [entry.part for entry in lengths.entries]) == ("length", ["upper arm", "forearm"])
    assert (tilt.name, [entry.part for entry in tilt.entries]) == ("tilt", ["upper arm"])
    charts = [trace for trace in _traces_of(history).values() if trace.title.startswith("Design φ")]
    titles = {trace.title: trace.labels for trace in charts}
    assert titles == {"Design φ: length": ("upper arm", "forearm"), "Design φ: tilt": ("upper arm",)}


def test_parameters_of_a_task_that_is_gone_keep_their_names(tmp_path: Path) -> None:
    history = History(make_hand_run(tmp_path, "pen_press"))
    history.record = msgspec.structs.replace(history.record, task="gone")
    placement, _ = quantities_of(history)
    assert [entry.part for entry in placement.entries][:2] == ["finger 1", "finger 2"]
    forget_parts(history)
    placement, _ = quantities_of(history)
    assert [entry.part for entry in placement.entries][:2] == ["placement 1", "placement 2"]


@pytest.mark.parametrize("task", sorted(TASKS))
def test_a_run_from_before_parameters_named_their_parts_looks_like_one_of_today(tmp_path: Path, task: str) -> None:
    history = History(make_run(tmp_path) if task == "reacher" else make_hand_run(tmp_path, task))
    today = quantities_of(history)
    assert all(p.part for p in history.design_space.parameters)
    forget_parts(history)
    assert quantities_of(history) == today


def forget_parts(history: History) -> None:
    """Let the run be one from before parameters named the parts they are of."""
    space = DesignSpace(tuple(msgspec.structs.replace(p, part="") for p in history.design_space.parameters))
    history.in_force = dataclasses.replace(history.in_force, space=space)


@pytest.mark.parametrize(("name", "parts"), [("length_12", ("length", "12")), ("stiffness", ("stiffness", ""))])
def test_a_name_is_a_quantity_and_a_number(name: str, parts: tuple[str, str]) -> None:
    assert split_name(name) == parts


@given(st.floats(-4, 4), st.sampled_from(["rad", "m", "kg", ""]), st.sampled_from([0.4, 5.0]))
def test_a_change_says_its_sign_and_unit_once(value: float, unit: str, largest: float) -> None:
    shown = unit_of(Parameter("p", unit, -largest, largest, 0, -largest, largest))
    words = shown.change(value)
    assert words.endswith(shown.name)
    number = float(words.removesuffix(shown.name).strip(" ±+").replace("−", "-"))
    assert number == pytest.approx(value * shown.factor, abs=0.51 * 10**-shown.digits)
    assert words[0] == ("±" if number == 0 else "+" if value > 0 else "−")


# --- the table ---


def test_the_change_of_each_finger_is_in_the_table(folder: RunFolder) -> None:
    history = History(folder)
    words = words_of(change_table(history, history.phi))
    initial = 100 * history.initial_phi[-1]
    assert words[:2] == ["placement", "length"]
    assert words[2:6] == ["finger 1", "+5.7°", f"{initial:.1f} → {initial + 5:.1f} cm", "+5.0 cm"]
    assert words[6:10] == ["finger 2", "±0.0°", f"{initial:.1f} → {initial:.1f} cm", "±0.0 cm"]


def test_the_largest_change_fills_its_side_and_a_shorter_finger_goes_to_the_left(folder: RunFolder) -> None:
    history = History(folder)
    phi = history.initial_phi.copy()
    phi[4:] += (0.2, -0.1, 0.0, 0.0)
    bars = re.findall(r"left:([\d.]+)%;width:([\d.]+)%", change_table(history, phi))
    lengths = [(float(left), float(width)) for left, width in bars[1::2]]
    assert lengths == [(50, 50), (25, 25), (50, 0), (50, 0)]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])  # the run is only read
@given(st.lists(st.floats(-1, 1), min_size=8, max_size=8))
def test_bars_stay_in_their_track(folder: RunFolder, change: list[float]) -> None:
    history = History(folder)
    bars = re.findall(r"left:([\d.]+)%;width:([\d.]+)%", change_table(history, history.initial_phi + np.array(change)))
    assert len(bars) == 8
    assert all(float(left) >= 0 and float(left) + float(width) <= 100.05 for left, width in bars)


# --- the panels ---


def test_a_hands_run_is_shown_with_milestones_losses_and_rules(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    numbers = words_of(page.viewer.run.numbers.content)
    shown = dict(zip(numbers[::2], numbers[1::2], strict=True))
    assert shown["lifted, sampled"] == "75 %"
    assert shown["pressed, sampled"] == "50 %"
    assert shown["diverged in this evaluation"] == "2 episodes"
    assert shown["episodes left out: diverged"] == "3"
    assert shown["environment steps"] == "5.1 k"
    assert shown["steps for relabelling"] == "1.0 k"
    assert "Options: grasp any_two, servo none, servo_limits none." in page.viewer.run.rules.content
    assert "at least half of the last ten control steps" in page.viewer.run.rules.content


def test_nothing_is_said_of_divergence_where_nothing_diverged(page: Page, tmp_path: Path) -> None:
    page.show(make_run(tmp_path))
    assert "diverged" not in page.viewer.run.numbers.content
    assert "relabelling" not in page.viewer.run.numbers.content


def test_the_method_is_named_with_the_rules_that_it_uses(folder: RunFolder, tmp_path: Path) -> None:
    assert rules_of(History(folder))[0].startswith("Method direct: φ follows the returns")
    morph = rules_of(History(make_run(tmp_path / "reacher")))
    assert morph[0] == "Method morph: z explored by design, φ searched by cma, projection none."
    assert morph[1] == "Options: tunnel zigzag, z joints."


@pytest.mark.parametrize("task", sorted(TASKS))
def test_a_run_says_what_counts_as_success(tmp_path: Path, task: str) -> None:
    history = History(make_run(tmp_path) if task == "reacher" else make_hand_run(tmp_path, task))
    assert rules_of(history)[-1] == f"Success: {make_task(task).success_rule}"
    history.record = msgspec.structs.replace(history.record, task="gone")
    assert not any(line.startswith("Success") for line in rules_of(history))


def test_success_has_its_milestones_and_each_unit_of_phi_its_own_chart(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    charts = page.viewer.traces.charts
    labels = {title: [series.get("label") for series in chart.series[1:]] for title, chart in charts.items()}
    assert labels["Success on Hw-Phy"] == ["sampled", "deterministic", "lifted", "pressed", MARK]
    np.testing.assert_allclose([column[-1] for column in charts["Success on Hw-Phy"].data[1:-1]], [25, 50, 75, 50])
    assert labels["Design φ: placement by finger"] == labels["Design φ: length by finger"] == ["1", "2", "3", "4", MARK]
    placement = charts["Design φ: placement by finger"].data[1]
    np.testing.assert_allclose(placement, np.degrees([0, *[0.1] * 4]))
    initial = 100 * make_task("pen_press").design_space.initial[-1]
    np.testing.assert_allclose(charts["Design φ: length by finger"].data[1], initial + np.array([0, *[5] * 4]))
    assert "+5.7°" in page.viewer.traces.change.content


def test_charts_are_made_anew_for_a_run_of_another_robot(page: Page, folder: RunFolder, tmp_path: Path) -> None:
    page.show(folder)
    page.show(make_run(tmp_path / "other"))
    assert "Design φ" in page.viewer.traces.charts
    assert not any(title.startswith("Design φ:") for title in page.viewer.traces.charts)
    assert (
        len(page.viewer.traces.charts["Success on Hw-Phy"].series) == 4
    )  # both policies, and the line at the shown iteration


def test_the_divergence_is_in_the_units_of_z(folder: RunFolder, tmp_path: Path) -> None:
    axes = [_traces_of(history)[50].axis for history in (History(make_run(tmp_path / "reacher")), History(folder))]
    assert axes == ["[m²]", "[typical step²]"]


def test_the_cost_of_a_search_stays_until_the_next_one(folder: RunFolder) -> None:
    history = History(folder)
    costs = [None, 0.5, None, 0.25, None]
    history.progress = [
        msgspec.structs.replace(history.progress[0], iteration=i, divergence=1.0, search_cost=cost)
        for i, cost in enumerate(costs)
    ]
    _, divergence, cost = _traces_of(history)[50].curves(history)
    np.testing.assert_array_equal(divergence, np.ones(5))
    np.testing.assert_array_equal(cost, [np.nan, 0.5, 0.5, 0.25, 0.25])


def test_bounds_that_the_browser_rounded_are_no_edits(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    rows = page.viewer.design.rows
    rows["placement_1"].bounds.value = (-180.0, 180.0)  # of -pi and pi
    assert page.viewer.design.commands() == []
    rows["placement_1"].bounds.value = (-30.0, 180.0)
    rows["length_2"].locked.value, rows["length_2"].value.value = True, 15.0  # cm
    assert page.viewer.design.commands() == [SetBound("placement_1", -np.pi / 6, np.pi), Lock("length_2", 0.15)]


def test_a_finger_has_one_heading_with_both_of_its_parameters(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    groups = page.viewer.design.groups
    assert [group.name for group in groups] == ["finger 1", "finger 2", "finger 3", "finger 4"]
    assert str(groups[0].folder.label).startswith("finger 1: placement 5.7°, length ")
    assert groups[0].told.visible
    assert "placement_1: 5.7° (initially 0.0°)<br>length_1: 17.0 cm" in groups[0].told.content
    assert [row.locked.label for row in page.viewer.design.rows.values()][:2] == ["placement locked", "length locked"]


def test_a_run_can_begin_with_a_design_that_was_exported(page: Page, folder: RunFolder) -> None:
    history, form = History(folder), page.viewer.start
    phi = [0.1, -0.2, 0.0, 0.3, 0.2, 0.21, 0.22, 0.23]
    options: dict[str, object] = {"grasp": "two_besides_presser", "mass": 0.2}
    design = msgspec.structs.replace(design_of(history, phi), task_options=options)
    page.viewer.show({}, {}, None)
    form.take(msgspec.json.encode(design))
    assert form.task.value == "pen_press"
    assert form.options["pen_press"]["grasp"].value == "two_besides_presser"
    assert "begins with the design of iteration 1" in form.source.content
    assert page.take(lambda take: take.shot.phi == tuple(phi)).shot.task == "pen_press"
    form.submit(None)
    (request,) = page.started
    assert request.task_options == options
    assert request.parameters is not None
    assert [p.initial for p in request.parameters] == phi
    page.viewer.select(None)
    form._start_from(None)
    assert page.take(lambda take: take.shot.phi != tuple(phi)).shot.phi[4:] == (0.12,) * 4
    form.submit(None)
    assert page.started[1].parameters is None
    assert page.started[1].task_options == {"grasp": "two_besides_presser"}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [({"task": "juggling"}, "choose from"), ({"parameters": []}, "lacks placement_1"), ({"kind": "cake"}, "no design"),
     ({"task_options": {"mass": "heavy"}}, "mass must be a number"), ({"task_options": {"hue": 1}}, "hue")],
)  # fmt: skip
def test_what_is_no_design_to_begin_with_is_refused_and_changes_nothing(
    page: Page, folder: RunFolder, change: dict[str, object], sentence: str
) -> None:
    form = page.viewer.start
    design = msgspec.structs.replace(design_of(History(folder), [0.0] * 4 + [0.2] * 4), **change)
    form.take(msgspec.json.encode(design))
    assert sentence in form.notice.content
    assert form.task.value == next(iter(TASKS))
    assert not form.source.visible
    form.submit(None)
    assert page.started[0].parameters is None


def test_another_task_drops_the_design_of_the_first(page: Page, folder: RunFolder) -> None:
    form = page.viewer.start
    form.take(msgspec.json.encode(design_of(History(folder), [0.0] * 4 + [0.2] * 4)))
    assert form.source.visible
    form.task.value = "mouse_click"
    assert not form.source.visible
    form.submit(None)
    assert (page.started[0].task, page.started[0].parameters) == ("mouse_click", None)


@pytest.mark.parametrize("task", HANDS)
def test_a_hand_is_not_offered_what_it_cannot_be_run_with(page: Page, task: str) -> None:
    form = page.viewer.start
    form.task.value = task
    assert list(form.settings.exploration.options) == ["design"]
    form.settings.exploration._impl.value = "gaussian"
    form.submit(None)
    assert not page.started
    assert "explored by &quot;gaussian&quot;" in form.notice.content
    form.settings.exploration._impl.value = "design"
    form.submit(None)
    assert [request.task for request in page.started] == [task]


def test_another_task_is_seen_before_the_start(page: Page) -> None:
    page.viewer.show({}, {}, None)
    page.viewer.start.task.value = "pen_press"
    take = page.take(lambda take: take.shot.task == "pen_press")
    assert "button" in take.objects.names
    assert page.viewer.start.options["pen_press"]["grasp"].visible
    assert not page.viewer.start.options["reacher"]["tunnel"].visible
