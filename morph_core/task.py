"""What a task is, and what hardware is: the two protocols that everything else is written against."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import mujoco
import numpy as np

from morph_core.config import Settings
from morph_core.design import DesignSpace


class Hardware(Protocol):
    """Hardware model h(z | s, a): either Hw-Phy or Hw-NN."""

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return z (N, z_size) for states s (N, state_size) and executed actions a (N, action_size), physical units."""
        ...


@runtime_checkable
class DifferentiableHardware(Hardware, Protocol):
    """Hw-Phy whose z can be differentiated in phi."""

    def jacobian(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return dz/dphi (N, z_size, d)."""
        ...


@runtime_checkable
class HardwareOfEpisodes(Hardware, Protocol):
    """Hardware that differs between the episodes that run on it, and can be asked about some of them.

    Called itself, it expects pairs (s, a) of all episodes, once or several times over.
    """

    def of(self, episodes: np.ndarray) -> Hardware:
        """Return the hardware of the episodes with these indices (M,), for M pairs (s, a), or any multiple of M."""
        ...


Watch = Callable[[np.ndarray, np.ndarray], None]
"""Function that is shown every step of the physics: the joints' speeds (N, nv) at its start, in m/s or rad/s, and the
forces (N, nu) of the actuators, in N or N m, with which it begins."""


@runtime_checkable
class WatchedHardware(Hardware, Protocol):
    """Hw-Phy that MuJoCo simulates, and that can be watched at it."""

    watch: Watch | None
    """Function that is shown every step of the physics; None where nobody watches."""


@dataclass(frozen=True)
class Transition:
    """One control step of N environments."""

    s: np.ndarray
    """(N, state_size) the next states."""
    a: np.ndarray
    """(N, action_size) what was executed, in physical units: contact may have cut it short."""
    z: np.ndarray
    """(N, z_size) the hardware's output for (s, a)."""
    reward: np.ndarray
    """(N,) the sum of `reward_terms`."""
    reward_terms: dict[str, np.ndarray]
    """Terms of the reward by name, (N,) each, already weighted."""
    terminated: np.ndarray
    """(N,) bool: the episode is over, as the task has it."""
    diverged: np.ndarray
    """(N,) bool: the physics failed, or the design can't be simulated; z is NaN if there is none."""
    success: np.ndarray
    """(N,) bool: the goal was reached in this step."""
    contact: np.ndarray
    """(N, C, 3) m: up to C points where the robot touches something in this step, NaN for none."""
    milestones: dict[str, np.ndarray] = field(default_factory=dict)
    """Milestones that have to come before the goal, by name and in this order: (N,) bool each, whether it was reached
    in this step. Empty for a goal without any."""


class Task(Protocol):
    """A robot with a goal. Stateless: all that changes is in s; all randomness comes from a Generator argument.

    A task inherits from this class: what is abstract must be given, the rest has a default that suits a simple task.
    """

    @property
    @abstractmethod
    def name(self) -> str:
        """The task's name on the command line, in files and on screen: lower case, words joined by underscores."""
        ...

    @property
    def title(self) -> str:
        """Title of the task for people, in a few words."""
        return self.name.replace("_", " ")

    @property
    def success_rule(self) -> str:
        """A sentence for people: when an episode counts as successful. Empty where nothing is to be said."""
        return ""

    @property
    def tuned(self) -> tuple[Settings, ...]:
        """Settings that were found to work for this task: methods, and parts that a method may be given instead of
        its own, such as another search. Whatever is not among them has its own defaults."""
        return ()

    @property
    @abstractmethod
    def design_space(self) -> DesignSpace:
        """The design parameters phi: names, units, box, initial values and locks."""
        ...

    @property
    @abstractmethod
    def horizon(self) -> int:
        """T: control steps after which an episode ends."""
        ...

    @property
    @abstractmethod
    def control_dt(self) -> float:
        """Seconds between two control steps, for playback."""
        ...

    @property
    @abstractmethod
    def state_size(self) -> int:
        """Number of entries of a state s."""
        ...

    @property
    @abstractmethod
    def observation_size(self) -> int:
        """Number of entries of an observation, which the policy sees."""
        ...

    @property
    def observation_units(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Middle and spread, (observation_size,) each: `observe` returns (x - middle) / spread, where x are the first
        entries of s, or what the task makes of them, in physical units. None where it is not of this form.

        Where x are the first entries of s, and those are qpos and qvel of `scene`, an exported policy runs in MuJoCo.
        """
        return None

    @property
    @abstractmethod
    def action_size(self) -> int:
        """Number of entries of an action, which the policy puts out."""
        ...

    @property
    def action_units(self) -> np.ndarray | None:
        """(action_size,) what an action of 1 asks for: a = action_units * action, unless contact cuts it short.
        None where a is not proportional to the action.

        A program that runs an exported policy hands a to the actuators of `scene`, or adds it to the joints where there
        are no actuators.
        """
        return None

    @property
    def initial_action(self) -> np.ndarray:
        """(action_size,) the mean action of a policy that has learnt nothing."""
        return np.zeros(self.action_size)

    @property
    @abstractmethod
    def z_size(self) -> int:
        """Number of entries of z, which the hardware puts out."""
        ...

    @property
    def proxy_input_size(self) -> int:
        """Number of entries of what the proxy sees of (s, a)."""
        return self.observation_size + self.action_size

    @property
    def z_scale(self) -> float:
        """Typical size of z, by which the proxy's output is multiplied."""
        return 1.0

    @property
    def z_unit(self) -> str:
        """The unit of z; empty where every component is in its own."""
        return ""

    @property
    def runs_on_proxy(self) -> bool:
        """Whether `reset` and `step` take any Hardware, the proxy included, and not Hw-Phy alone."""
        return True

    @property
    def robot(self) -> object | None:
        """The kind of robot, such as `Hand` or `Arm`, where the studio knows how its parts are printed and its policy
        is run; None for any other, whose collision shapes stand in for parts."""
        return None

    def buildable(self, phi: np.ndarray) -> np.ndarray:
        """Tell (...) which designs (..., d) can be put together at all."""
        return np.ones(phi.shape[:-1], dtype=bool)

    def check_buildable(self, phi: np.ndarray) -> None:
        """Raise ValueError with the reason where a design (d,) can't be put together."""
        if not self.buildable(phi):
            raise ValueError(f"this design of {self.name} can't be put together")

    @abstractmethod
    def hw_phy(self, phi: np.ndarray) -> Hardware:
        """Return F_phi for one design (d,), or for one design per environment (N, d)."""
        ...

    def hw_phy_from(self, scene: mujoco.MjSpec, phi: np.ndarray) -> Hardware:
        """Return F_phi with the robot of a `scene` that was read from an exported file, made for phi (d,).

        This is how an export proves that its files do what was learned; a task that can't tell from the scene what its
        hardware computes with returns that of phi.
        """
        return self.hw_phy(phi)

    @abstractmethod
    def reset(self, hw_phy: Hardware, environments: int, rng: np.random.Generator) -> np.ndarray:
        """Return start states (N, state_size)."""
        ...

    @abstractmethod
    def observe(self, s: np.ndarray) -> np.ndarray:
        """Return what the policy sees, (N, observation_size) float32; phi is not in it."""
        ...

    def proxy_input(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return what the proxy sees, (N, proxy_input_size) float32: by default what the policy sees, and a."""
        units = self.action_units
        return np.concatenate([self.observe(s), a if units is None else a / units], 1, dtype=np.float32)

    @abstractmethod
    def sample_pairs(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return states and executed actions (s, a) spread over the workspace, to fit the proxy before line 1."""
        ...

    @abstractmethod
    def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
        """Execute the policy's actions (N, action_size), clipped into [-1, 1], in the world of `hardware`."""
        ...

    def solved(self, reached: np.ndarray) -> np.ndarray:
        """Tell (N,) which episodes count as successful, from the steps (T, N) in which the goal was reached.

        By default those in which it was reached at all.
        """
        return np.any(reached, axis=0)

    @abstractmethod
    def spec(self, phi: np.ndarray) -> mujoco.MjSpec:
        """Return the robot alone with design phi (d,): what is exported."""
        ...

    @abstractmethod
    def scene(self, phi: np.ndarray) -> mujoco.MjSpec:
        """Return robot, objects, obstacles and goal: what is shown. The names of what never moves begin with "goal",
        "wall" or "table"; a geom "button" lights up with the milestone "pressed"."""
        ...

    @abstractmethod
    def qpos(self, s: np.ndarray) -> np.ndarray:
        """Return MuJoCo's qpos (N, nq) of `scene` for states s; it begins with the qpos of `spec`."""
        ...

    def qvel(self, s: np.ndarray) -> np.ndarray | None:
        """Return MuJoCo's qvel (N, nv) of `scene` for states s; None where MuJoCo does not simulate the task."""
        return None

    def ctrl(self, s: np.ndarray, a: np.ndarray) -> np.ndarray | None:
        """Return MuJoCo's ctrl (N, nu) of `scene` while the actions a are executed from states s on; None where MuJoCo
        does not simulate the task."""
        return None
