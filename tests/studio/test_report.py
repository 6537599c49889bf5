"""report.html shows the whole design at a glance, needs nothing from elsewhere, and says what is not known."""

import base64
import dataclasses
import html
import io
import re
from collections.abc import Sequence
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest
from conftest import design_of, make_hand_run
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.protocol import Evaluation
from morph_core.what_if import wilson_interval
from studio.export.design_file import Design
from studio.export.loading import LOADINGS
from studio.export.policy import Score
from studio.export.report import Section, Sheet, report
from studio.export.servo_plot import Bar, servo_plot, ticks
from studio.export.views import APART, GAP, apart, placed_parts, spread_out, views_of
from studio.robots.chooser import robot_of
from studio.robots.parts import body_of
from studio.units import unit_of

TASK = make_task("pen_press")
PHI = TASK.design_space.initial + np.array([0.1, 0, 0, 0, 0.05, 0, 0.02, 0])
MODEL = TASK.spec(PHI).compile()
ROBOT = robot_of(TASK)
PARTS = ROBOT.parts(PHI)
LINKS = {link for part in PARTS for link in part.links}


SPARSE = Sheet(
    title="a robot", robot=ROBOT, parts=[], views=None, formats=("urdf",), scores=[], recorded=None, episodes=None,
    program=None,
    design=Design(
        task="pointer", task_options={}, robot="robot", run="r", design="best", iteration=1, parameters=[],
    ),
)  # fmt: skip
"""A report of which next to nothing is known."""


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Sheet:
    """What a report tells of a hand that was evaluated in training and at the export."""
    history = History(make_hand_run(tmp_path_factory.mktemp("runs"), "pen_press"))
    return Sheet(
        title=TASK.title, design=design_of(history, PHI.tolist()), robot=ROBOT, parts=PARTS,
        views=views_of(MODEL, PARTS), formats=("mjcf", "urdf", "onnx"), scores=[Score(32, 0.75, "at export")],
        recorded=history.evaluations[-1], episodes=256, program=ROBOT.program(PHI),
    )  # fmt: skip


class Page(HTMLParser):
    """Reads what a page asks a browser to fetch, and the words that it shows."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.asked: list[str] = []
        self.tags: list[str] = []
        self.words = ""
        self.feed(page.decode())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.words += " "
        self.asked += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "action", "data")]

    def handle_data(self, data: str) -> None:
        self.words += data


def words_of(sheet: Sheet) -> str:
    return " ".join(Page(report(sheet)).words.split())


def pixels(address: str) -> np.ndarray:
    """Return an image (h, w, 4) that an address holds."""
    content = base64.b64decode(address.removeprefix("data:image/png;base64,"), validate=True)
    return np.array(Image.open(io.BytesIO(content)))


def box(image: np.ndarray) -> tuple[int, int]:
    """Return the width and the height in pixels of what is seen in an image."""
    seen = image[..., 3] > 0
    return int(np.ptp(np.flatnonzero(seen.any(0)))) + 1, int(np.ptp(np.flatnonzero(seen.any(1)))) + 1


# --- the pictures ---


def test_the_views_from_the_sides_show_the_robot_to_the_scale_that_stands_below_them(sheet: Sheet) -> None:
    assert sheet.views is not None
    views = {view.caption: view for view in sheet.views.sides}
    width, depth, height = sheet.views.size
    for caption, across, up in (
        ("from the front", width, height), ("from the right", depth, height), ("from above", width, depth),
    ):  # fmt: skip
        metres_per_pixel = sheet.views.bar / sheet.views.bar_pixels
        image = pixels(views[caption].image)
        assert image.shape[:2] == (views[caption].height, views[caption].width)
        np.testing.assert_allclose(np.array(box(image)) * metres_per_pixel, [across, up], atol=3 * metres_per_pixel)
    assert sheet.views.bar in (0.05, 0.1, 0.2)


def test_no_picture_cuts_anything_off() -> None:
    phi = TASK.design_space.initial.copy()
    phi[-2:] = 0.4
    model = TASK.spec(phi).compile()
    views = views_of(model, robot_of(TASK).parts(phi))
    for view in (views.oblique, views.exploded, *views.sides):
        seen = pixels(view.image)[..., 3] > 0
        assert seen.any()
        assert not any(edge.any() for edge in (seen[0], seen[-1], seen[:, 0], seen[:, -1])), view.caption


def test_parts_are_drawn_apart_from_the_one_that_carries_them() -> None:
    placed = {part.link: part for part in placed_parts(MODEL, PARTS)}
    moved = apart(MODEL, list(placed.values()))
    assert moved.keys() == LINKS
    np.testing.assert_array_equal(moved["palm"], 0)
    for i in range(1, 5):
        for link, carrier in ((f"finger_{i}_proximal", "palm"), (f"finger_{i}_distal", f"finger_{i}_proximal")):
            before = placed[link].middle - placed[carrier].middle
            after = before + moved[link] - moved[carrier]
            np.testing.assert_allclose(after, (1 + APART) * before, atol=1e-12)


def test_every_link_has_one_label_that_points_at_it(sheet: Sheet) -> None:
    assert sheet.views is not None
    labels = sheet.views.labels
    assert sorted(label.link for label in labels) == sorted(LINKS)
    image = pixels(sheet.views.exploded.image)
    for label in labels:
        column, row = (round(place) for place in label.at)
        near = image[max(row - 40, 0) : row + 41, max(column - 40, 0) : column + 41]
        assert (near[..., 3] > 0).any(), f"nothing is near the label of {label.link}"
    for column in {label.beside[0] for label in labels}:
        heights = sorted(label.beside[1] for label in labels if label.beside[0] == column)
        assert np.diff(heights).min() >= GAP - 1e-6
    order = [int(body_of(MODEL, label.link)) for label in labels]
    assert order == sorted(order)


@given(st.lists(st.floats(-50, 700), min_size=1, max_size=30), st.floats(1, 60))
@example([0.0] * 30, 60.0)
@settings(max_examples=50)
def test_labels_stand_apart_and_inside_and_in_order(wanted: Sequence[float], gap: float) -> None:
    places = spread_out(np.sort(wanted), gap, 10.0, 600.0)
    room = min(gap, 590.0 / max(len(wanted) - 1, 1))
    assert places.min() >= 10 - 1e-6
    assert places.max() <= 600 + 1e-6
    assert np.diff(places).min(initial=room) >= room - 1e-6


def test_a_label_with_room_stands_at_the_height_of_its_part() -> None:
    np.testing.assert_allclose(spread_out(np.array([100.0, 200.0, 300.0]), 34, 10, 600), [100, 200, 300])


# --- the page ---


def test_the_page_asks_for_nothing_and_runs_nothing(sheet: Sheet) -> None:
    page = report(sheet)
    read = Page(page)
    assert read.asked
    assert all(address.startswith("data:image/png;base64,") for address in read.asked)
    assert not {"script", "link", "iframe", "object", "base", "form"} & set(read.tags)
    style = page.decode().split("<style>")[1].split("</style>")[0]
    assert "url(" not in style
    assert "@import" not in style
    assert "default-src 'none'" in page.decode()
    assert len(page) < 1 << 20


def test_the_page_shows_all_sections(sheet: Sheet) -> None:
    told = words_of(dataclasses.replace(sheet, more=[Section("Torques <of> servos", "<p>below")]))
    for heading in (
        "The robot", "Design φ", "Success", "Parts to print", "Torques <of> servos", "Load it", "Run the policy",
        "Check it",
    ):  # fmt: skip
        assert heading in told
    assert all(link in told for link in LINKS)


def test_phi_stands_in_centimetres_and_degrees_between_its_bounds(sheet: Sheet) -> None:
    told = words_of(sheet)
    assert "placement_1 5.7° −180.0 180.0° 0.0°" in told
    assert "length_1 17.0 cm 2.0 40.0 cm 12.0 cm" in told
    page = report(sheet).decode()
    for p in sheet.design.parameters:
        row = re.search(rf"<td>{p.name}<td.*?<tr|<td>{p.name}<td.*?</table", page, re.DOTALL)
        assert row is not None
        places = [float(at) for at in re.findall(r'<b style="left:([\d.]+)%', row[0])]
        assert places == [pytest.approx(100 * (p.value - p.lo) / (p.hi - p.lo), abs=0.01)]
        assert unit_of(p).number(p.value) in row[0]


def test_a_locked_parameter_whose_bounds_are_equal_is_shown(sheet: Sheet) -> None:
    first, *others = sheet.design.parameters
    fixed = msgspec.structs.replace(first, lo=first.value, hi=first.value, locked_at=first.value)
    design = msgspec.structs.replace(sheet.design, parameters=[fixed, *others])
    told = words_of(dataclasses.replace(sheet, design=design))
    assert "placement_1 locked 5.7° 5.7 5.7° 0.0°" in told
    assert "8 1 locked" in told


@given(st.integers(1, 1000), st.floats(0, 1), st.floats(0, 1))
@settings(max_examples=8, deadline=None)
def test_success_stands_with_its_interval_and_its_episodes(episodes: int, sampled: float, mean: float) -> None:
    recorded = Evaluation(
        iteration=1, env_steps=1, phi=[], sampled_success=round(sampled * episodes) / episodes, sampled_return=0.0,
        deterministic_success=round(mean * episodes) / episodes, deterministic_return=0.0,
    )  # fmt: skip
    bare = dataclasses.replace(SPARSE, recorded=recorded, episodes=episodes)
    told = words_of(bare)
    for share in (recorded.sampled_success, recorded.deterministic_success):
        low, high = wilson_interval(round(share * episodes), episodes)
        said = f"of {episodes} episodes; 95 %: {100 * low:.1f} % to {100 * high:.1f} %"
        assert f"{100 * share:.1f} % 0 100 % {said}" in told


def test_milestones_stand_below_success(sheet: Sheet) -> None:
    assert "lifted 75 %, pressed 50 %" in words_of(sheet)


def test_what_is_not_known_is_said_in_sentences() -> None:
    told = words_of(SPARSE)
    for sentence in (
        "No picture: the robot's model has no shape with a volume.",
        "Not measured: the run holds neither an evaluation nor a policy of this design.",
        "None: the robot's model has no shape with a volume.",
        "No policy: the run holds none of this design, or the export left out mjcf, in which it runs.",
        "Not in this bundle: export it with the format mjcf.",
    ):
        assert sentence in told


def test_an_evaluation_of_unknown_size_has_no_interval() -> None:
    recorded = Evaluation(
        iteration=1, env_steps=1, phi=[], sampled_success=0.5, sampled_return=0.0, deterministic_success=0.5,
        deterministic_return=0.0,
    )  # fmt: skip
    assert "50.0 % 0 100 % of how many episodes is not known" in words_of(
        dataclasses.replace(SPARSE, recorded=recorded)
    )


def test_the_page_shows_the_lines_that_the_tests_run(sheet: Sheet) -> None:
    shown = [html.unescape(text) for text in re.findall(r"<pre>(.*?)</pre>", report(sheet).decode(), re.DOTALL)]
    for tool in LOADINGS:
        assert tool.text("robot", "pen_press_description") in shown
    told = words_of(sheet)
    assert "Not in this bundle: export it with the format ros." in told
    assert "Not in this bundle: export it with the format urdf." not in told


@given(st.text(min_size=1, max_size=40))
@example("<script>alert(1)</script>")
@example('"><img src=x>')
@settings(max_examples=10, deadline=None)
def test_what_came_from_a_run_is_text(name: str) -> None:
    plain = set(Page(report(SPARSE)).tags)
    design = msgspec.structs.replace(SPARSE.design, run=name, design=name)
    read = Page(report(dataclasses.replace(SPARSE, design=design, title=name)))
    assert set(read.tags) == plain
    assert read.asked == []


# --- the plot of servos ---


@given(
    st.lists(st.tuples(st.floats(0, 50), st.floats(0, 1), st.booleans()), min_size=1, max_size=12), st.floats(0.1, 60)
)
@settings(max_examples=30, deadline=None)
def test_bars_and_limits_are_drawn_to_one_scale(needs: list[tuple[float, float, bool]], stall: float) -> None:
    bars = [Bar(f"joint_{i}", peak, share * peak, enough) for i, (peak, share, enough) in enumerate(needs)]
    drawn = servo_plot("torque", "N m", bars, [("stall", stall)])
    found = re.findall(r'<rect class="(bar[a-z ]*)" x=(\d+) y=\d+ width="([\d.]+)"', drawn)
    line = re.search(r'<path class=limit d="M([\d.]+) ', drawn)
    assert line is not None
    start = int(found[0][1])
    per_unit = (float(line[1]) - start) / stall
    for bar, (pale, full) in zip(bars, zip(found[::2], found[1::2], strict=True), strict=True):
        assert float(pale[2]) == pytest.approx(bar.peak * per_unit, abs=0.1 + 0.1 * bar.peak / stall)
        assert float(full[2]) == pytest.approx(bar.usual * per_unit, abs=0.1 + 0.1 * bar.usual / stall)
        assert ("bad" in pale[0], "bad" in full[0]) == (not bar.is_enough, not bar.is_enough)


@given(st.floats(1e-6, 1e6))
def test_an_axis_has_a_few_round_numbers_from_0_on(highest: float) -> None:
    found = ticks(highest)
    assert found[0] == 0
    assert 3 <= len(found) <= 6
    assert found[-1] <= highest * (1 + 1e-9)
