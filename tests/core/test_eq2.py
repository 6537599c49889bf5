"""Eq. 2 for the proxy, by hand: z = W s with one layer, one plain gradient step, and g_task given."""

import copy
import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from morph_core.config import Projection
from morph_core.divergence import divergence, divergence_gradient, limited, squared_distance
from morph_core.exploration import Metric
from morph_core.gradients import cosine, flatten, project, write_gradient
from morph_core.hw_nn import HwNN, ProxyUpdate
from morph_core.parts import Ppo, ProxyFit
from morph_core.search import Memory
from morph_core.state import State
from tests.core.scales import (
    BATCH_OF_ALL,
    TINY,
    Multiplied,
    Scales,
    linear,
    pairs_of,
    plain,
    proxy,
    replaced,
    started,
    tensor,
    weights_of,
)  # fmt: skip

ZERO = [[0.0, 0.0], [0.0, 0.0]]
ONE_PAIR: dict[str, Any] = {"s": [[1.0, 0.0]], "z_phi": [[-1.0, 0.0]]}
"""With W = 0 the error is (1, 0), so that g_hw = 2 error s' = [[2, 0], [0, 0]]."""
PULL = [[-3.0, 4.0]]
"""With ONE_PAIR g_task = [[-3, 0], [4, 0]]: it conflicts with g_hw, their cosine is -3 / 5."""


def state_with(weight: list[list[float]], alpha: float = 1.0, projection: Projection = "none") -> State:
    """Return a state whose method says alpha = 1 and no projection, and in which a user has set others."""
    state = started()
    assert (state.alpha, state.projection) == (1.0, "none")
    state.alpha, state.projection = alpha, projection
    state.proxy = proxy(weight)
    return state


def improve(
    state: State, pull: Any, ppo: Ppo = BATCH_OF_ALL, shown: int = 1, metric: Metric | None = None, **pairs: Any
) -> ProxyUpdate:
    sampled = pairs_of(z=pairs["z_phi"], **pairs)
    gradient = np.array(pull, dtype=np.float32)
    return state.hw_nn.improve(
        state,
        sampled,
        lambda m, index: gradient[index] / np.float32(len(m)),
        metric or Metric(),
        Multiplied(state.phi),
        ppo,
        shown,
    )


def test_each_squared_difference_counts_as_often_as_the_metric_says() -> None:
    state = state_with(ZERO, alpha=1.0)
    metric = Metric(np.array([[3.0, 1.0]]))
    update = improve(state, ZERO[:1], metric=metric, **ONE_PAIR)
    assert weights_of(state.hw_nn) == [[-6.0, 0.0], [0.0, 0.0]]
    assert update.divergence == 1.0  # people are told the distance itself
    # (error * weight) along s: g_task = (1, 1), g_hw = (3, 1) are seen by parameter
    both = {"s": [[1.0, 1.0]], "z_phi": [[-1.0, -1.0]]}
    update = improve(state_with(ZERO, alpha=0.0), [[1.0, 1.0]], metric=metric, **both)
    assert update.cosine == pytest.approx(4 / np.sqrt(2 * 10))


def test_the_weights_are_in_the_cosine_of_each_parameter() -> None:
    s, z_phi = [[1.0, 0.0], [1.0, 0.0]], [[-1.0, 0.0], [-1.0, 0.0]]
    metric = Metric(np.array([[3.0, 1.0], [1.0, 1.0]]))
    state = state_with(ZERO, alpha=0.0)
    update = improve(state, [[1.0, 0.0], [0.0, 0.0]], shown=2, metric=metric, s=s, z_phi=z_phi)
    error = np.array([weights_of(state.hw_nn)[0][0] + 1] * 2) * [3, 1]
    assert update.cosine_by_parameter == [pytest.approx(error[0] / np.linalg.norm(error), rel=1e-3), None]


@pytest.mark.parametrize(("weight", "step"), [(None, 2 * 5.0), ([[1.0, 0.5]], 5.0)])
def test_the_divergence_at_further_pairs_is_added(weight: Any, step: float) -> None:
    state = state_with(ZERO)
    further = pairs_of(s=[[0.0, 1.0]], z=[[0.0, 5.0]], z_phi=[[0.0, 5.0]])
    metric = Metric(None, further, None if weight is None else np.array(weight))
    improve(state, ZERO[:1], metric=metric, **ONE_PAIR)
    assert weights_of(state.hw_nn) == [[-2.0, 0.0], [0.0, step]]


@pytest.mark.parametrize(
    ("alpha", "projection", "gradient"),
    [
        (0.0, "none", [[-3, 0], [4, 0]]),
        (1.0, "none", [[-3 + 2, 0], [4, 0]]),
        (50.0, "none", [[-3 + 100, 0], [4, 0]]),
        (0.0, "one_sided", [[0, 0], [4, 0]]),
        (1.0, "one_sided", [[2, 0], [4, 0]]),
        (50.0, "one_sided", [[100, 0], [4, 0]]),
        (0.0, "as_printed", [[-3 + 6, 0], [4, 0]]),  # - (g_task . g_hw) / ||g_hw|| g_hw = 6 / 2 * 2
        (1.0, "as_printed", [[-3 + 6 + 2, 0], [4, 0]]),
    ],
)
def test_the_step_follows_alpha_and_the_projection_that_are_in_force(
    alpha: float, projection: Projection, gradient: list[list[float]]
) -> None:
    state = state_with(ZERO, alpha, projection)
    improve(state, PULL, **ONE_PAIR)
    assert np.allclose(weights_of(state.hw_nn), -np.array(gradient), atol=1e-5)


@pytest.mark.parametrize("projection", ["none", "one_sided", "as_printed"])
def test_gradients_that_agree_are_added_whatever_the_rule(projection: Projection) -> None:
    state = state_with(ZERO, 2.0, projection)
    improve(state, [[3.0, 4.0]], **ONE_PAIR)
    assert np.allclose(weights_of(state.hw_nn), [[-3 - 2 * 2, 0], [-4, 0]])


def test_the_divergences_gradient_is_the_mean_over_the_samples() -> None:
    state = state_with([[1.0, 0.0], [0.0, 1.0]])
    update = improve(state, np.zeros((2, 2)), s=[[1.0, 0.0], [0.0, 2.0]], z_phi=[[0.0, 0.0], [0.0, 5.0]])
    # errors (1, 0) and (0, -3); dD/dW = 2/2 (error_1 s_1' + error_2 s_2')
    assert np.allclose(weights_of(state.hw_nn), [[1 - 1, 0], [0, 1 + 6]])
    assert update.divergence == pytest.approx((1 + 9) / 2)


def test_divergence_distance_and_gradient_by_hand() -> None:
    z, target = np.array([[1.0, 2.0], [0.0, 0.0]]), np.array([[0.0, 0.0], [0.0, 3.0]])
    assert squared_distance(z, target).tolist() == [5.0, 9.0]
    assert divergence(z, target) == 7.0
    assert divergence_gradient(z, target).tolist() == [[1.0, 2.0], [0.0, -3.0]]
    variable = tensor(z).requires_grad_()
    divergence(variable, tensor(target)).backward()
    assert torch.equal(variable.grad, tensor([[1.0, 2.0], [0.0, -3.0]]))  # pyright: ignore[reportArgumentType]
    assert divergence(np.stack([z, target]), target).tolist() == [7.0, 0.0]


@pytest.mark.parametrize(("limit", "expected"), [(0.0, [-3.0, 0.5, 2.0]), (1.0, [-1.0, 0.5, 1.0])])
def test_a_limit_of_zero_is_none(limit: float, expected: list[float]) -> None:
    assert limited(np.array([-3.0, 0.5, 2.0]), limit).tolist() == expected


def test_an_update_says_how_the_gradients_agree() -> None:
    update = improve(state_with(ZERO), PULL, **ONE_PAIR)
    assert update.cosine == pytest.approx(-0.6)
    assert update.cosine_negative == 1.0
    assert update.divergence == pytest.approx(1.0)
    agreeing = improve(state_with(ZERO), [[3.0, 4.0]], **ONE_PAIR)
    assert (agreeing.cosine, agreeing.cosine_negative) == (pytest.approx(0.6), 0.0)


def test_agreement_along_each_parameter_is_told_of_the_pairs_that_are_shown_after_the_step() -> None:
    state = state_with(ZERO, alpha=0.0)
    state.hw_nn.optimizer = plain(state.hw_nn.proxy.parameters(), 0.0)
    pairs = {"s": [[1.0, 0.0], [1.0, 0.0], [1.0, 0.0]], "z_phi": [[-1.0, 0.0], [9.0, 0.0], [-1.0, 0.0]]}
    pull = [[-3.0, 0.0], [-3.0, 0.0], [1.0, 0.0]]
    # z_1 alone depends on phi_1, and phi_2 moves nothing where s_2 is 0
    assert improve(state, pull, shown=1, **pairs).cosine_by_parameter == [pytest.approx(-1), None]
    assert improve(state, pull, shown=2, **pairs).cosine_by_parameter == [
        pytest.approx((-3 + 1) / np.sqrt(10) / np.sqrt(2)), None,
    ]  # fmt: skip
    whole = [pytest.approx((-3 + 27 + 1) / np.sqrt(19) / np.sqrt(83)), None]
    assert improve(state, pull, shown=9, **pairs).cosine_by_parameter == whole


@pytest.mark.parametrize(("epochs", "minibatches"), [(1, 1), (3, 2), (2, 5)])
def test_every_minibatch_takes_a_step_and_the_search_learns_from_the_same(epochs: int, minibatches: int) -> None:
    class Told(Memory):
        def learn(self, features: Any, target: Any) -> None:
            assert torch.equal(features * tensor([2.0, 3.0]), target)
            given.extend(features[:, 0].tolist())

    given: list[float] = []
    steps: list[int] = []
    state = state_with(ZERO)
    state.memory = Told()
    state.hw_nn.optimizer = plain(state.hw_nn.proxy.parameters(), 0.001)
    state.hw_nn.optimizer.register_step_post_hook(lambda *_: steps.append(1))
    s = [[float(i), 1.0] for i in range(5)]
    ppo = dataclasses.replace(BATCH_OF_ALL, epochs=epochs, minibatches=minibatches)
    improve(state, np.zeros((5, 2)), ppo, s=s, z_phi=np.array(s) * [2.0, 3.0])
    assert len(steps) == epochs * minibatches
    assert sorted(given) == sorted([0.0, 1.0, 2.0, 3.0, 4.0] * epochs)


def test_both_gradients_are_those_of_the_proxy_as_it_is_before_each_step() -> None:
    state = state_with(ZERO)
    state.hw_nn.optimizer = plain(state.hw_nn.proxy.parameters(), 0.25)
    ppo = dataclasses.replace(BATCH_OF_ALL, epochs=2)
    update = improve(state, [[0.0, 0.0]], ppo, **ONE_PAIR)
    # the error halves with each step: 1, 1/2
    assert np.allclose(weights_of(state.hw_nn), [[-0.75, 0], [0, 0]])
    assert update.divergence == pytest.approx((1 + 0.25) / 2)


@pytest.mark.parametrize(
    ("rule", "expected"), [("none", [-3.0, 4.0]), ("one_sided", [0.0, 4.0]), ("as_printed", [3.0, 4.0])]
)
def test_projections_by_hand(rule: Projection, expected: list[float]) -> None:
    assert project(tensor([-3.0, 4.0]), tensor([2.0, 0.0]), rule).tolist() == pytest.approx(expected)
    assert project(tensor([3.0, 4.0]), tensor([2.0, 0.0]), rule).tolist() == [3.0, 4.0]
    assert project(tensor([3.0, 4.0]), tensor([0.0, 0.0]), rule).tolist() == [3.0, 4.0]


def test_cosines_by_hand() -> None:
    assert cosine(tensor([-3.0, 4.0]), tensor([2.0, 0.0])) == pytest.approx(-0.6)
    assert cosine(tensor([0.0, 0.0]), tensor([2.0, 0.0])) == 0.0


def test_a_flat_gradient_goes_back_to_where_its_pieces_came_from() -> None:
    layer = linear([[1.0, 2.0], [3.0, 4.0]], [5.0, 6.0])
    gradients = [tensor([[1.0, 2.0], [3.0, 4.0]]), tensor([5.0, 6.0])]
    assert flatten(gradients).tolist() == [1, 2, 3, 4, 5, 6]
    write_gradient(layer.parameters(), flatten(gradients))
    for p, gradient in zip(layer.parameters(), gradients, strict=True):
        assert torch.equal(p.grad, gradient)  # pyright: ignore[reportArgumentType]


# --- on the divergence alone ---


def test_learning_from_hw_phy_alone_is_a_step_on_the_divergence() -> None:
    hw_nn = proxy([[1.0, 0.0], [0.0, 1.0]])
    hw_nn.learn(tensor([[1.0, 0.0], [0.0, 2.0]]), tensor([[0.0, 0.0], [0.0, 5.0]]))
    hw_nn.learn(tensor([[1.0, 0.0]]), tensor([[3.0, 0.0]]))  # nothing is left of the first gradient
    assert np.allclose(weights_of(hw_nn), [[0 + 6, 0], [0, 7]])


class Remembered(torch.optim.SGD):
    """Gradient descent that notes its rate at every step."""

    rates: list[float]

    def step(self, closure: Any = None) -> None:
        self.rates.append(self.param_groups[0]["lr"])
        super().step(closure)


@pytest.fixture
def rates(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return the rates of all steps of the optimisers that are made from now on."""
    rates: list[float] = []
    monkeypatch.setattr(torch.optim, "Adam", type("Noting", (Remembered,), {"rates": rates}))
    return rates


def test_the_fit_before_line_1_anneals_its_rate_to_almost_nothing(rates: list[float]) -> None:
    hw_nn = proxy(ZERO, fit=ProxyFit(prefit=4, prefit_pairs=8, prefit_learning_rate=0.1))
    steps = hw_nn.fit(Multiplied(np.array([1.0, 2.0])), np.random.default_rng(0))
    assert rates == pytest.approx([0.1 + 1e-5, 0.075 + 1e-5, 0.05 + 1e-5, 0.025 + 1e-5])
    assert steps == 4 * 8


@pytest.mark.usefixtures("rates")
def test_the_first_step_of_the_fit_is_that_of_the_divergence_over_the_workspace() -> None:
    hw_nn = proxy(ZERO, fit=ProxyFit(prefit=1, prefit_pairs=8, prefit_learning_rate=0.1))
    hw_nn.fit(Multiplied(np.array([1.0, 2.0])), np.random.default_rng(0))
    s = Scales().sample_pairs(8, np.random.default_rng(0))[0][:, :2]
    z = s * np.array([1.0, 2.0])
    assert np.allclose(weights_of(hw_nn), (0.1 + 1e-5) * 2 * z.T @ s / 8, atol=1e-6)


def test_what_can_not_be_simulated_is_left_out_of_the_fit_and_yet_counted(rates: list[float]) -> None:
    def brittle(s: np.ndarray, _: np.ndarray) -> np.ndarray:
        return np.where(s[:, :1] > threshold, np.nan, s[:, :2])

    threshold = 0.0
    hw_nn = proxy([[1.0, 0.0], [0.0, 1.0]], fit=ProxyFit(prefit=3, prefit_pairs=8))
    assert hw_nn.fit(brittle, np.random.default_rng(0)) == 24
    assert np.allclose(weights_of(hw_nn), np.eye(2))
    assert len(rates) == 3
    threshold = -100.0
    assert hw_nn.fit(brittle, np.random.default_rng(0)) == 24
    assert len(rates) == 3  # there was nothing to learn from


def test_the_proxy_is_fitted_once_and_again_after_phi_was_moved_by_hand() -> None:
    state = started(replaced(proxy=ProxyFit(prefit=2, prefit_pairs=8)))
    told: list[HwNN] = []
    state.memory.proxy_was_fitted = told.append  # pyright: ignore[reportAttributeAccessIssue]
    state.fit_proxy(Scales())
    once = copy.deepcopy(state.hw_nn.proxy.state_dict())
    state.fit_proxy(Scales())
    assert (state.fitted, state.relabelled_steps, told) == (True, 16, [state.hw_nn])
    assert all(torch.equal(once[name], weight) for name, weight in state.hw_nn.proxy.state_dict().items())
    state.fitted = False
    state.fit_proxy(Scales())
    assert state.relabelled_steps == 32
    assert any(not torch.equal(once[name], weight) for name, weight in state.hw_nn.proxy.state_dict().items())


# --- twins ---


def test_a_copy_has_the_weights_and_an_optimiser_of_its_own_that_has_seen_nothing() -> None:
    hw_nn = started(TINY).hw_nn
    hw_nn.learn(tensor([[1.0, 0.0]]), tensor([[3.0, 0.0]]))
    twin = copy.deepcopy(hw_nn)
    s, a = np.ones((2, 3)), np.zeros((2, 2))
    before = hw_nn(s, a)
    assert np.array_equal(twin(s, a), before)
    assert hw_nn.optimizer.state
    assert not twin.optimizer.state
    assert twin.optimizer.param_groups[0]["lr"] == TINY.proxy.learning_rate
    twin.learn(tensor([[1.0, 0.0]]), tensor([[3.0, 0.0]]))
    assert np.array_equal(hw_nn(s, a), before)
    assert not np.array_equal(twin(s, a), before)


def test_as_hardware_the_proxy_answers_in_doubles_without_a_gradient() -> None:
    z = proxy([[1.0, 2.0], [3.0, 4.0]])(np.array([[1.0, 10.0, 0.0]]), np.zeros((1, 2)))
    assert z.dtype == float
    assert z.tolist() == [[21.0, 43.0]]


def test_what_the_network_says_is_in_units_of_the_tasks_z() -> None:
    class Long(Scales):
        z_scale = 3.0

    hw_nn = HwNN(Long(), ProxyFit(), 4, torch.Generator().manual_seed(0))
    hw_nn.proxy.net = linear([[1.0, 0.0], [0.0, 2.0]])
    assert hw_nn(np.array([[1.0, 10.0, 0.0]]), np.zeros((1, 2))).tolist() == [[3.0, 60.0]]
