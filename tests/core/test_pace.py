"""How long a run will still take, from iterations of uneven length."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morph_core.pace import Pace


@given(
    iterations=st.integers(100, 400),
    search=st.floats(0.0, 5.0),
    every=st.integers(5, 10),
    evaluation=st.floats(0.0, 1.0),
    warm_up=st.floats(0.0, 20.0),
    jitter=st.floats(0.0, 0.2),
    seed=st.integers(0, 999),
)
def test_after_a_tenth_of_a_run_the_rest_is_known_within_a_fifth(
    iterations: int, search: float, every: int, evaluation: float, warm_up: float, jitter: float, seed: int
) -> None:
    rng, pace = random.Random(seed), Pace()
    seconds = [
        rng.uniform(1 - jitter, 1 + jitter) + warm_up * (i == 1) + search * (i % every == 0) + evaluation * (i % 5 == 0)
        for i in range(1, iterations + 1)
    ]
    done = iterations // 10
    for took in seconds[:done]:
        pace.took(took, 100)
    assert pace.left(iterations - done) == pytest.approx(sum(seconds[done:]), rel=0.2)


def test_a_pace_that_changes_is_followed() -> None:
    pace = Pace()
    for took in (1.0,) * 50 + (3.0,) * 20:
        pace.took(took, 10)
    assert pace.left(10) == pytest.approx(30.0)


def test_before_the_first_iteration_nothing_is_known_and_after_it_something() -> None:
    pace = Pace()
    assert (pace.left(10), pace.env_steps) == (None, None)
    pace.took(2.0, 64)
    assert (pace.left(10), pace.env_steps) == (20.0, 64.0)
