"""Settings refuse what makes no sense, in a sentence that names the field."""

import math
import re
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morph_core.catalogue import configured
from morph_core.config import Settings
from morph_core.methods.proxy import Morph
from morph_core.parts import Ppo
from morph_core.searches.drift import Drift

MORPH, DRIFTING = Morph(), Morph(search=Drift())


def test_defaults_are_allowed() -> None:
    assert configured(MORPH, {}) == Morph()


def test_settings_override_the_given_defaults() -> None:
    changed = configured(Morph(ppo=Ppo(gamma=0.9)), {"alpha": 2})
    assert changed == Morph(ppo=Ppo(gamma=0.9), alpha=2.0)
    assert isinstance(changed.alpha, float)


def test_unknown_field_lists_the_choices() -> None:
    with pytest.raises(ValueError, match=r'unknown setting "alhpa" \(did you mean alpha\?\); choose from: .*alpha'):
        configured(MORPH, {"alhpa": 1.0})


def test_unknown_choice_lists_the_choices() -> None:
    with pytest.raises(ValueError, match='unknown projection "both"; choose from: none, one_sided, as_printed'):
        configured(MORPH, {"projection": "both"})


@pytest.mark.parametrize(
    ("method", "field", "value"),
    [(MORPH, "alpha", -1), (MORPH, "ppo.gamma", 0), (MORPH, "ppo.gamma", 1.5), (MORPH, "trajectories", 0),
     (MORPH, "trajectories", 7), (MORPH, "ppo.epochs", 1.5), (MORPH, "alpha", "1"), (MORPH, "alpha", True),
     (MORPH, "exploration.z_sigma", 0.0), (MORPH, "search.population", 3), (MORPH, "proxy.prefit", -1),
     (DRIFTING, "search.designs", 6), (DRIFTING, "search.designs", 0), (DRIFTING, "search.ridge", -0.1),
     (DRIFTING, "search.limit", 0.0), (MORPH, "proxy.pairs", -1), (MORPH, "exploration.utility", "rank"),
     (MORPH, "search", "newton"), (MORPH, "exploration.hold", 1.1), (MORPH, "exploration.correlation", 1.1),
     (MORPH, "exploration.correlation", -0.1)],
)  # fmt: skip
def test_values_out_of_range_are_refused(method: Morph, field: str, value: object) -> None:
    with pytest.raises(ValueError, match=rf"^(unknown )?{re.escape(field)} "):
        configured(method, {field: value})


@given(
    st.sampled_from(["alpha", "ppo.gamma", "exploration.z_sigma", "ppo.learning_rate"]),
    st.sampled_from([math.nan, math.inf, -math.inf]),
)
def test_numbers_that_are_not_finite_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(field)} must be finite"):
        configured(MORPH, {field: value})


def test_a_field_that_may_hold_anything_is_not_checked() -> None:
    @dataclass(frozen=True)
    class Loose(Settings):
        whatever: Any = None

    assert Loose([1]).whatever == [1]
