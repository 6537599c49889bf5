"""The design space keeps phi in its box, and says what is allowed."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from morph_core.catalogue import make_task
from morph_core.design import DesignSpace
from morph_core.protocol import Parameter

SPACE = DesignSpace(
    (
        Parameter("length", "m", 0.1, 2.0, 1.0, hard_lo=0.1, hard_hi=2.0),
        Parameter("angle", "rad", -1.0, 1.0, 0.0, hard_lo=-3.0, hard_hi=3.0),
    )
)
numbers = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(numbers.filter(lambda x: not math.isnan(x)), min_size=2, max_size=2))
def test_clip_always_lands_in_the_box(phi: list[float]) -> None:
    inside = SPACE.clip(np.array(phi))
    assert (inside >= SPACE.lo).all()
    assert (inside <= SPACE.hi).all()


@given(numbers, numbers)
def test_a_bound_is_taken_exactly_when_it_makes_sense(lo: float, hi: float) -> None:
    if math.isfinite(lo) and math.isfinite(hi) and -3 <= lo < hi <= 3:
        assert SPACE.with_bound("angle", lo, hi).parameters[1].lo == lo
    else:
        with pytest.raises(ValueError, match="angle"):
            SPACE.with_bound("angle", lo, hi)


@given(numbers)
def test_a_lock_is_taken_exactly_inside_the_bounds(value: float) -> None:
    if -1 <= value <= 1:
        locked = SPACE.with_lock("angle", value)
        assert locked.clip(np.array([1.0, 9.0]))[1] == value
        assert locked.free.tolist() == [True, False]
        assert locked.without_lock("angle") == SPACE
    else:
        with pytest.raises(ValueError, match="angle"):
            SPACE.with_lock("angle", value)


def test_a_bound_that_excludes_a_lock_is_refused() -> None:
    with pytest.raises(ValueError, match="unlock it first"):
        SPACE.with_lock("angle", 0.5).with_bound("angle", -1.0, 0.0)


def test_edits_leave_the_original_alone() -> None:
    SPACE.with_bound("length", 0.5, 1.5)
    assert SPACE.lo[0] == 0.1


def test_the_initial_design_respects_bounds_and_locks() -> None:
    assert SPACE.with_bound("length", 1.5, 2.0).with_lock("angle", 0.3).initial.tolist() == [1.5, 0.3]


def test_unknown_names_list_the_choices() -> None:
    with pytest.raises(ValueError, match=r'did you mean "length"\?.*choose from: length, angle'):
        SPACE.index("lenght")


@pytest.mark.parametrize("phi", [[1.0], [1.0, 0.0, 0.0], [1.0, math.nan], [5.0, 0.0]])
def test_check_refuses_what_is_no_design(phi: list[float]) -> None:
    with pytest.raises(ValueError, match=r"phi|angle|length"):
        SPACE.check(phi)


def test_the_whole_space_is_the_tasks_own_box_with_nothing_locked() -> None:
    space = make_task("reacher").design_space.with_bound("link_1", 2.0, 3.0).with_lock("link_2", 1.0)
    whole = space.whole
    assert np.array_equal([whole.lo, whole.hi], space.hard_box)
    assert whole.free.all()
    assert whole.initial[0] == 3.0
    assert not space.free.all()
