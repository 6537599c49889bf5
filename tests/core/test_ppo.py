"""How policy and critic learn, step by step, with gradients known by hand: one layer each, one plain gradient step."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch

from morph_core.control import Batch
from morph_core.networks import log_normal
from morph_core.parts import Ppo, Schedule
from morph_core.state import State, start
from tests.core.scales import BATCH_OF_ALL, TINY, Scales, linear, replaced, started, tensor, trajectories

STD = 0.5


def batch_of(state: State, **given: Any) -> Batch:
    """Return a batch that teaches nothing but what is given; actions are one std off the mean, so std stays."""
    size = len(next(iter(given.values())))
    observation = tensor(given.get("observation", [[1.0]] * size))
    with torch.no_grad():
        action = state.control.policy.mean(observation) + STD
        now = state.control.policy.log_prob(observation, action)
        value = state.control.critic(observation, tensor(given.get("time", [0.0] * size)))
    return Batch(
        observation=observation,
        time=tensor(given.get("time", [0.0] * size)),
        action=action,
        log_prob=now - tensor(given.get("ratio", [1.0] * size)).log(),
        advantage=tensor(given.get("advantage", [0.0] * size)),
        value_target=value + tensor(given.get("value_error", [0.0] * size)),
    )


def improved(ppo: Ppo = BATCH_OF_ALL, age: int = 1, rate: float = 1.0, **given: Any) -> State:
    state = started(replaced(ppo=ppo), rate=rate)
    state.control.improve(batch_of(state, **given), age, state.rng)
    return state


@pytest.mark.parametrize(
    ("ratio", "advantage", "flows"),
    [
        (1.0, 2.0, True), (1.0, -2.0, True),
        (1.19, 2.0, True), (1.5, 2.0, False), (1.5, -2.0, True),
        (0.81, -2.0, True), (0.5, -2.0, False), (0.5, 2.0, True),
    ],
)  # fmt: skip
def test_beyond_the_clip_nothing_pulls_further_and_everything_pulls_back(
    ratio: float, advantage: float, flows: bool
) -> None:
    state = improved(ratio=[ratio], advantage=[advantage])
    # d(r A)/d mean = r A (a - mean) / std^2
    expected = ratio * advantage * STD / STD**2 if flows else 0.0
    mean = state.control.policy.mean
    assert mean.weight.flatten().tolist() == pytest.approx([expected] * 2, rel=1e-5)
    assert mean.bias.tolist() == pytest.approx([expected] * 2, rel=1e-5)
    assert state.control.policy.std.tolist() == pytest.approx([STD] * 2, rel=1e-5)


def test_the_policys_step_is_the_mean_over_the_batch() -> None:
    state = improved(observation=[[1.0], [3.0]], advantage=[1.0, -0.5])
    assert state.control.policy.mean.weight.flatten().tolist() == pytest.approx([(1 - 1.5) / 2 / STD] * 2)


@pytest.mark.parametrize("clip", [0.05, 0.4])
def test_the_clip_is_the_settings(clip: float) -> None:
    inside, outside = (
        improved(dataclasses.replace(BATCH_OF_ALL, clip_coef=clip), ratio=[1 + share * clip], advantage=[1.0])
        for share in (0.9, 1.1)
    )
    assert inside.control.policy.mean.bias[0] > 0
    assert outside.control.policy.mean.bias[0] == 0


def test_the_critics_step_is_that_of_half_the_squared_error() -> None:
    state = improved(observation=[[1.0], [2.0]], time=[0.5, 0.0], value_error=[1.0, 4.0])
    value = state.control.critic.value
    assert value.weight.flatten().tolist() == pytest.approx([(1 * 1 + 4 * 2) / 2, 1 * 0.5 / 2])
    assert value.bias.tolist() == pytest.approx([(1 + 4) / 2])


@pytest.mark.parametrize("weight", [0.0, 0.1, 0.3])
def test_the_entropy_bonus_widens_every_action_by_its_weight(weight: float) -> None:
    state = started(replaced(ppo=dataclasses.replace(BATCH_OF_ALL, entropy_coef=weight)))
    with torch.no_grad():
        state.control.policy.log_std[:] = math.log(0.1)
    state.control.improve(batch_of(state, advantage=[0.0]), 1, state.rng)
    assert state.control.policy.log_std.tolist() == pytest.approx([math.log(0.1) + weight] * 2)


def test_gradients_are_clipped_at_the_norm_and_the_critics_at_twice_that() -> None:
    ppo = dataclasses.replace(BATCH_OF_ALL, max_grad_norm=0.5)
    state = improved(ppo, advantage=[100.0], value_error=[100.0])
    policy = state.control.policy
    moved = torch.cat([p.flatten() for p in policy.mean.parameters()] + [policy.log_std - math.log(STD)])
    assert float(moved.detach().norm()) == pytest.approx(0.5, rel=1e-4)
    moved = torch.cat([p.flatten() for p in state.control.critic.parameters()])
    assert float(moved.detach().norm()) == pytest.approx(1.0, rel=1e-4)


def test_small_gradients_are_not_scaled() -> None:
    state = improved(dataclasses.replace(BATCH_OF_ALL, max_grad_norm=0.5), advantage=[0.01], value_error=[0.01])
    assert state.control.policy.mean.bias.tolist() == pytest.approx([0.01 / STD] * 2)
    assert state.control.critic.value.bias.tolist() == pytest.approx([0.01])


@pytest.mark.parametrize(("age", "std"), [(1, 0.8), (6, 0.4), (11, 0.2), (50, 0.2)])
def test_the_stds_limit_falls_geometrically_over_the_schedule(age: int, std: float) -> None:
    ppo = dataclasses.replace(BATCH_OF_ALL, std=0.8, std_end=0.2)
    state = started(replaced(ppo=ppo, schedule=Schedule(11)))
    state.control.improve(batch_of(state, advantage=[0.0]), age, state.rng)
    assert state.control.policy.std.tolist() == pytest.approx([std] * 2)


def test_a_smaller_std_is_left_as_it_is() -> None:
    state = started(replaced(ppo=dataclasses.replace(BATCH_OF_ALL, std=0.8, std_end=0.2), schedule=Schedule(11)))
    with torch.no_grad():
        state.control.policy.log_std[:] = math.log(0.1)
    state.control.improve(batch_of(state, advantage=[0.0]), 50, state.rng)
    assert state.control.policy.std.tolist() == pytest.approx([0.1] * 2)


def test_every_pass_takes_a_step_per_minibatch_and_sees_every_sample_once(monkeypatch: pytest.MonkeyPatch) -> None:
    state = started(replaced(ppo=dataclasses.replace(BATCH_OF_ALL, epochs=2, minibatches=3)), rate=0.01)
    seen: list[float] = []
    steps: list[int] = []
    state.control.optimizer.register_step_post_hook(lambda *_: steps.append(1))
    of = Batch.of

    def noted(batch: Batch, index: torch.Tensor) -> Batch:
        seen.extend(of(batch, index).observation[:, 0].tolist())
        return of(batch, index)

    monkeypatch.setattr(Batch, "of", noted)
    batch = batch_of(state, observation=[[float(i)] for i in range(7)])
    state.control.improve(batch, 1, state.rng)
    assert len(steps) == 2 * 3
    assert sorted(seen[:7]) == sorted(seen[7:]) == [0, 1, 2, 3, 4, 5, 6]
    assert seen[:7] != seen[7:]


def test_nothing_of_a_gradient_is_left_for_the_next_step() -> None:
    state = improved(dataclasses.replace(BATCH_OF_ALL, epochs=2), rate=0.5, observation=[[0.0]], value_error=[1.0])
    assert state.control.critic.value.bias.tolist() == pytest.approx([0.5 + 0.25])  # the error halves


@pytest.mark.parametrize(("iteration", "share"), [(1, 0.0), (6, 0.5), (11, 1.0), (40, 1.0)])
def test_all_learning_rates_fall_linearly_to_their_last_fraction(iteration: int, share: float) -> None:
    method = replaced(ppo=Ppo(learning_rate=0.01, learning_rate_end=0.2), schedule=Schedule(11))
    state = started(method)
    state.set_learning_rates(method, iteration)
    assert state.control.optimizer.param_groups[0]["lr"] == pytest.approx(0.01 * (1 - 0.8 * share))
    assert state.hw_nn.optimizer.param_groups[0]["lr"] == pytest.approx(method.proxy.learning_rate * (1 - 0.8 * share))


def test_a_fresh_start_begins_the_schedule_again_for_policy_and_critic_alone() -> None:
    method = replaced(ppo=Ppo(learning_rate=0.01, learning_rate_end=0.2, std=0.8, std_end=0.2), schedule=Schedule(11))
    state = started(method)
    state.control_start = 10
    state.set_learning_rates(method, 16)
    assert state.control.optimizer.param_groups[0]["lr"] == pytest.approx(0.01 * 0.6)
    assert state.hw_nn.optimizer.param_groups[0]["lr"] == pytest.approx(method.proxy.learning_rate * 0.2)
    state.control.learn(state, trajectories(np.zeros((3, 2)), np.ones((3, 2))), 16)
    assert state.control.policy.std.tolist() == pytest.approx([0.4] * 2, rel=0.1)


def test_learning_returns_the_advantages_of_its_batch() -> None:
    state = started()
    rollout = trajectories(np.arange(6.0).reshape(3, 2), [[1, 1], [1, 1], [1, 0]])
    expected = state.control.batch(rollout).advantage.numpy()
    assert np.array_equal(state.control.learn(state, rollout, 1), expected)


# --- starting afresh ---


def after(near: list[float], interval: int = 3, state: State | None = None) -> State:
    """Return the state after iterations in which these shares of 100 episodes reached the first milestone."""
    state = state or started(replaced(ppo=Ppo(epochs=1, minibatches=1, restart_interval=interval)))
    for iteration, share in enumerate(near, state.iteration + 1):
        reached = np.zeros((3, 100), dtype=bool)
        reached[1, : round(100 * share)] = True
        never = np.zeros_like(reached)
        rollout = trajectories(np.zeros((3, 100)), ~never, milestones={"near": reached, "done": never})
        state.control.learn(state, rollout, iteration)
        state.iteration = iteration
    return state


@pytest.mark.parametrize(
    ("near", "restarted", "reached"),
    [
        ([0, 0], 0, 0),
        ([0, 0, 0], 3, 3),
        ([0, 0, 0, 0, 0], 3, 3),
        ([0, 0, 0, 0, 0, 0], 6, 6),
        ([0, 0.02, 0, 0], 0, 2),
        ([0, 0.01, 0], 3, 3),
        ([0, 0, 0.02], 0, 3),
        ([0, 0.5, 0, 0, 0], 5, 5),
    ],
)
def test_policy_and_critic_start_afresh_after_an_interval_without_the_first_milestone(
    near: list[float], restarted: int, reached: int
) -> None:
    state = after(near)
    assert (state.control_start, state.last_reached) == (restarted, reached)


def test_a_fresh_start_is_one_of_new_weights_and_an_optimiser_that_knows_them() -> None:
    state = started(replaced(ppo=Ppo(epochs=1, minibatches=1, restart_interval=1)))
    policy, critic, optimizer = state.control.policy, state.control.critic, state.control.optimizer
    phi, hw_nn = state.phi.copy(), state.proxy
    after([0], state=state)
    assert state.control.policy is not policy
    assert state.control.critic is not critic
    assert state.control.optimizer is not optimizer
    parameters = [*state.control.policy.parameters(), *state.control.critic.parameters()]
    assert all(a is b for a, b in zip(parameters, state.control.optimizer.param_groups[0]["params"], strict=True))
    assert not state.control.optimizer.state
    assert state.modules["policy"] is state.control.policy
    assert state.optimizers["control"] is state.control.optimizer
    assert np.array_equal(state.phi, phi)
    assert state.proxy is hw_nn
    again = after([0], state=started(replaced(ppo=Ppo(epochs=1, minibatches=1, restart_interval=1))))
    for first, second in zip(state.control.policy.parameters(), again.control.policy.parameters(), strict=True):
        assert torch.equal(first, second)  # drawn from the run's own random numbers
    other = started(replaced(ppo=Ppo(epochs=1, minibatches=1, restart_interval=1)), seed=1)
    assert not torch.equal(state.control.policy.mean[0].weight, after([0], state=other).control.policy.mean[0].weight)  # pyright: ignore


def test_without_an_interval_nothing_starts_afresh() -> None:
    assert after([0] * 9, interval=0).control_start == 0


def test_a_task_without_milestones_is_never_stuck() -> None:
    state = started(replaced(ppo=Ppo(epochs=1, minibatches=1, restart_interval=1)))
    state.control.learn(state, trajectories(np.zeros((3, 2)), np.ones((3, 2))), 1)
    assert (state.control_start, state.last_reached) == (0, 1)


def test_the_policy_starts_at_its_std_around_the_tasks_initial_action() -> None:
    policy = start(Scales(), replaced(ppo=Ppo(std=0.7)), 0).control.policy
    assert policy.std.tolist() == pytest.approx([0.7] * 2)
    assert policy.act(np.zeros((1, 1), dtype=np.float32), None) == pytest.approx(np.zeros((1, 2)), abs=0.05)


def test_an_action_is_the_mean_and_noise_of_the_policys_std() -> None:
    state = started()
    state.control.policy.mean = linear([[1.0], [2.0]], [0.0, 1.0])
    observation = np.array([[3.0]], dtype=np.float32)
    assert state.control.policy.act(observation, None).tolist() == [[3.0, 7.0]]
    noise = np.random.default_rng(0).standard_normal((1, 2), dtype=np.float32)
    acted = state.control.policy.act(observation, np.random.default_rng(0))
    assert np.allclose(acted, [[3.0, 7.0]] + TINY.ppo.std * noise)


def layers_of(weights: Any) -> dict[str, list[torch.nn.Linear]]:
    """Return the layers of a fresh policy and critic."""
    control = start(Scales(), replaced(ppo=Ppo(initial_weights=weights)), 0).control
    nets = {"policy": control.policy.mean, "critic": control.critic.value}
    return {name: [layer for layer in net if isinstance(layer, torch.nn.Linear)] for name, net in nets.items()}


def test_orthogonal_weights_keep_lengths_but_for_their_gain() -> None:
    for name, layers in layers_of("orthogonal").items():
        for layer, gain in zip(layers, (math.sqrt(2), math.sqrt(2), 0.01 if name == "policy" else 1.0), strict=True):
            singular = torch.linalg.svdvals(layer.weight.detach())
            assert singular.tolist() == pytest.approx([gain] * len(singular), rel=1e-4)
            assert (name == "policy" and layer is layers[-1]) or not layer.bias.any()


def test_uniform_weights_fill_their_range() -> None:
    first = [layers[0] for layers in layers_of("uniform").values()]
    for layer in (*first, layers_of("uniform")["critic"][-1]):
        values = torch.cat([layer.weight.flatten(), layer.bias]).detach().abs() * math.sqrt(layer.in_features)
        assert 0.5 < float(values.max()) <= 1
        assert layer.bias.all()


def test_the_log_probability_is_that_of_independent_normal_numbers() -> None:
    x, mean, std = tensor([[0.3, -1.0], [2.0, 0.5]]), tensor([[0.1, 0.0], [1.0, 0.5]]), tensor([0.5, 2.0])
    expected = torch.distributions.Normal(mean, std).log_prob(x).sum(-1)
    assert log_normal(x, mean, std).tolist() == pytest.approx(expected.tolist())
