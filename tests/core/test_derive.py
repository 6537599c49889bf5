"""The search for phi: it finds the design that the data came from, and keeps to box and locks."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.config import Config
from morph_core.derive import Dataset, derive_design
from morph_core.tasks import make_task
from morph_core.tasks.reacher import LINKS, Reacher

lengths = st.lists(st.floats(0.05, 5.0), min_size=LINKS, max_size=LINKS).map(np.array)
THOROUGH = Config(search_generations=60, search_sigma=0.5)


def dataset_of(task: Reacher, phi: np.ndarray, pairs: int = 128) -> Dataset:
    s, a = task.sample_pairs(pairs, np.random.default_rng(0))
    return Dataset(s, a, task.hw_phy(phi)(s, a))


@pytest.mark.parametrize("search", ["cma", "gradient"])
@pytest.mark.parametrize("z", ["joints", "tip"])
def test_the_design_behind_the_data_is_found(search: str, z: str) -> None:
    task = Reacher(z=z)  # pyright: ignore[reportArgumentType]
    true = np.array([2.5, 2.1, 0.66, 1.0, 2.3])  # the paper's arm
    config = dataclasses.replace(THOROUGH, search=search)
    phi, cost = derive_design(task, task.design_space, dataset_of(task, true), task.design_space.initial, config, 1)
    assert phi == pytest.approx(true, abs=0.05)
    assert cost < 0.01


@settings(max_examples=15)
@given(lengths, st.sampled_from(["cma", "gradient"]))
def test_the_search_keeps_to_bounds_and_locks_and_never_gets_worse(true: np.ndarray, search: str) -> None:
    task = Reacher()
    space = task.design_space.with_bound("link_2", 1.0, 1.5).with_lock("link_4", 3.0)
    data = dataset_of(task, true, 32)
    start = space.initial
    before = float(((task.hw_phy(start)(data.s, data.a) - data.z) ** 2).sum(-1).mean())
    phi, cost = derive_design(task, space, data, start, Config(search=search, search_generations=5), 1)
    space.check(phi)
    assert phi[3] == 3.0
    assert cost <= before + 1e-12


@pytest.mark.parametrize("free", [0, 1])
def test_a_search_with_hardly_anything_free_works(free: int) -> None:
    task = make_task("reacher")
    space = task.design_space
    for name in space.names[free:]:
        space = space.with_lock(name, 2.0)
    data = dataset_of(Reacher(), np.array([1.0, 2.0, 2.0, 2.0, 2.0]))
    phi, _ = derive_design(task, space, data, space.initial, Config(), 1)
    assert phi == pytest.approx([1.0 if free else 2.0, 2.0, 2.0, 2.0, 2.0], abs=0.03)


def test_the_search_is_repeatable() -> None:
    task = make_task("reacher")
    data = dataset_of(Reacher(), np.full(LINKS, 1.0))
    once, again = (derive_design(task, task.design_space, data, task.design_space.initial, Config(), 7) for _ in "ab")
    assert np.array_equal(once[0], again[0])
