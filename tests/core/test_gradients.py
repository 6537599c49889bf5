"""Cosine and projection: the paper's rule, its printed form, and no NaN."""

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from torch import Tensor

from morph_core.gradients import cosine, project

vectors = st.lists(st.floats(-10, 10, width=32), min_size=4, max_size=4).map(torch.tensor)


@given(vectors, vectors)
def test_one_sided_projection_never_conflicts_afterwards(g_task: Tensor, g_hw: Tensor) -> None:
    projected = project(g_task, g_hw, "one_sided")
    assert float(projected @ g_hw) >= -1e-3 * (1 + float(g_task.norm() * g_hw.norm()))


@given(vectors, vectors)
def test_projection_leaves_agreeing_gradients_alone(g_task: Tensor, g_hw: Tensor) -> None:
    assume(g_task @ g_hw >= 0)
    for rule in ("none", "one_sided", "as_printed"):
        assert torch.equal(project(g_task, g_hw, rule), g_task)


@given(vectors, vectors)
def test_none_changes_nothing(g_task: Tensor, g_hw: Tensor) -> None:
    assert torch.equal(project(g_task, g_hw, "none"), g_task)


@given(vectors)
def test_as_printed_is_one_sided_for_a_unit_gradient(g_task: Tensor) -> None:
    g_hw = torch.tensor([0.6, 0.0, -0.8, 0.0])
    assert torch.allclose(project(g_task, g_hw, "as_printed"), project(g_task, g_hw, "one_sided"), atol=1e-5)


def test_as_printed_overshoots_for_a_long_gradient() -> None:
    g_task, g_hw = torch.tensor([-1.0, 1.0]), torch.tensor([3.0, 0.0])
    assert project(g_task, g_hw, "one_sided").tolist() == pytest.approx([0.0, 1.0])
    assert project(g_task, g_hw, "as_printed").tolist() == pytest.approx([2.0, 1.0])  # -1 + 3 / 3 * 3


@given(vectors, vectors)
def test_the_cosine_is_one(g_task: Tensor, g_hw: Tensor) -> None:
    assert -1.001 <= cosine(g_task, g_hw) <= 1.001


def test_a_zero_gradient_makes_no_nan() -> None:
    zero, other = torch.zeros(3), torch.tensor([1.0, -2.0, 3.0])
    assert cosine(zero, other) == 0.0
    for rule in ("none", "one_sided", "as_printed"):
        assert torch.equal(project(other, zero, rule), other)
        assert torch.equal(project(zero, other, rule), zero)
