"""phi climbs the critic: the window that designs are drawn from, the step of phi, and what becomes of both in a run."""

import dataclasses
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from morph_core.checkpoint import load_checkpoint, save_checkpoint
from morph_core.design import DesignSpace
from morph_core.history import History
from morph_core.methods.value_gradient import ValueGradient, Window, ascended, designs_in_window
from morph_core.parts import Schedule
from morph_core.protocol import InjectDesign, Lock, Progress, SetBound, Unlock
from morph_core.rollout import Rollout
from morph_core.state import State, start
from morph_core.train import Trainer, apply_edit
from tests.core.conftest import make_run, small_method
from tests.core.scales import TINY, Scales, linear, plain

PEER = ValueGradient(trajectories=4, hidden=4, ppo=TINY.ppo, schedule=Schedule(11), wait=0.0, freeze_success=0.0)
WIDE = Scales(largest=20.0)
"""Two scales of which every design in the box can be built."""
SPACE = WIDE.design_space  # [-20, 20] each
INSIDE = st.lists(st.floats(-20, 20), min_size=2, max_size=2).map(np.array)


def run(iterations: int, state: State, task: Scales = WIDE, method: ValueGradient = PEER) -> list[Progress]:
    return list(itertools.islice(method.iterations(task, state), iterations))


def begun(method: ValueGradient = PEER, space: DesignSpace | None = None, seed: int = 0) -> State:
    return start(WIDE, method, seed, space)


def with_critic(slope: list[float], method: ValueGradient = PEER) -> State:
    """Return a state whose critic is V = slope . phi seen, and stays so."""
    state = begun(method)
    state.control.critic.value = linear([[0.0, *slope, 0.0]], [0.0])  # pyright: ignore[reportAttributeAccessIssue]
    state.control.optimizer = plain(state.control.policy.parameters())
    return state


def drawn(width: float, phi: list[float], count: int = 4000, space: DesignSpace = SPACE) -> np.ndarray:
    state = begun(space=space)
    state.phi = np.array(phi)
    return designs_in_window(WIDE, state, width, count)


# --- the window ---


def test_the_first_window_is_the_whole_box() -> None:
    designs = drawn(1.0, [15.0, 2.0])
    assert designs.mean(0) == pytest.approx([0.0, 0.0], abs=1e-9)  # antithetic pairs about its middle
    assert designs.std(0) == pytest.approx(np.full(2, 40 / np.sqrt(12)), rel=0.03)
    assert designs.min() < -19.9
    assert designs.max() > 19.9


def test_a_narrower_one_lies_round_phi() -> None:
    designs = drawn(0.25, [5.0, -3.0])  # 10 wide
    assert designs.mean(0) == pytest.approx([5.0, -3.0], abs=1e-9)
    assert designs.min(0) == pytest.approx([0.0, -8.0], abs=0.1)
    assert designs.max(0) == pytest.approx([10.0, 2.0], abs=0.1)


def test_where_the_box_ends_it_lies_beside_phi_and_is_as_wide() -> None:
    designs = drawn(0.25, [20.0, -18.0])
    assert designs.min(0) == pytest.approx([10.0, -20.0], abs=0.1)
    assert designs.max(0) == pytest.approx([20.0, -10.0], abs=0.1)


def test_designs_come_in_antithetic_pairs() -> None:
    first, second = np.split(drawn(0.5, [4.0, 6.0], 10), 2)
    assert first + second == pytest.approx(np.tile([8.0, 12.0], (5, 1)))
    assert np.unique(first.round(6)).size == 10


def test_a_window_without_width_is_phi() -> None:
    assert drawn(0.0, [4.0, 6.0], 4).tolist() == [[4.0, 6.0]] * 4


@given(width=st.floats(0, 1), phi=INSIDE, lo=st.floats(-20, 10), held=st.floats(-20, 20))
def test_designs_stay_inside_an_edited_box_and_keep_its_locks(
    width: float, phi: np.ndarray, lo: float, held: float
) -> None:
    space = SPACE.with_bound("first", lo, lo + 10).with_lock("second", held)
    designs = drawn(width, space.clip(phi).tolist(), 6, space)
    assert ((lo <= designs[:, 0]) & (designs[:, 0] <= lo + 10)).all()
    assert (designs[:, 1] == held).all()
    assert np.ptp(designs[:, 0]) <= width * 10 + 1e-9


def test_designs_that_cant_be_built_are_drawn_back_towards_phi() -> None:
    state = begun()
    designs = designs_in_window(Scales(largest=5.0), state, 1.0, 200)
    state = begun()
    wanted = designs_in_window(WIDE, state, 1.0, 200)
    bad = wanted[:, 0] > 5.0
    assert 50 < bad.sum() < 150
    assert (designs[:, 0] <= 5.0).all()
    assert designs[~bad].tolist() == wanted[~bad].tolist()
    share = (designs[bad] - 2.0) / (wanted[bad] - 2.0)  # the initial phi is (2, 2)
    assert set(share.ravel().round(9)) <= {0.5, 0.25, 0.125}


def test_the_window_narrows_geometrically_after_it_was_held() -> None:
    window = Window(width=0.8, width_end=0.05, hold=0.2)
    widths = [window.at(Schedule(11), iteration) for iteration in (1, 3, 5, 7, 9, 11, 50)]
    assert widths == pytest.approx([0.8, 0.8, 0.4, 0.2, 0.1, 0.05, 0.05])


def test_each_iterations_designs_are_drawn_from_its_window() -> None:
    method = dataclasses.replace(PEER, trajectories=400, step=0.0, designs=Window(1.0, 0.1, 0.0))
    state = begun(method)
    spans = []
    for _ in itertools.islice(method.iterations(WIDE, state), 11):
        assert state.explored is not None
        spans.append(np.ptp(state.explored[:, 1]))
    assert spans[0] == pytest.approx(40.0, rel=0.02)
    assert spans[5] == pytest.approx(40.0 * 0.1**0.5, rel=0.02)
    assert spans[10] == pytest.approx(4.0, rel=0.02)


# --- the slope ---


class Bent(nn.Module):
    """A critic V = observation * first^2 * (1 - t) + second, of what is seen of phi."""

    def forward(self, told: Tensor) -> Tensor:
        observation, first, second, time = told.T
        return (observation * first**2 * (1 - time) + second)[:, None]


def test_the_slope_of_a_linear_critic_is_its_weights_in_units_of_phi() -> None:
    state = with_critic([3.0, -4.0])
    slope = state.control.value_slope(np.ones((5, 1), np.float32), np.array([7.0, 1.0]))
    assert slope == pytest.approx([3 / 20, -4 / 20])  # phi is seen from -1 to 1, over 40


def test_the_slope_is_that_at_phi_averaged_over_the_start_states() -> None:
    state = begun()
    state.control.critic.value = Bent()  # pyright: ignore[reportAttributeAccessIssue]
    observation = np.array([[1.0], [2.0], [6.0]], np.float32)
    slope = state.control.value_slope(observation, np.array([10.0, 0.0]))
    assert slope == pytest.approx([3.0 * 2 * 0.5 / 20, 1 / 20])  # at the start, where t is 0


def test_asking_for_the_slope_leaves_the_critic_as_it_is() -> None:
    state = begun()
    state.control.value_slope(np.ones((3, 1), np.float32), np.zeros(2))
    assert all(parameter.grad is None for parameter in state.control.critic.parameters())


# --- the step ---


def test_a_step_goes_up_the_slope_in_shares_of_each_range() -> None:
    space = SPACE.with_bound("second", -5.0, 5.0)  # 40 and 10 wide: the slopes by share are 30 and 40
    phi = ascended(space, np.array([1.0, 2.0]), np.array([0.75, 4.0]), 0.1)
    length = 0.1 * np.sqrt(2)
    assert phi == pytest.approx([1.0 + 0.6 * length * 40, 2.0 + 0.8 * length * 10])


def test_its_length_is_the_same_whatever_the_slope() -> None:
    steps = [ascended(SPACE, np.zeros(2), scale * np.array([1.0, -2.0]), 0.05) for scale in (1e-6, 1.0, 1e6)]
    assert np.linalg.norm(steps, axis=1) == pytest.approx(np.full(3, 0.05 * 40 * np.sqrt(2)), rel=1e-4)


def test_without_a_slope_phi_stays() -> None:
    assert ascended(SPACE, np.array([1.0, 2.0]), np.zeros(2), 0.1).tolist() == [1.0, 2.0]


def test_what_is_locked_neither_moves_nor_shortens_the_step() -> None:
    space = SPACE.with_lock("second", 3.0)
    assert ascended(space, np.array([1.0, 3.0]), np.array([0.1, 9.0]), 0.1) == pytest.approx([5.0, 3.0])


@pytest.mark.parametrize(("at", "sign"), [(20.0, 1.0), (-20.0, -1.0)])
def test_what_stands_at_its_bound_does_not_shorten_the_step(at: float, sign: float) -> None:
    phi = ascended(SPACE, np.array([at, 0.0]), np.array([9.0 * sign, 0.1]), 0.1)
    assert phi == pytest.approx([at, 0.1 * np.sqrt(2) * 40])
    assert ascended(SPACE, np.array([at, 0.0]), np.array([-sign, 0.0]), 0.1)[0] == pytest.approx(
        at - sign * 0.1 * np.sqrt(2) * 40
    )


@given(phi=INSIDE, slope=INSIDE, step=st.floats(0, 2))
def test_a_step_stays_inside_the_box_and_is_never_longer(phi: np.ndarray, slope: np.ndarray, step: float) -> None:
    after = ascended(SPACE, phi, slope, step)
    assert (np.abs(after) <= 20).all()
    assert np.linalg.norm(after - phi) <= step * 40 * np.sqrt(2) + 1e-9
    assert (after - phi) @ slope >= 0


# --- a run ---


def test_phi_takes_one_step_an_iteration_and_the_steps_fall() -> None:
    method = dataclasses.replace(PEER, step=0.02, step_end=0.25)
    state = with_critic([1.0, 1.0], method)
    path = np.array([[2.0, 2.0], *[p.phi for p in run(12, state, method=method)]])
    steps = np.diff(path, axis=0)
    assert steps[:, 0] == pytest.approx(steps[:, 1])
    assert steps[[0, 5, 10, 11], 0] == pytest.approx([0.8, 0.4, 0.2, 0.2])


def test_phi_waits_for_the_critic() -> None:
    method = dataclasses.replace(PEER, wait=0.3)
    phi = [p.phi for p in run(5, with_critic([1.0, 1.0], method), method=method)]
    assert phi[:3] == [[2.0, 2.0]] * 3  # shares 0, .1, .2 of ten
    assert phi[3][0] > 2.0


def test_phi_waits_for_a_critic_that_has_started_afresh() -> None:
    method = dataclasses.replace(PEER, wait=0.3)
    state = with_critic([1.0, 1.0], method)
    state.control_start = 2
    phi = [p.phi for p in run(6, state, method=method)]
    assert phi[:5] == [[2.0, 2.0]] * 5
    assert phi[5][0] > 2.0


def test_the_slope_is_taken_at_the_present_phi_and_the_start_states_of_the_iteration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    state = begun()
    asked: list[tuple[list[object], list[float]]] = []

    def noted(observation: np.ndarray, phi: np.ndarray) -> np.ndarray:
        asked.append((observation.tolist(), phi.tolist()))
        return np.ones(2)

    monkeypatch.setattr(state.control, "value_slope", noted)
    run(1, state)
    assert asked == [([[1.0]] * 4, [2.0, 2.0])]


def test_a_step_that_cant_be_built_is_halved() -> None:
    task = Scales(largest=2.7)
    method = dataclasses.replace(PEER, step=0.02)
    assert run(1, with_critic([1.0, 1.0], method), task, method)[0].phi == pytest.approx([2.4, 2.4])  # .8 is too far


def test_every_episode_sees_the_design_that_it_runs_on(monkeypatch: pytest.MonkeyPatch) -> None:
    state = begun()
    rollouts: list[Rollout] = []
    learn = state.control.learn
    monkeypatch.setattr(state.control, "learn", lambda *given: rollouts.append(given[1]) or learn(*given))
    run(1, state)
    assert state.explored is not None
    assert np.unique(state.explored, axis=0).shape == (4, 2)
    for step in rollouts[0].observation:
        assert step[:, 1:] == pytest.approx(state.explored / 20, abs=1e-6)
    assert rollouts[0].z[0] == pytest.approx(state.explored)


def test_a_better_design_is_found() -> None:
    method = dataclasses.replace(PEER, trajectories=32, hidden=16, schedule=Schedule(40), step=0.05)
    assert sum(run(40, begun(method), method=method)[-1].phi) > 35  # of 40; the initial design has 4


def test_phi_is_frozen_on_success_and_every_episode_runs_on_it() -> None:
    method = dataclasses.replace(PEER, freeze_success=0.5)
    state = with_critic([1.0, 1.0], method)
    task = Scales(largest=20.0, ends=2, succeeding=0.5)
    phi = [p.phi for p in run(3, state, task, method)]
    assert state.frozen
    assert phi[0] != [2.0, 2.0]
    assert phi[1:] == [phi[0]] * 2
    assert state.explored is not None
    assert state.explored.tolist() == [phi[0]] * 4


def test_with_no_success_to_freeze_at_it_never_freezes() -> None:
    state = begun()
    run(2, state, Scales(largest=20.0, ends=2))
    assert not state.frozen


def test_where_every_simulation_diverges_phi_stays() -> None:
    @dataclass(frozen=True)
    class Broken(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return super().hw_phy(np.full(2, np.nan))

    state = with_critic([1.0, 1.0])
    assert [p.phi for p in run(2, state, Broken(largest=20.0))] == [[2.0, 2.0]] * 2
    assert state.diverged == 2 * 4


# --- edits ---


def test_bounds_and_locks_are_obeyed_from_the_next_iteration_on() -> None:
    state = with_critic([1.0, -1.0])
    run(2, state)
    apply_edit(SetBound("first", 0.0, 3.0), state, WIDE)
    apply_edit(Lock("second", 7.0), state, WIDE)
    iterations = PEER.iterations(WIDE, state)
    for _ in itertools.islice(iterations, 6):
        assert state.explored is not None
        assert ((state.explored[:, 0] >= 0) & (state.explored[:, 0] <= 3)).all()
        assert (state.explored[:, 1] == 7.0).all()
    assert state.phi.tolist() == [3.0, 7.0]  # the critic rises along the first, and its bound is reached
    apply_edit(Unlock("second"), state, WIDE)
    assert next(iterations).phi[1] < 7.0


def test_phi_goes_on_from_an_injected_design() -> None:
    state = with_critic([1.0, 1.0])
    run(2, state)
    apply_edit(InjectDesign([-9.0, 5.0]), state, WIDE)
    step = 0.03 * 0.3**0.2 * 40
    assert run(1, state)[0].phi == pytest.approx([-9.0 + step, 5.0 + step])


def test_where_nothing_is_free_the_policy_learns_on() -> None:
    space = SPACE.with_lock("first", 1.0).with_lock("second", 3.0)
    state = begun(space=space)
    before = [parameter.clone() for parameter in state.control.policy.parameters()]
    assert [p.phi for p in run(3, state)] == [[1.0, 3.0]] * 3
    pairs = zip(before, state.control.policy.parameters(), strict=True)
    assert any(not torch.equal(one, other) for one, other in pairs)


# --- checkpoints and the trainer ---


@pytest.mark.parametrize("after", [1, 6, 13])
def test_it_goes_on_from_a_checkpoint_bit_for_bit(after: int, tmp_path: Path) -> None:
    folder, task = make_run(tmp_path), Scales(largest=8.0)
    whole, state = begun(seed=4), begun(seed=4)
    expected = run(20, whole, task)
    run(after, state, task)
    save_checkpoint(folder, state, 0.0)
    loaded, _ = load_checkpoint(folder, after, task, PEER)
    assert run(20 - after, loaded, task) == expected[after:]
    for name, module in whole.modules.items():
        for key, value in module.state_dict().items():
            assert torch.equal(loaded.modules[name].state_dict()[key], value)


def test_an_evaluation_keeps_the_designs_that_were_explored(tmp_path: Path) -> None:
    from morph_core.run_folder import read_episode

    folder = make_run(tmp_path, method=small_method("value_gradient", {"evaluation.interval": 1}), iterations=3)
    Trainer(folder).run()
    history = History(folder)
    assert [e.phi for e in history.evaluations] == [p.phi for p in history.progress]
    assert len({tuple(e.phi) for e in history.evaluations}) == 3
    population = read_episode(folder, 3)["population"]
    assert np.unique(population, axis=0).shape == (8, 5)
