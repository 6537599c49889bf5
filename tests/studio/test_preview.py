"""The first picture of a task."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from morph_core.catalogue import TASKS
from studio.preview import preview_svg

SVG = "{http://www.w3.org/2000/svg}"


def corners_of(element: ET.Element) -> np.ndarray:
    """Return the points (n, 2) that an element and what is in it are drawn from."""
    points: list[list[float]] = []
    for part in element.iter():
        numbers = {name: float(value) for name, value in part.attrib.items() if name in ("cx", "cy", "x1", "y1")}
        if part.tag == f"{SVG}circle":
            points.append([numbers["cx"], numbers["cy"]])
        elif part.tag == f"{SVG}line":
            points += [[numbers["x1"], numbers["y1"]], [float(part.attrib["x2"]), float(part.attrib["y2"])]]
        elif part.tag == f"{SVG}polygon":
            points += [[float(number) for number in pair.split(",")] for pair in part.attrib["points"].split()]
    return np.array(points)


@pytest.mark.parametrize("task", sorted(TASKS))
def test_the_preview_shows_every_part_inside_its_frame(task: str) -> None:
    picture = ET.fromstring(preview_svg(task))
    x, y, width, height = (float(number) for number in picture.attrib["viewBox"].split())
    parts = list(picture[0])
    assert len(parts) > 3
    for part in parts:
        corners = corners_of(part)
        assert (corners >= [x, -y - height]).all()
        assert (corners <= [x + width, -y]).all()


def test_the_reacher_is_seen_from_above_with_its_links_walls_goal_and_base() -> None:
    picture = ET.fromstring(preview_svg("reacher"))
    assert len(list(picture.iter(f"{SVG}line"))) == 5
    solids = list(picture[0].iter(f"{SVG}g"))[1:]
    assert len(solids) == 4 + 1 + 1
    _, _, width, height = (float(number) for number in picture.attrib["viewBox"].split())
    assert min(width, height) > 10  # m: nothing is foreshortened


@pytest.mark.parametrize("task", ["pen_press", "mouse_click"])
def test_a_hand_is_seen_from_the_side_over_its_table(task: str) -> None:
    parts = list(ET.fromstring(preview_svg(task))[0])
    table = corners_of(parts[0])
    fingers = [part for part in parts if part.tag == f"{SVG}line"]
    assert len(fingers) == 2 * TASKS[task].fingers
    assert np.ptp(table, 0).min() > 0.2  # painted first, and seen neither from above nor on edge
    assert np.ptp(table, 0)[1] < 0.8 * np.ptp(table, 0)[0]
    goal = next(part for part in parts if part.tag == f"{SVG}circle")
    assert float(goal.attrib["cy"]) > max(corners_of(finger)[:, 1].max() for finger in fingers)


def test_what_is_nearer_is_painted_later() -> None:
    parts = list(ET.fromstring(preview_svg("pen_press"))[0])
    heights = [corners_of(part)[:, 1].mean() for part in parts if part.tag == f"{SVG}line"]
    assert heights[0] > heights[-1]  # of fingers all as high, the nearest one is the lowest in the picture


def test_an_unknown_task_lists_the_choices() -> None:
    with pytest.raises(ValueError, match="choose from"):
        preview_svg("reach")
