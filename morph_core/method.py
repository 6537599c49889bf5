"""What a method is: a frozen dataclass whose fields are its settings, and which yields one Progress per iteration."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

from msgspec import Meta

from morph_core.config import Count, Projection, Settings, most
from morph_core.exploration import Notes
from morph_core.parts import Evaluation, Ppo, ProxyFit, Schedule
from morph_core.protocol import Progress
from morph_core.search import Memory
from morph_core.task import Task

if TYPE_CHECKING:
    import torch

    from morph_core.control import Control
    from morph_core.hw_nn import HwNN
    from morph_core.state import State


@dataclass(frozen=True)
class Method(Settings, ABC):
    """A way to find a design and its policy.

    Methods are built from the same parts, so that a comparison compares the methods and not their PPO. Where the paper
    has a symbol for a setting, the setting's docstring begins with it.
    """

    trajectories: Annotated[int, Meta(ge=2, multiple_of=2), most(16_384, "a rollout is kept in memory whole")] = 128
    """H: episodes sampled per iteration; even, because designs are explored in antithetic pairs."""
    hidden: Annotated[Count, most(2048, "wider layers take seconds for a single gradient step on one core")] = 64
    """Width of both hidden layers of policy, critic and proxy."""
    schedule: Schedule = Schedule()
    """Schedule by which learning rates and noises fall."""
    ppo: Ppo = Ppo()
    """PPO (Schulman et al. 2017), by which policy and critic learn."""
    evaluation: Evaluation = Evaluation()
    """Evaluations, which measure success on Hw-Phy."""

    name: ClassVar[str]
    """Name that chooses the method on the command line, in files and on screen."""
    title: ClassVar[str]
    """Clause that tells people what the method does."""
    sees_phi: ClassVar[bool] = False
    """Whether policy and critic see phi beside the observation, so that one policy acts on many designs."""
    ends_at_best: ClassVar[bool] = False
    """Whether the method's outcome is the best design that was evaluated, with its policy, and not the last one."""

    @property
    def proxy_fit(self) -> ProxyFit | None:
        """Return the settings by which the proxy is fitted; None for a method without a proxy."""
        return None

    @property
    def steering(self) -> tuple[float, Projection]:
        """Return alpha and the projection rule with which a run starts; users may change both while it runs."""
        return 0.0, "none"

    def control(self, task: Task, weights: "torch.Generator") -> "Control":
        """Return policy and critic as they are before anything is learnt, initialised from `weights`."""
        from morph_core.control import Control

        return Control(task, self.ppo, self.schedule, self.hidden, weights, self.sees_phi)

    def memory(self, proxy: "HwNN | None") -> Memory:
        """Return what the method's search for phi keeps from one iteration to the next, as it is at the start."""
        return Memory()

    def notes(self) -> Notes:
        """Return what the method's exploration keeps from one iteration to the next, as it is at the start."""
        return Notes()

    def check(self, task: Task) -> None:
        """Raise ValueError with the reason where the task can't be run so."""
        return

    def rules(self) -> str:
        """Return in a few words, for people, how phi is found."""
        return self.title

    @property
    def search_interval(self) -> int:
        """Return the number of iterations from one search for phi to the next; 1 where every iteration has one, or
        none has."""
        return 1

    @property
    def freezes(self) -> bool:
        """Tell whether success freezes phi, after which it is searched no more."""
        return False

    def prepare(self, task: Task, state: "State") -> None:
        """Do what is needed once before the first iteration, which does it otherwise."""
        return

    @abstractmethod
    def iterations(self, task: Task, state: "State") -> Iterator[Progress]:
        """Yield one Progress per iteration, for ever; between two of them `state` is the caller's to read and to edit.

        Nothing in it prints, logs, saves or sleeps, and it leaves `state` whole, so that pausing, saving, resuming
        and editing need nothing from it.
        """
