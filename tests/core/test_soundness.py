"""What is NaN, infinite or too large to learn from is named in the iteration in which it occurs, and never kept."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from morph_core.history import History
from morph_core.run_folder import RunFolder
from morph_core.search import Physics
from morph_core.soundness import LARGEST, check_steps
from morph_core.state import State
from morph_core.tasks.reacher import Reacher
from morph_core.train import Trainer
from tests.core.conftest import make_run
from tests.core.test_undo import run


def in_phi(value: float) -> Callable[[State], None]:
    return lambda state: state.phi.__setitem__(1, value)


def in_weights(module: str, value: float) -> Callable[[State], None]:
    def damage(state: State) -> None:
        with torch.no_grad():
            next(state.modules[module].parameters()).view(-1)[0] = value

    return damage


def in_moments(optimizer: str, value: float) -> Callable[[State], None]:
    return lambda state: next(iter(state.optimizers[optimizer].state.values()))["exp_avg"].view(-1)[:1].fill_(value)


IN_A_STEP = {
    "reward": (math.nan, "the reward became NaN in step 1"),
    "z": (-math.inf, "the hardware's output z became infinite in step 1"),
    "s": (1e308, "the state s became 1e+308, beyond 1e+15 in step 2"),
    "a": (math.nan, "the executed action a became NaN in step 1"),
    "reward_terms": (math.inf, "the term bonus of the reward became infinite in step 1"),
}
IN_THE_STATE = {
    "phi": (in_phi(math.nan), "the design phi left its box: link_2 must be finite, not nan"),
    "phi far outside": (in_phi(1e308), "the design phi left its box: link_2 must lie inside [0.05, 5] m, not 1e+308"),
    "policy": (in_weights("policy", math.nan), "a weight of policy became infinite or NaN"),
    "proxy": (in_weights("proxy", math.inf), "a weight of proxy became infinite or NaN"),
    "Adam": (in_moments("control", math.nan), "what Adam remembers of the gradients of control became"),
    "Adam of the proxy": (in_moments("proxy", math.inf), "what Adam remembers of the gradients of proxy became"),
}


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_run(tmp_path, iterations=4)


def after_two(monkeypatch: pytest.MonkeyPatch, act: Callable[[State], None]) -> None:
    """Let something happen to a trainer's state before its third iteration."""
    obey = Trainer._obey

    def at_the_second(self: Trainer, state: State) -> None:
        if state.iteration == 2:
            act(state)
        obey(self, state)

    monkeypatch.setattr(Trainer, "_obey", at_the_second)


def fails_and_goes_on(folder: RunFolder, monkeypatch: pytest.MonkeyPatch, words: str) -> None:
    assert run(folder) == 1
    history = History(folder)
    assert (history.status, history.iteration) == ("failed", 2)
    assert history.message.startswith(words)
    assert history.message.endswith(", in iteration 3")
    assert "TypeError" not in history.message
    monkeypatch.undo()
    assert run(folder) == 0
    history = History(folder)
    assert (history.status, history.iteration) == ("finished", 4)
    for progress in history.progress:
        history.design_space.check(progress.phi)


@pytest.mark.parametrize("field", IN_A_STEP)
def test_what_a_step_gives_is_named(folder: RunFolder, monkeypatch: pytest.MonkeyPatch, field: str) -> None:
    value, words = IN_A_STEP[field]
    step, armed = Reacher.step, []

    def damaged(self: Reacher, hardware, s, action):
        transition = step(self, hardware, s, action)
        if not armed:
            return transition
        if field == "reward_terms":
            return dataclasses.replace(transition, reward_terms={"bonus": np.full_like(transition.reward, value)})
        wrong = np.array(getattr(transition, field))
        wrong[0] = value
        return dataclasses.replace(transition, **{field: wrong})

    monkeypatch.setattr(Reacher, "step", damaged)
    after_two(monkeypatch, armed.append)
    fails_and_goes_on(folder, monkeypatch, words)


@pytest.mark.parametrize("place", IN_THE_STATE)
def test_what_a_state_holds_is_named(folder: RunFolder, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    damage, words = IN_THE_STATE[place]
    after_two(monkeypatch, damage)
    fails_and_goes_on(folder, monkeypatch, words)


def test_a_search_whose_every_simulation_diverges_leaves_phi_where_it_is(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Physics, "costs", lambda _, _dataset, designs: np.full(len(designs), np.inf))
    assert run(folder) == 0
    history = History(folder)
    assert {tuple(progress.phi) for progress in history.progress} == {tuple(history.initial_phi)}


@given(
    arrays(float, (3, 2, 2), elements=st.floats(-LARGEST, LARGEST)),
    st.integers(0, 2), st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -2e15]),
)  # fmt: skip
def test_only_steps_alive_count_and_the_first_is_named(values: np.ndarray, step: int, value: float) -> None:
    alive = np.ones((3, 2), dtype=bool)
    wrong = values.copy()
    wrong[step, 1, 0] = value
    check_steps({"z": values}, alive)
    with pytest.raises(FloatingPointError, match=rf"^z became .* in step {step + 1} of"):
        check_steps({"s": values, "z": wrong, "reward": wrong[..., 0]}, alive)
    alive[step:, 1] = False
    check_steps({"z": wrong}, alive)
