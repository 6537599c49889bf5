"""Every attack with small counts: `python -m tests.attack --full` has those of a release."""

import pytest

from tests.attack.__main__ import PARTS, SMALL
from tests.attack.kills import lost
from tests.attack.outcome import Outcome, table
from tests.attack.soak import slope
from tests.studio.conftest import progress


@pytest.mark.slow
@pytest.mark.parametrize("part", [part for part in PARTS if part != "api"])  # test_api has what is quick of it
def test_an_attack_finds_nothing(part: str) -> None:
    outcome = PARTS[part](SMALL[part], 7)
    assert not outcome.failed, table([outcome])


def test_a_slope_is_that_of_a_line_after_the_warm_up() -> None:
    hours = [i / 100 for i in range(101)]
    rise, error, width = slope([(x, 100 + (50 * x if x < 0.05 else 2.5) + 0.5 * x) for x in hours])
    assert rise == pytest.approx(0.5)
    assert error < 1e-9
    assert width == pytest.approx(11 / 12, abs=0.01)


def test_an_event_that_is_gone_or_elsewhere_is_lost() -> None:
    events = [progress(i) for i in (1, 2, 3)]
    assert lost(events, [*events, progress(4)]) == []
    assert len(lost(events, events[:2])) == 1
    assert lost(events, events[::-1]) == ["out of order"]


def test_an_attack_that_tried_too_little_has_failed() -> None:
    outcome = Outcome("part", 10, "tries", 0, quiet=True)
    outcome.add(9)
    assert "only 9 of 10 tries" in outcome.end().faults[0]
