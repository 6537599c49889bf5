"""The first picture of a task."""

import xml.etree.ElementTree as ET

import pytest

from morph_core.tasks import TASKS
from studio.preview import preview_svg

SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize("task", sorted(TASKS))
def test_the_preview_shows_every_part_inside_its_frame(task: str) -> None:
    picture = ET.fromstring(preview_svg(task))
    x, y, width, height = (float(number) for number in picture.attrib["viewBox"].split())
    parts = list(picture[0])
    assert len(parts) > 3
    for part in picture.iter(f"{SVG}circle"):
        assert x <= float(part.attrib["cx"]) <= x + width
        assert y <= -float(part.attrib["cy"]) <= y + height
    for part in picture.iter(f"{SVG}line"):
        assert x <= float(part.attrib["x1"]) <= x + width


def test_the_reacher_has_its_links_walls_and_goal() -> None:
    picture = ET.fromstring(preview_svg("reacher"))
    assert len(list(picture.iter(f"{SVG}line"))) == 5
    assert len(list(picture.iter(f"{SVG}g"))) == 1 + 4
    assert len(list(picture.iter(f"{SVG}circle"))) == 2


def test_an_unknown_task_lists_the_choices() -> None:
    with pytest.raises(ValueError, match="choose from"):
        preview_svg("reach")
