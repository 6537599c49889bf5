"""Form, API and command line draw the same line for the numbers of a new run."""

from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from conftest import Page

from studio import limits
from studio.api.messages import ResumeRun
from studio.new_run import StartRun, prepare_run

NUMBERS = {"seed": (0, limits.LARGEST_SEED), "iterations": (1, limits.MAX_ITERATIONS)}


def taken(ask: Callable[[], object]) -> bool:
    try:
        ask()
    except (ValueError, msgspec.ValidationError):
        return False
    return True


@pytest.mark.parametrize("name", list(NUMBERS))
def test_the_same_numbers_are_taken_at_every_door(page: Page, tmp_path: Path, name: str) -> None:
    lowest, largest = NUMBERS[name]
    handle = getattr(page.viewer.start, name)
    for value, allowed in ((lowest, True), (largest, True), (lowest - 1, False), (largest + 1, False), (1.5, False)):
        handle._impl.value = value
        assert taken(page.viewer.start.request) is allowed
        assert taken(lambda value=value: prepare_run(tmp_path, StartRun(task="reacher", **{name: value}))) is allowed
        assert taken(lambda value=value: msgspec.convert({"task": "reacher", name: value}, StartRun)) is allowed
    assert taken(lambda: msgspec.convert({"further": limits.MAX_ITERATIONS}, ResumeRun))
    assert (handle._impl.props.min, handle._impl.props.max) == (lowest, largest)


@pytest.mark.parametrize("value", [True, None, "7", float("nan"), float("inf"), 10**400, -0.5, [1]])
def test_what_is_no_whole_number_in_the_range_is_refused_in_words(value: object) -> None:
    with pytest.raises(ValueError, match=f"^seed must be a whole number from 0 to {limits.LARGEST_SEED}, not "):
        limits.seed(value)


def test_a_whole_number_that_comes_as_a_float_becomes_one() -> None:
    assert repr(limits.seed(7.0)) == "7"
