"""How long a run will still take, from iterations of uneven length and what comes beside some of them."""

import math
import random
from types import SimpleNamespace
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morph_core.catalogue import make_method
from morph_core.pace import Pace, Rest
from morph_core.state import State


@given(
    iterations=st.integers(12, 400),
    interval=st.integers(1, 60),
    evaluation=st.floats(0.0, 20.0),
    known=st.floats(0.9, 1.1),
    search=st.floats(0.0, 5.0),
    every=st.integers(1, 30),
    warm_up=st.floats(0.0, 20.0),
    jitter=st.floats(0.0, 0.05),
    seed=st.integers(0, 999),
)
def test_after_a_tenth_of_a_run_the_rest_is_known_within_a_fifth(
    iterations: int, interval: int, evaluation: float, known: float, search: float, every: int, warm_up: float,
    jitter: float, seed: int,
) -> None:  # fmt: skip
    rng, pace, done = random.Random(seed), Pace(), math.ceil(iterations / 10)
    every = min(every, done)  # a search that has never been is known to nobody

    def spread() -> float:
        return rng.uniform(1 - jitter, 1 + jitter)

    left, searches, evaluations = 0.0, 0, 0
    for i in range(1, iterations + 1):
        searched = i % every == 0
        searching = spread() * search * searched
        took = spread() + searching + warm_up * (i == 1)
        evaluated = i % interval == 0 or i == iterations
        evaluating = evaluation * spread() * evaluated
        if i > done:
            left, searches, evaluations = left + took + evaluating, searches + searched, evaluations + evaluated
            continue
        pace.took(took, 100, searching if searched else None)
        if evaluated:
            pace.evaluated(evaluating)
    expected = pace.left(iterations - done, searches, evaluations, expected=evaluation * known)
    assert expected == pytest.approx(left, rel=0.2)


def test_a_pace_that_changes_is_followed() -> None:
    pace = Pace()
    for took in (1.0,) * 50 + (3.0,) * 20:
        pace.took(took, 10)
        pace.evaluated(took)
    assert pace.left(10, evaluations=2) == pytest.approx(36.0)


def test_what_comes_seldom_is_counted_and_not_spread() -> None:
    pace = Pace()
    for took, searching in ((9.0, None), (1.0, None), (4.0, 3.0), (1.0, None), (4.0, 3.0)):
        pace.took(took, 10, searching)
    assert pace.left(10) == 10.0
    assert pace.left(10, searches=3) == 10 * 1.0 + 3 * 3.0
    assert pace.left(10, searches=3, evaluations=2, expected=5.0) == 29.0
    pace.evaluated(2.0)
    assert pace.left(10, searches=3, evaluations=2, expected=5.0) == 23.0
    assert pace.left(0, evaluations=0.5) == 1.0
    assert pace.left(10, searches=1, settled=4, alone=0.25) == 6 * 1.0 + 3.0 + 4 * 0.25
    assert pace.left(10, settled=4, alone=2.0) == 10.0


def test_before_the_first_iteration_nothing_is_known_and_after_it_something() -> None:
    pace = Pace()
    assert (pace.left(10), pace.env_steps) == (None, None)
    pace.took(2.0, 64)
    assert (pace.left(10), pace.env_steps) == (20.0, 64.0)
    assert pace.left(10, searches=2, evaluations=1, expected=3.0) == 23.0


@pytest.mark.parametrize(
    ("freeze_success", "budget", "seconds"), [(0.5, None, 54 * 3 + 36 * 0.25), (0.5, 9600, 90 * 3), (0.0, None, 90 * 3)]
)
def test_searches_are_expected_to_end_where_success_freezes_phi(
    freeze_success: float, budget: int | None, seconds: float
) -> None:
    settings = {"freeze_success": freeze_success, "design_interval": 1, "schedule.iterations": 100}
    state = SimpleNamespace(frozen=False, collected_in=0.0, learnt_in=0.25)
    rest = Rest(100, budget, final_episodes=0)
    rest.plan(make_method("morph", None, settings), 10)
    rest.pace.took(3.0, 64, searching=2.0)
    rest.take_in(cast(State, state))
    assert rest.seconds(10, 90) == pytest.approx(seconds)


def test_of_a_run_with_a_budget_as_many_iterations_are_left_as_its_steps_allow() -> None:
    rest = Rest(100, 1000, final_episodes=0)
    rest.plan(make_method("no_hw_opt", None, {"trajectories": 4}), 50)
    assert rest.iterations(0, 0) == 5  # of the longest episodes
    rest.pace.took(1.0, 100)
    assert (rest.iterations(1, 100), rest.iterations(1, 950), rest.iterations(9, 1100)) == (9, 1, 0)
    assert rest.iterations(98, 100) == 2
