"""Aggregate scores: the numbers of rliable, and what must hold for any scores."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from studio.study.report import scores
from studio.study.report.scores import AGGREGATES, aggregates, estimate, improvement, iqm, mean, median

A = np.round(np.random.default_rng(0).random((10, 2)), 2).T
B = np.round(np.random.default_rng(1).random((8, 2)), 2).T ** 2
SHARES = st.lists(st.floats(0, 1), min_size=1, max_size=6)


@pytest.mark.parametrize(
    ("strata", "values", "lows", "highs"),
    [
        (A, [0.559, 0.5125, 0.5125, 0.4875], [0.346, 0.3815, 0.3815, 0.355], [0.73, 0.645, 0.645, 0.6185]),
        (B, [0.2591, 0.3373, 0.3373, 0.6627], [0.1408, 0.2033, 0.2033, 0.5179], [0.4784, 0.4821, 0.4821, 0.7967]),
    ],
)
def test_aggregates_are_those_of_rliable(strata: np.ndarray, values: list, lows: list, highs: list) -> None:
    """What rliable 1.2.0 gave for the same scores with 20,000 resamples."""
    found = list(aggregates(list(strata)).values())
    assert [one.value for one in found] == pytest.approx(values, abs=1e-4)
    assert [one.low for one in found] == pytest.approx(lows, abs=0.02)
    assert [one.high for one in found] == pytest.approx(highs, abs=0.02)


def test_the_probability_of_improvement_is_that_of_rliable() -> None:
    found = improvement(list(A), list(B))
    assert found.value == pytest.approx(0.66875)
    assert (found.low, found.high) == pytest.approx((0.49984, 0.83125), abs=0.02)


def test_each_task_is_resampled_on_its_own() -> None:
    found = estimate([[0.0] * 5, [1.0] * 5], mean)
    assert (found.low, found.value, found.high) == (0.5, 0.5, 0.5)


def test_a_single_task_has_the_median_of_its_seeds_and_several_that_of_their_means() -> None:
    assert median(np.array([0.0, 0.0, 1.0])) == 0
    assert median(np.array([0.0, 0.0, 0.9]), np.array([0.5]), np.array([1.0])) == 0.5


def test_the_interquartile_mean_leaves_out_a_quarter_at_both_ends() -> None:
    assert iqm(np.array([-100.0, 1.0, 2.0, 100.0])) == 1.5


def test_one_seed_has_no_interval_and_none_no_value() -> None:
    one, none = estimate([[0.5]], iqm), estimate([[]], iqm)
    assert one.value == 0.5
    assert np.isnan([one.low, one.high, none.value]).all()


def test_ties_count_half() -> None:
    assert improvement([[1.0, 1.0]], [[1.0, 1.0]]).value == 0.5


def test_variants_on_different_tasks_cannot_be_compared() -> None:
    with pytest.raises(ValueError, match="same tasks"):
        improvement([[1.0]], [[1.0], [0.0]])


def test_the_intervals_are_the_same_each_time() -> None:
    assert aggregates(list(A)) == aggregates(list(A))


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    if hasattr(request.function, "hypothesis"):
        monkeypatch.setattr(scores, "RESAMPLES", 100)


@settings(max_examples=40)
@given(st.lists(SHARES, min_size=1, max_size=3))
def test_every_aggregate_lies_between_zero_and_one_and_in_its_interval(strata: list[list[float]]) -> None:
    found = aggregates(strata)
    assert tuple(found) == AGGREGATES
    for one in found.values():
        assert -1e-9 <= one.value <= 1 + 1e-9
        assert not one.low > one.high


@settings(max_examples=40)
@given(SHARES, SHARES)
def test_one_of_two_variants_is_better_or_they_tie(x: list[float], y: list[float]) -> None:
    assert improvement([x], [y]).value + improvement([y], [x]).value == pytest.approx(1)


@settings(max_examples=40)
@given(SHARES, st.floats(0.001, 1))
def test_a_variant_with_more_on_every_seed_has_more_of_everything(x: list[float], more: float) -> None:
    better = [one + more for one in x]
    assert improvement([better], [x]).value >= 0.5
    below, above = aggregates([x]), aggregates([[min(1.0, one) for one in better]])
    assert all(above[name].value >= below[name].value - 1e-9 for name in AGGREGATES[:3])
    assert above["optimality gap"].value <= below["optimality gap"].value + 1e-9
