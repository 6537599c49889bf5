"""Transform2Act: the design as the first action; on two scales an episode returns 3 (phi_1 + phi_2)."""

import copy
import dataclasses
import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from morph_core.checkpoint import load_checkpoint, save_checkpoint
from morph_core.control import Control
from morph_core.design import DesignSpace
from morph_core.history import History
from morph_core.methods import transform2act
from morph_core.methods.transform2act import Transform2Act
from morph_core.parts import Schedule
from morph_core.protocol import InjectDesign, Lock, Progress, SetBound, Unlock
from morph_core.rollout import Rollout
from morph_core.state import State, start
from morph_core.task import Hardware, Transition
from morph_core.train import Trainer, apply_edit
from morph_core.two_stages import TwoStageBatch, TwoStageControl, design_of, mapped
from studio.export.policy import policy_at
from tests.core.conftest import make_run, small_method
from tests.core.scales import BATCH_OF_ALL, TINY, Scales, linear, plain, tensor, trajectories

RIVAL = Transform2Act(trajectories=8, hidden=4, ppo=TINY.ppo, schedule=Schedule(10))
WIDE = Scales(largest=20.0)
"""Two scales of which every design in the box can be built."""
SPACE = WIDE.design_space  # [-20, 20] m twice, 2 m at the start
BOTH = np.array([True, True])


def run(iterations: int, state: State, task: Scales | None = None, method: Transform2Act = RIVAL) -> list[Progress]:
    return list(itertools.islice(method.iterations(task or WIDE, state), iterations))


def begun(space: DesignSpace | None = None, method: Transform2Act = RIVAL, seed: int = 0) -> State:
    return start(WIDE, method, seed, space)


def control_of(state: State) -> TwoStageControl:
    assert isinstance(state.control, TwoStageControl)
    return state.control


def by_hand(rate: float = 1.0, **settings: Any) -> TwoStageControl:
    """Return one with a layer of zeros each, which learns by gradient descent; std is .5 for actions and designs."""
    ppo = dataclasses.replace(BATCH_OF_ALL, gamma=0.5, gae_lambda=0.5, **settings.pop("ppo", {}))
    control = control_of(begun(method=dataclasses.replace(RIVAL, ppo=ppo, design_std=0.5, **settings)))
    zeros = [0.0, 0.0]
    control.policy.mean = linear([[0.0] * 3] * 2, zeros)  # pyright: ignore[reportAttributeAccessIssue]
    control.design_policy.mean = linear([zeros] * 2, zeros)  # pyright: ignore[reportAttributeAccessIssue]
    # of the observation, both of phi, the flag and the time
    control.critic.value = linear([[0.0] * 5], [0.0])  # pyright: ignore[reportAttributeAccessIssue]
    control.optimizer = plain([p for module in control.modules.values() for p in module.parameters()], rate)
    return control


# --- the mapped space ---


@pytest.mark.parametrize(
    ("p", "phi"), [(0, 0), (1, 20), (-1, -20), (1 / 3, 10), (-1 / 3, -10), (5 / 3, 10), (3, -20), (0.5, 20 / 2**0.5)]
)
def test_a_sine_maps_the_step_to_the_box_and_comes_back_from_the_bounds(p: float, phi: float) -> None:
    assert design_of(SPACE, np.array([p, -p])) == pytest.approx(np.array([phi, -phi]), abs=1e-12)


def test_the_map_is_that_of_the_present_box() -> None:
    space = SPACE.with_bound("first", 1.0, 5.0).with_lock("second", 7.0)
    assert design_of(space, np.array([[1 / 3, 0.9], [-1.0, 0.0]])) == pytest.approx(np.array([[4.0, 7.0], [1.0, 7.0]]))
    assert mapped(space, np.array([4.0, 7.0])).tolist()[0] == pytest.approx(1 / 3)


@given(phi=st.lists(st.floats(-20, 20), min_size=2, max_size=2).map(np.array))
def test_the_mapped_place_of_a_design_leads_back_to_it(phi: np.ndarray) -> None:
    p = mapped(SPACE, phi)
    assert (np.abs(p) <= 1).all()
    assert design_of(SPACE, p) == pytest.approx(phi, abs=1e-9)


# --- the design policy ---


def test_it_begins_at_the_initial_design_with_the_std_of_the_settings() -> None:
    head = control_of(begun(method=dataclasses.replace(RIVAL, design_std=0.3))).design_policy
    assert head.mean_design(SPACE) == pytest.approx(SPACE.initial, abs=1e-6)
    assert head.std.tolist() == pytest.approx([0.3, 0.3])


def test_steps_are_drawn_about_the_mean_with_the_std() -> None:
    head = by_hand().design_policy
    with torch.no_grad():
        head.mean.bias[:] = tensor([1.0, -2.0])  # pyright: ignore
    step = head.draw(20_000, np.random.default_rng(0))
    assert step.dtype == np.float32
    assert step.mean(0) == pytest.approx([1.0, -2.0], abs=0.02)
    assert step.std(0) == pytest.approx([0.5, 0.5], abs=0.01)


def test_the_log_probability_of_a_step_counts_what_is_free() -> None:
    head = by_hand().design_policy
    step = tensor([[0.5, 1.0], [0.0, 0.0]])  # one and two std from the mean
    of_mean = -math.log(0.5) - 0.5 * math.log(2 * math.pi)
    both, first, none = (head.log_prob(step, torch.tensor(free)) for free in ([True] * 2, [True, False], [False] * 2))
    assert both.tolist() == pytest.approx([2 * of_mean - 0.5 - 2, 2 * of_mean])
    assert first.tolist() == pytest.approx([of_mean - 0.5, of_mean])
    assert none.tolist() == [0, 0]


@given(phi=st.lists(st.floats(-20, 20), min_size=2, max_size=2).map(np.array))
def test_the_mean_step_leads_to_any_design_that_is_set(phi: np.ndarray) -> None:
    head = control_of(begun()).design_policy
    before = {name: value.clone() for name, value in head.state_dict().items() if name != "start"}
    head.lead_to(SPACE, phi)
    assert head.mean_design(SPACE) == pytest.approx(phi, abs=1e-6)
    assert all(torch.equal(head.state_dict()[name], value) for name, value in before.items())


# --- advantages through both stages ---

REWARD = [[1.0, 2.0], [3.0, 4.0], [500.0, 6.0]]
ALIVE = [[True, True], [True, True], [False, True]]
"""The first episode ends after two steps, the second at the horizon."""


def batch_by_hand(balanced: bool) -> TwoStageBatch:
    control = by_hand(credit="balanced" if balanced else "gae")
    # V = 1 + 3 t / T = 1, 2, 3 of control and 1 + 7 of design
    control.critic.value = linear([[0.0, 0.0, 0.0, 7.0, 3.0]], [1.0])  # pyright: ignore[reportAttributeAccessIssue]
    rollout = trajectories(REWARD, ALIVE, observation=np.zeros((3, 2, 3), dtype=np.float32))
    return control.two_stages(rollout, np.zeros((2, 2), dtype=np.float32), BOTH)


# From behind, with gamma = lambda = .5: delta = r + V'/2 - V, A = delta + A'/4.
CONTROL = [[1 + 1 - 1 + 1 / 4, 3 - 2], [2 + 1 - 1 + (4 + 1.5 - 2 + 3 / 4) / 4, 4 + 1.5 - 2 + 3 / 4, 6 - 3]]
DESIGN = [0 + 0.5 * 1 - 8 + episode[0] / 4 for episode in CONTROL]
ROWS = [CONTROL[0][0], CONTROL[1][0], CONTROL[0][1], CONTROL[1][1], CONTROL[1][2]]
"""Advantages of the steps alive of the control stage, in the order of a batch."""


def standardised(values: list[float]) -> list[float]:
    return ((np.array(values) - np.mean(values)) / np.std(values, ddof=1)).tolist()


def test_advantages_go_straight_through_both_stages_and_are_standardised_together() -> None:
    batch = batch_by_hand(balanced=False)
    together = standardised([*ROWS, *DESIGN])
    assert batch.advantage.tolist() == pytest.approx(together[:5], abs=1e-5)
    assert batch.design_advantage.tolist() == pytest.approx(together[5:], abs=1e-5)
    assert batch.design_target.tolist() == pytest.approx([DESIGN[0] + 8, DESIGN[1] + 8])
    assert batch.value_target.tolist() == pytest.approx((np.array(ROWS) + np.array([1, 1, 2, 2, 3])).tolist())


def test_balanced_the_design_counts_whole_returns_and_each_stage_is_standardised_apart() -> None:
    batch = batch_by_hand(balanced=True)
    assert batch.design_advantage.tolist() == pytest.approx(standardised([1 + 3 - 8, 2 + 4 + 6 - 8]), abs=1e-5)
    assert batch.design_target.tolist() == [4.0, 12.0]
    assert batch.advantage.tolist() == pytest.approx(standardised(ROWS), abs=1e-5)


def test_a_batch_holds_a_row_for_each_step_alive_and_for_each_design() -> None:
    control = by_hand()
    observation = np.arange(18, dtype=np.float32).reshape(3, 2, 3)
    step = np.array([[0.5, 0.0], [1.0, 0.0]], dtype=np.float32)
    batch = control.two_stages(trajectories(REWARD, ALIVE, observation=observation), step, np.array([True, False]))
    assert len(batch) == 5 + 2
    assert batch.observation[:, 0].tolist() == [0, 3, 6, 9, 15]
    assert batch.step.tolist() == step.tolist()
    assert batch.free.tolist() == [True, False]
    assert torch.equal(batch.step_log_prob, control.design_policy.log_prob(batch.step, batch.free))
    assert not batch.step_log_prob.requires_grad


def test_the_critic_tells_the_stages_apart_by_a_flag() -> None:
    critic = by_hand().critic
    critic.value = linear([[1.0, 10.0, 100.0, 1000.0, 10_000.0]], [0.5])  # pyright: ignore[reportAttributeAccessIssue]
    assert critic(tensor([[1.0, 2.0, 3.0]]), tensor([0.25])).tolist() == [1 + 20 + 300 + 0 + 2500 + 0.5]
    assert critic.of_design_stage(tensor([2.0, 3.0])).tolist() == 0 + 20 + 300 + 1000 + 0 + 0.5


# --- one PPO over both ---

STD = 0.5


def batch_of(control: TwoStageControl, **given: Any) -> TwoStageBatch:
    """Return two steps of control that teach nothing, and designs one std off the mean."""
    size = len(next(iter(given.values())))
    step = torch.full((size, 2), STD)
    free = torch.tensor(given.get("free", [True, True]))
    observation, action, zeros = torch.zeros(2, 3), torch.zeros(2, 2), torch.zeros(2)
    with torch.no_grad():
        now, acted = control.design_policy.log_prob(step, free), control.policy.log_prob(observation, action)
    return TwoStageBatch(
        observation=observation, time=zeros, action=action, log_prob=acted, advantage=zeros, value_target=zeros,
        step=step, free=free, step_log_prob=now - tensor(given.get("ratio", [1.0] * size)).log(),
        design_advantage=tensor(given.get("advantage", [0.0] * size)),
        design_target=tensor(given.get("value_error", [0.0] * size)),
    )  # fmt: skip


def improved(control: TwoStageControl | None = None, **given: Any) -> TwoStageControl:
    control = control or by_hand()
    control.improve_both(batch_of(control, **given), 1, np.random.default_rng(0))
    return control


def bias_of(network: Any) -> list[float]:
    return network.bias.tolist()


@pytest.mark.parametrize(
    ("ratio", "advantage", "flows"),
    [
        (1.0, 2.0, True), (1.0, -2.0, True),
        (1.19, 2.0, True), (1.5, 2.0, False), (1.5, -2.0, True),
        (0.81, -2.0, True), (0.5, -2.0, False), (0.5, 2.0, True),
    ],
)  # fmt: skip
def test_the_designs_ratio_is_clipped_as_the_actions_is(ratio: float, advantage: float, flows: bool) -> None:
    control = improved(ratio=[ratio], advantage=[advantage])
    # d(r A)/d mean = r A (step - mean) / std^2, and the mean is over three rows
    expected = ratio * advantage * STD / STD**2 / 3 if flows else 0.0
    assert bias_of(control.design_policy.mean) == pytest.approx([expected] * 2, rel=1e-5)
    assert bias_of(control.policy.mean) == [0, 0]


def test_a_locked_entry_learns_nothing() -> None:
    control = improved(advantage=[3.0], free=[True, False])
    assert bias_of(control.design_policy.mean) == pytest.approx([3 / STD / 3, 0.0])
    assert control.design_policy.log_std.tolist()[1] == pytest.approx(math.log(STD))


def test_actions_learn_as_without_a_design_stage() -> None:
    control = by_hand()
    batch = dataclasses.replace(
        batch_of(control, advantage=[0.0]), action=torch.full((2, 2), STD), advantage=tensor([3.0, 0.0])
    )
    with torch.no_grad():
        now = control.policy.log_prob(batch.observation, batch.action)
    control.improve_both(dataclasses.replace(batch, log_prob=now), 1, np.random.default_rng(0))
    assert bias_of(control.policy.mean) == pytest.approx([3 / STD / 3] * 2)
    assert bias_of(control.design_policy.mean) == [0, 0]


def test_the_critic_learns_the_value_of_the_design_stage_from_every_design() -> None:
    value: Any = improved(value_error=[3.0, 6.0]).critic.value
    assert value.weight[0, 3].tolist() == pytest.approx((3 + 6) / 4)
    assert bias_of(value) == pytest.approx([(3 + 6) / 4])


def test_the_entropy_bonus_widens_actions_and_not_designs() -> None:
    control = by_hand(ppo={"entropy_coef": 0.1})
    with torch.no_grad():
        control.policy.log_std[:] = math.log(0.1)
    improved(control, advantage=[0.0])
    assert control.policy.log_std.tolist() == pytest.approx([math.log(0.1) + 0.1] * 2)
    assert control.design_policy.log_std.tolist() == pytest.approx([math.log(STD)] * 2)


def test_gradients_are_clipped_for_each_network() -> None:
    control = improved(by_hand(ppo={"max_grad_norm": 0.5}), advantage=[100.0], value_error=[1000.0])
    for module, norm in ((control.design_policy, 0.5), (control.critic, 1.0)):
        gradient = torch.cat([p.grad.flatten() for p in module.parameters() if p.grad is not None])
        assert float(gradient.norm()) == pytest.approx(norm, rel=1e-4)


def test_the_stds_limit_is_that_of_the_schedule() -> None:
    control = by_hand(ppo={"std": 0.8, "std_end": 0.2})
    control.improve_both(batch_of(control, advantage=[0.0]), 10, np.random.default_rng(0))
    assert control.policy.std.tolist() == pytest.approx([0.2] * 2)
    assert control.design_policy.std.tolist() == pytest.approx([0.5] * 2)


# --- the method ---


def watched(monkeypatch: pytest.MonkeyPatch) -> list[tuple[np.ndarray, Rollout]]:
    """Return a list that fills with the designs and the rollout of each iteration."""
    seen: list[tuple[np.ndarray, Rollout]] = []
    collect = transform2act.run_trajectories

    def noted(task: Any, state: Any, world: Any, trajectories: int, designs: np.ndarray) -> Rollout:
        seen.append((world.phi, collect(task, state, world, trajectories, designs)))
        return seen[-1][1]

    monkeypatch.setattr(transform2act, "run_trajectories", noted)
    return seen


def test_every_episode_runs_on_its_own_design_and_its_policy_sees_it(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, state = watched(monkeypatch), begun()
    run(2, state)
    for designs, rollout in seen:
        assert len(np.unique(designs, axis=0)) == 8
        assert np.array_equal(rollout.z[0], designs)  # z = phi s, and s is 1
        assert np.array_equal(rollout.observation[1, :, 1:], (designs / 20).astype(np.float32))
    assert state.explored is seen[-1][0]


def test_phi_is_the_design_of_the_mean_step_and_designs_are_drawn_about_it(monkeypatch: pytest.MonkeyPatch) -> None:
    method = dataclasses.replace(RIVAL, trajectories=2000, design_std=0.05)
    seen, state = watched(monkeypatch), begun(method=method)
    progress = run(3, state, method=method)
    for (designs, _), before in zip(seen, [SPACE.initial.tolist(), *(p.phi for p in progress)], strict=False):
        assert designs.mean(0) == pytest.approx(np.array(before), abs=0.15)
    assert progress[-1].phi == control_of(state).design_policy.mean_design(SPACE).tolist() == state.phi.tolist()
    # 40 / 2 * pi / 2 * cos(arcsin(.1)) * .05 m at 2 m, in scales of 1 m and 2 m
    assert progress[0].design_sigma == pytest.approx(math.pi / 2 * math.cos(math.asin(0.1)) * (1 + 0.5) / 2, rel=0.05)


@pytest.mark.parametrize("credit", ["gae", "balanced"])
def test_a_better_design_is_found(credit: Any) -> None:
    ppo = dataclasses.replace(TINY.ppo, epochs=4, learning_rate=1e-2)
    method = dataclasses.replace(RIVAL, trajectories=32, credit=credit, ppo=ppo)
    state = begun(method=method)
    run(60, state, method=method)
    assert state.phi.sum() > 12  # the initial design has 4


def test_steps_of_the_simulation_are_counted_and_not_the_choice_of_the_design() -> None:
    assert [p.env_steps for p in run(2, begun())] == [8 * 3, 2 * 8 * 3]


def test_only_designs_that_were_kept_are_learnt_from(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class Fragile(Scales):
        """The scales break where phi_1 is larger than at the start."""

        def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
            step = super().step(hardware, s, action)
            return dataclasses.replace(step, diverged=step.z[:, 0] > 2.0)

    taken: list[tuple[np.ndarray, Rollout]] = []

    def learn_both(_control: Any, _state: State, rollout: Rollout, step: np.ndarray, _iteration: int) -> None:
        taken.append((step, rollout))

    monkeypatch.setattr(TwoStageControl, "learn_both", learn_both)
    state = begun()
    run(1, state, Fragile(largest=20.0))
    step, rollout = taken[0]
    designs = design_of(SPACE, control_of(state).design_policy.start.numpy() + step)
    assert 0 < len(step) < 8
    assert np.array_equal(rollout.z[0], designs)
    assert state.diverged == 8 - len(step)


def test_an_iteration_whose_every_simulation_diverges_is_skipped() -> None:
    @dataclass(frozen=True)
    class Broken(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return super().hw_phy(np.full(phi.shape, np.nan))

    state = begun()
    before = copy.deepcopy({name: module.state_dict() for name, module in state.modules.items()})
    assert [(p.phi, p.episode_return) for p in run(2, state, Broken(largest=20.0))] == [([2.0, 2.0], 0.0)] * 2
    for name, module in state.modules.items():
        assert all(torch.equal(before[name][key], value) for key, value in module.state_dict().items())


# --- what can't be built, and what is not free ---


def test_designs_that_cant_be_built_are_drawn_back_towards_phi(monkeypatch: pytest.MonkeyPatch) -> None:
    method, task = dataclasses.replace(RIVAL, design_std=0.5), Scales(largest=3.0)
    seen, state = watched(monkeypatch), begun(method=method)
    progress = run(20, state, task, method)
    designs = np.concatenate([designs for designs, _ in seen])
    assert task.buildable(designs).all()
    assert all(task.buildable(np.array(p.phi)) for p in progress)
    assert (designs[:, 0] > 2.5).any()


def test_where_the_mean_cant_be_built_it_is_drawn_back_too(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class Alone(Scales):
        def buildable(self, phi: np.ndarray) -> np.ndarray:
            return np.asarray((np.abs(phi - 2.0) < 1e-9).all(-1))

    state = begun()
    assert [p.phi for p in run(3, state, Alone())] == [[2.0, 2.0]] * 3
    head = control_of(state).design_policy
    assert np.abs(head.mean_design(SPACE) - 2.0).max() > 1e-3
    monkeypatch.setattr(TwoStageControl, "learn_both", lambda *_: None)
    run(1, state, Alone())
    assert head.mean_design(SPACE) == pytest.approx(np.array([2.0, 2.0]), abs=1e-6)


def test_where_nothing_is_free_the_policy_learns_on() -> None:
    state = begun(space=SPACE.with_lock("first", 1.0).with_lock("second", 3.0))
    before = copy.deepcopy(state.control.policy.state_dict())
    progress = run(3, state)
    assert [p.phi for p in progress] == [[1.0, 3.0]] * 3
    assert progress[-1].design_sigma == 0.0
    assert not torch.equal(before["mean.0.weight"], state.control.policy.state_dict()["mean.0.weight"])


def test_a_policy_that_starts_afresh_keeps_the_design() -> None:
    ppo = dataclasses.replace(TINY.ppo, restart_interval=2)
    method = dataclasses.replace(RIVAL, ppo=ppo)
    state = begun(method=method)
    head, progress = control_of(state).design_policy, run(7, state, method=method)  # "near" is never reached
    assert state.control_start == 6
    assert control_of(state).design_policy is head
    assert progress[-1].phi == head.mean_design(SPACE).tolist() != SPACE.initial.tolist()
    assert progress[-1].policy_std == pytest.approx(ppo.std, abs=0.02)  # whose limit falls anew, from .5
    parameters = {id(p) for p in control_of(state).optimizer.param_groups[0]["params"]}
    assert parameters == {id(p) for module in state.control.modules.values() for p in module.parameters()}


# --- edits ---


def test_the_mean_is_moved_to_an_injected_design(monkeypatch: pytest.MonkeyPatch) -> None:
    method = dataclasses.replace(RIVAL, trajectories=2000, design_std=0.02)
    seen, state = watched(monkeypatch), begun(method=method)
    run(1, state, method=method)
    apply_edit(InjectDesign([9.5, -19.0]), state, WIDE)
    run(1, state, method=method)
    assert seen[-1][0].mean(0) == pytest.approx(np.array([9.5, -19.0]), abs=0.1)
    assert state.phi == pytest.approx(np.array([9.5, -19.0]), abs=1.5)


def test_bounds_and_locks_are_obeyed_from_the_next_iteration_on(monkeypatch: pytest.MonkeyPatch) -> None:
    method = dataclasses.replace(RIVAL, trajectories=2000, design_std=0.1)
    seen, state = watched(monkeypatch), begun(method=method)
    run(1, state, method=method)
    apply_edit(SetBound("first", 5.0, 6.0), state, WIDE)
    apply_edit(Lock("second", 7.0), state, WIDE)
    progress = run(2, state, method=method)
    for designs, _ in seen[1:]:
        assert designs[:, 0].min() >= 5.0
        assert designs[:, 0].max() <= 6.0
        assert set(designs[:, 1]) == {7.0}
    assert all(5 <= p.phi[0] <= 6 and p.phi[1] == 7.0 for p in progress)
    assert progress[-1].design_sigma == pytest.approx(seen[-1][0][:, 0].std())  # of what is free, in its scale of 1 m
    apply_edit(Unlock("second"), state, WIDE)
    run(1, state, method=method)
    assert seen[-1][0][:, 1].mean() == pytest.approx(7.0, abs=0.3)
    assert len(set(seen[-1][0][:, 1])) == 2000


def test_a_wider_box_leaves_the_mean_where_it_is() -> None:
    state = begun(space=SPACE.with_bound("first", 0.0, 4.0))
    before = np.array(run(1, state)[0].phi)
    apply_edit(SetBound("first", -20.0, 20.0), state, WIDE)
    control_of(state).design_policy.lead_to(state.design_space, state.phi)
    assert control_of(state).design_policy.mean_design(state.design_space) == pytest.approx(before, abs=1e-6)


# --- checkpoints, exports, the trainer ---


@pytest.mark.parametrize("after", [1, 4])
@pytest.mark.parametrize("credit", ["gae", "balanced"])
def test_it_goes_on_from_a_checkpoint_bit_for_bit(after: int, credit: Any, tmp_path: Path) -> None:
    method, folder = dataclasses.replace(RIVAL, credit=credit), make_run(tmp_path)
    whole, state = begun(method=method, seed=4), begun(method=method, seed=4)
    for begins in (whole, state):
        apply_edit(InjectDesign([3.0, 4.0]), begins, WIDE)
    expected = run(8, whole, method=method)
    run(after, state, method=method)
    save_checkpoint(folder, state, 0.0)
    loaded, _ = load_checkpoint(folder, after, WIDE, method)
    assert run(8 - after, loaded, method=method) == expected[after:]
    assert set(whole.modules) == {"policy", "critic", "design_policy"}
    for name, module in whole.modules.items():
        for key, value in module.state_dict().items():
            assert torch.equal(loaded.modules[name].state_dict()[key], value)


@pytest.mark.parametrize("name", ["start", "log_std", "mean.0.weight"])
def test_every_number_of_the_design_policy_survives_a_checkpoint(name: str, tmp_path: Path) -> None:
    state, folder = begun(seed=1), make_run(tmp_path)
    apply_edit(InjectDesign([3.0, 4.0]), state, WIDE)
    run(3, state)
    save_checkpoint(folder, state, 0.0)
    loaded, _ = load_checkpoint(folder, 3, WIDE, RIVAL)
    saved, fresh = (control_of(s).design_policy.state_dict()[name] for s in (state, begun()))
    assert not torch.equal(saved, fresh)
    assert torch.equal(control_of(loaded).design_policy.state_dict()[name], saved)


def test_the_exported_policy_is_that_of_the_present_phi(tmp_path: Path) -> None:
    state, folder = begun(), make_run(tmp_path)
    run(3, state)
    save_checkpoint(folder, state, 0.0)
    exported = policy_at(History(folder), 3, state.phi)
    assert exported is not None
    observation = np.array([[1.0], [-2.0]], dtype=np.float32)
    assert exported.act(observation, None) == pytest.approx(state.control.policy.at(state.phi).act(observation, None))


def test_it_refuses_the_policies_of_another_method() -> None:
    state = begun()
    state.control = Control(WIDE, RIVAL.ppo, RIVAL.schedule, 4, torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="transform2act needs the policies"):
        run(1, state)


def test_a_run_shows_the_explored_designs_and_measures_the_present_phi(tmp_path: Path) -> None:
    folder = make_run(tmp_path, method=small_method("transform2act", {"evaluation.interval": 1}), iterations=3)
    Trainer(folder).run()
    history = History(folder)
    assert [e.phi for e in history.evaluations] == [p.phi for p in history.progress]
    assert len({tuple(p.phi) for p in history.progress}) == 3
    for evaluation in history.evaluations:
        assert evaluation.episode is not None
        population = np.load(folder.path / evaluation.episode)["population"]
        assert population.shape == (8, 5)
        assert len(np.unique(population, axis=0)) == 8
