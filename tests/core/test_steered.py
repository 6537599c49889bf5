"""A user's commands in a state: what they put in force, what must begin again, and what goes on as it was."""

import itertools
from typing import Any

import numpy as np
import pytest

from morph_core.protocol import InjectDesign, Lock, SetAlpha, SetBound, SetProjection, Unlock
from morph_core.state import State, start
from morph_core.train import apply_edit
from tests.core.scales import TINY, Scales


@pytest.fixture
def state() -> State:
    """Return a state at phi = (2, 2) whose proxy is fitted and whose phi is frozen."""
    state = start(Scales(), TINY, 0)
    state.fitted = state.frozen = True
    return state


def in_force(state: State) -> tuple[Any, ...]:
    return state.alpha, state.projection, state.phi.tolist(), state.design_space


def test_alpha_and_projection_are_put_in_force_and_disturb_nothing(state: State) -> None:
    space = state.design_space
    apply_edit(SetAlpha(3.5), state, Scales())
    assert in_force(state) == (3.5, "none", [2.0, 2.0], space)
    apply_edit(SetProjection("as_printed"), state, Scales())
    assert in_force(state) == (3.5, "as_printed", [2.0, 2.0], space)
    assert (state.fitted, state.frozen) == (True, True)


@pytest.mark.parametrize(
    ("command", "phi", "fitted"),
    [
        (SetBound("first", 1.0, 4.0), [2.0, 2.0], True),
        (SetBound("first", 3.0, 4.0), [3.0, 2.0], False),
        (Lock("first"), [2.0, 2.0], True),
        (Lock("first", 5.0), [5.0, 2.0], False),
        (Unlock("first"), [2.0, 2.0], True),
        (InjectDesign([2.0, 2.0]), [2.0, 2.0], True),
        (InjectDesign([5.0, 6.0]), [5.0, 6.0], False),
    ],
)
def test_an_edit_of_the_design_thaws_phi_and_the_proxy_is_fitted_again_where_phi_moved(
    state: State, command: Any, phi: list[float], fitted: bool
) -> None:
    apply_edit(command, state, Scales())
    assert state.phi.tolist() == phi
    assert (state.fitted, state.frozen) == (fitted, False)


def test_bounds_and_locks_are_put_in_force_and_lifted(state: State) -> None:
    before = state.design_space
    apply_edit(SetBound("first", 1.0, 4.0), state, Scales())
    assert state.design_space == before.with_bound("first", 1.0, 4.0)
    apply_edit(Lock("second", 3.0), state, Scales())
    assert state.design_space == before.with_bound("first", 1.0, 4.0).with_lock("second", 3.0)
    apply_edit(Unlock("second"), state, Scales())
    assert state.design_space == before.with_bound("first", 1.0, 4.0)


@pytest.mark.parametrize(
    "command",
    [
        SetAlpha(-1.0), SetAlpha(float("nan")), SetProjection("sideways"),  # pyright: ignore[reportArgumentType]
        SetBound("first", 4.0, 1.0), SetBound("third", 0.0, 1.0), Lock("first", 99.0), InjectDesign([1.0]),
        InjectDesign([11.0, 2.0]), SetBound("first", 11.0, 12.0), Lock("first", 11.0),  # these can't be built
    ],
)  # fmt: skip
def test_what_is_refused_changes_nothing(state: State, command: Any) -> None:
    before = in_force(state)
    with pytest.raises(ValueError, match=r"must|needed|unknown"):
        apply_edit(command, state, Scales())
    assert in_force(state) == before
    assert (state.fitted, state.frozen) == (True, True)


def test_what_is_in_force_is_obeyed_by_the_next_iteration(state: State) -> None:
    iterations = TINY.iterations(Scales(), state)
    apply_edit(SetAlpha(7.0), state, Scales())
    apply_edit(SetProjection("one_sided"), state, Scales())
    apply_edit(SetBound("first", 2.5, 2.6), state, Scales())
    apply_edit(Lock("second", 3.0), state, Scales())
    for progress in itertools.islice(iterations, 3):
        assert (progress.alpha, progress.projection, progress.phi[1]) == (7.0, "one_sided", 3.0)
        assert 2.5 <= progress.phi[0] <= 2.6
        assert state.explored is not None
        assert np.all((state.explored[:, 0] >= 2.5) & (state.explored[:, 0] <= 2.6))
