"""The config refuses what makes no sense, in a sentence."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morph_core.config import Config, check_field, config_from


def test_defaults_are_allowed() -> None:
    assert config_from({}) == Config()


def test_settings_override_the_given_defaults() -> None:
    assert config_from({"alpha": 2}, Config(gamma=0.9)) == Config(gamma=0.9, alpha=2.0)


def test_unknown_field_lists_the_choices() -> None:
    with pytest.raises(ValueError, match=r"unknown config field \"alhpa\"; choose from: .*alpha"):
        config_from({"alhpa": 1.0})


def test_unknown_choice_lists_the_choices() -> None:
    with pytest.raises(ValueError, match='unknown projection "both"; choose from: none, one_sided, as_printed'):
        config_from({"projection": "both"})


@pytest.mark.parametrize(
    ("field", "value"),
    [("alpha", -1), ("gamma", 0), ("gamma", 1.5), ("trajectories", 0), ("trajectories", 7), ("epochs", 1.5),
     ("alpha", "1"), ("alpha", True), ("z_sigma", 0.0), ("search_population", 3), ("proxy_prefit", -1),
     ("drift_designs", 6), ("drift_designs", 0), ("drift_ridge", -0.1), ("drift_limit", 0.0), ("proxy_pairs", -1),
     ("utility", "rank"), ("search", "newton"), ("schedule_hold", 1.1), ("design_correlation", 1.1),
     ("design_correlation", -0.1)],
)  # fmt: skip
def test_values_out_of_range_are_refused(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=field):
        config_from({field: value})


@given(
    st.sampled_from(["alpha", "gamma", "z_sigma", "learning_rate"]), st.sampled_from([math.nan, math.inf, -math.inf])
)
def test_numbers_that_are_not_finite_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        check_field(field, value)
