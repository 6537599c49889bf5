"""The gradients by hand are autograd's, and are clipped as torch clips them, to the last bit."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from morph_core.control import Batch, Control
from morph_core.networks import mlp
from morph_core.parts import Ppo, Schedule
from morph_core.passes import Passes, clip_gradients
from morph_core.tasks.reacher import Reacher

seeds = st.integers(0, 2**32 - 1)


def gradients(*modules: nn.Module) -> dict[str, torch.Tensor]:
    named = (pair for module in modules for pair in module.named_parameters())
    return {name: parameter.grad.clone() for name, parameter in named if parameter.grad is not None}


def same(by_hand: dict[str, torch.Tensor], by_autograd: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(by_hand[name], gradient) for name, gradient in by_autograd.items())


# Of one hidden unit and a single row autograd takes a dot product, which rounds otherwise.
@given(seeds, st.integers(1, 9), st.integers(2, 70), st.integers(1, 9), st.integers(1, 1030))
@settings(max_examples=30, deadline=None)
def test_both_passes_are_autograds(seed: int, inputs: int, hidden: int, outputs: int, size: int) -> None:
    rng = torch.Generator().manual_seed(seed)
    net = mlp(inputs, hidden, outputs, nn.Tanh, rng)
    x, slope = torch.randn(size, inputs, generator=rng), torch.randn(size, outputs, generator=rng)
    expected = net(x)
    expected.backward(slope)
    by_autograd = gradients(net)
    with torch.no_grad():
        passes = Passes(net)
        assert torch.equal(passes.forward(x), expected)
        passes.backward(slope)
    assert same(gradients(net), by_autograd)


@given(seeds, st.floats(1e-3, 1e3), st.lists(st.integers(1, 70), min_size=1, max_size=7))
@settings(max_examples=30, deadline=None)
def test_gradients_are_clipped_as_torch_does_it(seed: int, largest: float, sizes: list[int]) -> None:
    rng = torch.Generator().manual_seed(seed)
    ours, torchs = ([nn.Parameter(torch.zeros(size)) for size in sizes] for _ in range(2))
    for mine, other in zip(ours, torchs, strict=True):
        mine.grad = torch.randn(len(mine), generator=rng)
        other.grad = mine.grad.clone()
    clip_gradients(ours, largest)
    nn.utils.clip_grad_norm_(torchs, largest)
    assert same(gradients(nn.ParameterList(ours)), gradients(nn.ParameterList(torchs)))


def loss(control: Control, ppo: Ppo, batch: Batch) -> torch.Tensor:
    """Return PPO's loss as Schulman et al. have it."""
    ratio = (control.policy.log_prob(batch.observation, batch.action) - batch.log_prob).exp()
    limited = ratio.clamp(1 - ppo.clip_coef, 1 + ppo.clip_coef)
    surrogate = torch.min(ratio * batch.advantage, limited * batch.advantage).mean()
    value_error = control.critic(batch.observation, batch.time) - batch.value_target
    return 0.5 * (value_error**2).mean() - surrogate - ppo.entropy_coef * control.policy.log_std.sum()


class Kept(torch.optim.SGD):
    """An optimiser that only notes the gradients it is given."""

    def step(self, closure: Any = None) -> None:
        self.given = [p.grad.clone() for p in self.param_groups[0]["params"]]


def steps(
    log_ratio: torch.Tensor, seed: int, std: float, off: float, entropy_coef: float = 0.0
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Return the gradients by hand and autograd's, for actions about `off` from the mean."""
    ppo = Ppo(epochs=1, minibatches=1, entropy_coef=entropy_coef, max_grad_norm=1e9)
    task, rng, size = Reacher(), torch.Generator().manual_seed(seed), len(log_ratio)
    control = Control(task, ppo, Schedule(), 16, rng)
    parameters = [*control.policy.parameters(), *control.critic.parameters()]
    with torch.no_grad():
        control.policy.log_std.fill_(math.log(std))
        observation = torch.randn(size, task.observation_size, generator=rng)
        action = control.policy.mean(observation) + off * torch.randn(size, task.action_size, generator=rng)
        before = control.policy.log_prob(observation, action) - log_ratio
    time, (advantage, target) = torch.rand(size, generator=rng), torch.randn(2, size, generator=rng)
    batch = Batch(observation, time, action, before, advantage, target)
    order = torch.from_numpy(np.random.default_rng(seed).permutation(size))
    loss(control, ppo, batch.of(order)).backward()
    by_autograd = [p.grad.clone() for p in parameters]
    control.optimizer = Kept(parameters)
    control.improve(batch, 1, np.random.default_rng(seed))
    return control.optimizer.given, by_autograd


@given(
    seed=seeds,
    size=st.integers(2, 600),
    spread=st.sampled_from([0.0, 0.01, 0.5, 3.0]),
    entropy_coef=st.sampled_from([0.0, 0.003]),
    std=st.sampled_from([0.01, 0.02, 0.5, 2.0, 3.0]),
)
@settings(max_examples=60, deadline=None)
def test_the_step_of_policy_and_critic_is_autograds(
    seed: int, size: int, spread: float, entropy_coef: float, std: float
) -> None:
    log_ratio = spread * torch.randn(size, generator=torch.Generator().manual_seed(seed))
    by_hand, by_autograd = steps(log_ratio, seed, std, 1.0, entropy_coef)
    assert all(torch.equal(a, b) for a, b in zip(by_hand, by_autograd, strict=True))


@pytest.mark.parametrize("seed", range(3))
def test_of_two_pulls_that_round_alike_beyond_the_clip_half_counts_as_autograd_has_it(seed: int) -> None:
    # Near its mean, this density is about 1, so that the ratio can be a last bit beyond the clip.
    beyond = 2e-7 * torch.rand(5000, generator=torch.Generator().manual_seed(seed))
    by_hand, by_autograd = steps(math.log(1.2) + beyond, seed, 0.4, 0.01)
    assert all(torch.equal(a, b) for a, b in zip(by_hand, by_autograd, strict=True))
