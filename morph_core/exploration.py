"""What an exploration of z is: a world to collect trajectories in (line 2), and a pull on the proxy (line 3)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from morph_core.config import Settings
from morph_core.parts import Schedule
from morph_core.rollout import Rollout, collect
from morph_core.spread import Spread
from morph_core.task import Hardware, Task

if TYPE_CHECKING:
    from morph_core.state import State

Pull = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function that takes proxy outputs m (B, z_size) of the pairs with indices (B,) and returns dL_task/dm (B, z_size);
all are float32."""


@dataclass(frozen=True)
class Relabelled:
    """Sampled (s, a) of a rollout with what the explored world and Hw-Phy with the present phi say of them."""

    row: np.ndarray  # (B,) int, among the rollout's steps alive
    episode: np.ndarray  # (B,) int
    s: np.ndarray  # (B, state_size)
    a: np.ndarray  # (B, action_size)
    z: np.ndarray  # (B, z_size)
    z_phi: np.ndarray  # (B, z_size) F_phi(s, a)
    steps: int
    """Steps of Hw-Phy that the relabelling took."""

    def __len__(self) -> int:
        return len(self.row)


@dataclass(frozen=True)
class Metric:
    """How D is measured in one iteration: what each pair weighs, and at which further pairs."""

    weight: np.ndarray | None = None  # (B, z_size)
    """How often each squared difference of the sampled pairs counts; None counts each once."""
    further: Relabelled | None = None
    """Pairs that are not of the rollout, whose D is added to that of the sampled pairs."""
    further_weight: np.ndarray | None = None  # (B', z_size)


class Notes:
    """What an exploration keeps from one iteration to the next; one that keeps nothing has these empty ones."""

    @property
    def arrays(self) -> Mapping[str, np.ndarray]:
        """Return by name what a checkpoint holds of it."""
        return {}

    def recall(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take back the `arrays` that a checkpoint held."""


@dataclass(frozen=True)
class Exploration(Settings, ABC):
    """How z is explored, so that the policy gradient can reach psi."""

    name: ClassVar[str]
    """Name that chooses the exploration on the command line, in files and on screen."""

    def check(self, task: Task) -> None:
        """Raise ValueError with the reason where the task can't be explored so."""
        return

    def notes(self) -> Notes:
        """Return what the exploration keeps from one iteration to the next, as it is before the first."""
        return Notes()

    @property
    def proxy_rests(self) -> bool:
        """Return whether the proxy learns no more once phi is frozen."""
        return False

    @abstractmethod
    def spread(self, schedule: Schedule, iteration: int, frozen: bool) -> Spread:
        """Return the distribution of designs around phi in an iteration, of which a search may draw, too."""

    def sigma_shown(self, spread: Spread) -> float | None:
        """Return Sigma of the designs that are explored, to be shown to people; None where none are."""
        return None

    @abstractmethod
    def world(self, task: Task, state: "State", spread: Spread, trajectories: int) -> Hardware:
        """Line 2: return the hardware in whose world this iteration's trajectories run."""

    @abstractmethod
    def pull(self, state: "State", rollout: Rollout, pairs: Relabelled, advantage: np.ndarray) -> Pull:
        """Line 3: return the gradient of the task's loss in the proxy's outputs.

        `advantage` (B',) float32 holds the standardised advantages of all steps alive of the rollout.
        """

    def metric(self, task: Task, state: "State", pairs: Relabelled, hw_phy: Hardware) -> Metric:
        """Line 3: return how D is measured; by default as the mean squared distance at the sampled pairs."""
        return Metric()

    def success(self, task: Task, state: "State", rollout: Rollout, level: float) -> float:
        """Return the success that freezes phi from `level` on; by default that of this iteration's trajectories."""
        return rollout.success_rate

    def prepare(self, task: Task, state: "State", spread: Spread, rollout: Rollout) -> None:
        """Note at the end of an iteration what the next one's world needs of this rollout."""
        return


def run_trajectories(
    task: Task, state: "State", world: Hardware, trajectories: int, designs: np.ndarray | None = None
) -> Rollout:
    """Line 2: sample H trajectories of the present policy in a world.

    A policy that sees phi sees the `designs` (H, d) of the episodes, or the present phi where none are given.
    """
    policy = state.control.policy
    start = task.reset(world, trajectories, state.rng)
    seen = None
    if policy.sees_phi:
        seen = policy.phi_seen(np.tile(state.phi, (trajectories, 1)) if designs is None else designs)
    return collect(task, lambda observation: policy.act(observation, state.rng), world, start, seen)


def relabel_on_hardware(rollout: Rollout, hw_phy: Hardware, pairs: int, rng: np.random.Generator) -> Relabelled:
    """Sample (s, a), or take all where `pairs` is 0, and ask Hw-Phy; those whose simulation diverges are left out."""
    t, n = rollout.alive.nonzero()
    row = np.arange(len(t))
    if 0 < pairs < len(row):
        row = np.sort(rng.choice(row, pairs, replace=False))
    at = t[row], n[row]
    z_phi = hw_phy(rollout.s[at], rollout.a[at])
    sound = np.isfinite(z_phi).all(1)
    at = at[0][sound], at[1][sound]
    return Relabelled(row[sound], at[1], rollout.s[at], rollout.a[at], rollout.z[at], z_phi[sound], len(row))
