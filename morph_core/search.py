"""Lines 4-6 of Algorithm 1: the dataset relabelled by the proxy, and what a search for phi (Eq. 3) is."""

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np

from morph_core.config import Count, Settings, most
from morph_core.design import DesignSpace
from morph_core.divergence import squared_distance
from morph_core.rollout import Rollout
from morph_core.spread import Spread, nearest_buildable
from morph_core.task import Hardware, Task

if TYPE_CHECKING:
    from morph_core.hw_nn import HwNN
    from morph_core.state import State


@dataclass(frozen=True)
class Dataset:
    """Dataset D of Algorithm 1 (line 5): sampled (s, a) with the z that the proxy says."""

    s: np.ndarray  # (n, state_size)
    a: np.ndarray  # (n, action_size)
    z: np.ndarray  # (n, z_size)


class Memory:
    """What a search for phi keeps from one iteration to the next; one that keeps nothing has this empty one."""

    @property
    def learners(self) -> Mapping[str, "HwNN"]:
        """Return networks with their optimisers by name: a checkpoint holds them, learning rates are set for them."""
        return {}

    @property
    def facts(self) -> dict[str, object]:
        """Return whatever else is kept, as JSON has it: a checkpoint holds it."""
        return {}

    def recall(self, facts: dict[str, Any]) -> None:
        """Take back the `facts` that a checkpoint held."""

    def proxy_was_fitted(self, hw_nn: "HwNN") -> None:
        """Take note that the proxy has just been fitted to Hw-Phy."""

    def learn(self, features: Any, target: Any) -> None:
        """Learn from a minibatch of the proxy: tensors of its features, and of F_phi(s, a)."""

    def phi_was_found(self, hw_nn: "HwNN") -> None:
        """Take note that phi has just moved to where this search took it."""


@dataclass(frozen=True)
class Problem:
    """Problem of one search for phi (Eq. 3), as `Search.candidates` is given it."""

    physics: "Physics"
    space: DesignSpace
    dataset: Dataset
    start: np.ndarray  # (d,) the present phi, inside the box
    spread: Spread
    """The distribution of the explored designs around phi."""
    memory: Memory
    seed: int


@dataclass(frozen=True)
class Search(Settings, ABC):
    """How phi is searched for, so that Hw-Phy matches the proxy (Eq. 3)."""

    pairs: Annotated[Count, most(65_536, "each candidate simulates them all at once")] = 512
    """Relabelled (s, a) pairs on which a candidate phi is compared with the proxy."""

    name: ClassVar[str]
    """Name that chooses the search on the command line, in files and on screen."""

    def check(self, task: Task) -> None:
        """Raise ValueError with the reason where the task's phi can't be searched for so."""
        return

    def memory(self, hw_nn: "HwNN") -> Memory:
        """Return what the search keeps from one iteration to the next, as it is before the first."""
        return Memory()

    @abstractmethod
    def candidates(self, problem: Problem) -> np.ndarray:
        """Return phi (P, d) of which the one of least divergence is taken: the present phi among them, unless the
        search is to be followed whatever the divergence says."""


class Physics:
    """Hw-Phy of many designs at once, its steps counted."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.steps = 0
        self.generation: np.ndarray | None = None  # (P, d)
        """The designs that the last generation of a search tried, for people; None where it has no generations."""

    def z(self, s: np.ndarray, a: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        """Return z (P, n, z_size) of candidates phi (P, d) for (s, a) (n, ...), all of them in one batch."""
        return self.z_each(s, a, np.repeat(candidates[:, None], len(s), 1))

    def z_each(self, s: np.ndarray, a: np.ndarray, designs: np.ndarray) -> np.ndarray:
        """Return z (P, n, z_size) for (s, a) (n, ...), each time with a design of its own for each pair (P, n, d)."""
        count, pairs = designs.shape[:2]
        self.steps += count * pairs
        hw_phy = self.task.hw_phy(designs.reshape(count * pairs, -1))
        return hw_phy(np.tile(s, (count, 1)), np.tile(a, (count, 1))).reshape(count, pairs, -1)

    def costs(self, dataset: Dataset, candidates: np.ndarray) -> np.ndarray:
        """Return the divergence (P,) of Hw-Phy with each candidate phi (P, d)."""
        return mean_over_pairs(squared_distance(self.z(dataset.s, dataset.a, candidates), dataset.z))


def mean_over_pairs(cost: np.ndarray) -> np.ndarray:
    """Return the mean (P,) of what candidates cost at pairs (P, n).

    Where a candidate's simulation diverges, it counts as far from the dataset as the farthest that did not.
    """
    sound = np.isfinite(cost)
    return np.where(sound, cost, cost[sound].max() if sound.any() else np.inf).mean(-1)


def relabel(rollout: Rollout, hw_nn: Hardware, pairs: int, rng: np.random.Generator) -> Dataset:
    """Line 5: sample (s, a) of the rollout, some of them more than once, and label them with the updated proxy.

    The actions are those that were executed, which the policy chose before line 3 changed it.
    """
    t, n = rollout.alive.nonzero()
    chosen = rng.integers(len(t), size=pairs)
    s, a = rollout.s[t[chosen], n[chosen]], rollout.a[t[chosen], n[chosen]]
    return Dataset(s, a, hw_nn(s, a))


def derive_design(task: Task, state: "State", dataset: Dataset, search: Search, spread: Spread) -> float:
    """Line 6: move phi to where the search finds it from the present one, inside the box, locked entries kept.

    Return the divergence of Hw-Phy with the new phi from the dataset.
    """
    began, seed = time.monotonic(), int(state.rng.integers(1, 2**31))
    space, physics = state.design_space, Physics(task)
    phi = space.clip(state.phi)
    candidates = phi[None]
    if space.free.any():
        candidates = search.candidates(Problem(physics, space, dataset, phi, spread, state.memory, seed))
    candidates = np.stack([nearest_buildable(task, phi, candidate) for candidate in candidates])
    costs = physics.costs(dataset, candidates)
    best = int(np.argmin(costs))
    state.memory.phi_was_found(state.hw_nn)
    state.phi = candidates[best]
    state.search_steps += physics.steps
    if physics.generation is not None:
        state.generation = physics.generation
    state.searched_in = time.monotonic() - began
    return float(costs[best])
