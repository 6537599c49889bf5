"""What a task is, and what hardware is: the two protocols that everything else is written against."""

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

from morph_core.config import Settings
from morph_core.design import DesignSpace


class Hardware(Protocol):
    """h(z | s, a): either Hw-Phy or Hw-NN."""

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return z (N, z_size) for states s (N, state_size) and executed actions a (N, action_size), physical units."""
        ...


class DifferentiableHardware(Hardware, Protocol):
    """Hw-Phy whose z can be differentiated in phi."""

    def jacobian(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return dz/dphi (N, z_size, d)."""
        ...


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
    """name -> (N,), already weighted."""
    terminated: np.ndarray
    """(N,) bool: the episode is over, as the task has it."""
    diverged: np.ndarray
    """(N,) bool: the physics failed, or the design can't be simulated; z is NaN if there is none."""
    success: np.ndarray
    """(N,) bool: the goal was reached in this step."""
    milestones: dict[str, np.ndarray]
    """name -> (N,) bool: what has to come before the goal, in this order."""
    contact: np.ndarray
    """(N, C, 3) m: up to C points where the robot touches something in this step, NaN for none."""


class Task(Protocol):
    """A robot with a goal. Stateless: all that changes is in s; all randomness comes from a Generator argument."""

    @property
    def name(self) -> str: ...

    @property
    def title(self) -> str:
        """A few words for people."""
        ...

    @property
    def tuned(self) -> tuple[Settings, ...]:
        """Settings that were found to work for this task: methods, and parts that a method may be given instead of
        its own, such as another search. Whatever is not among them has its own defaults."""
        return ()

    @property
    def design_space(self) -> DesignSpace: ...

    @property
    def horizon(self) -> int:
        """T: control steps after which an episode ends."""
        ...

    @property
    def control_dt(self) -> float:
        """Seconds between two control steps, for playback."""
        ...

    @property
    def state_size(self) -> int: ...

    @property
    def observation_size(self) -> int: ...

    @property
    def action_size(self) -> int: ...

    @property
    def initial_action(self) -> np.ndarray:
        """(action_size,) the mean action of a policy that has learnt nothing."""
        ...

    @property
    def z_size(self) -> int: ...

    @property
    def proxy_input_size(self) -> int: ...

    @property
    def z_scale(self) -> float:
        """Typical size of z: the proxy's output is multiplied by it."""
        ...

    @property
    def z_unit(self) -> str:
        """The unit of z; empty where every component is in its own."""
        ...

    @property
    def runs_on_proxy(self) -> bool:
        """Whether `reset` and `step` take any Hardware, the proxy included, and not Hw-Phy alone."""
        return True

    def buildable(self, phi: np.ndarray) -> np.ndarray:
        """Tell (...) which designs (..., d) can be put together at all."""
        ...

    def check_buildable(self, phi: np.ndarray) -> None:
        """Raise ValueError with the reason where a design (d,) can't be put together."""
        ...

    def hw_phy(self, phi: np.ndarray) -> Hardware:
        """Return F_phi for one design (d,), or for one design per environment (N, d)."""
        ...

    def reset(self, hw_phy: Hardware, environments: int, rng: np.random.Generator) -> np.ndarray:
        """Return start states (N, state_size)."""
        ...

    def observe(self, s: np.ndarray) -> np.ndarray:
        """Return what the policy sees, (N, observation_size) float32; phi is not in it."""
        ...

    def proxy_input(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return what the proxy sees, (N, proxy_input_size) float32."""
        ...

    def sample_pairs(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return states and executed actions (s, a) spread over the workspace, to fit the proxy before line 1."""
        ...

    def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
        """Execute the policy's actions (N, action_size), clipped into [-1, 1], in the world of `hardware`."""
        ...

    def solved(self, reached: np.ndarray) -> np.ndarray:
        """Tell (N,) which episodes count as successful, from the steps (T, N) in which the goal was reached."""
        ...

    def spec(self, phi: np.ndarray) -> mujoco.MjSpec:
        """Return the robot alone with design phi (d,): what is exported."""
        ...

    def scene(self, phi: np.ndarray) -> mujoco.MjSpec:
        """Return robot, objects, obstacles and goal: what is shown. The names of what never moves begin with "goal",
        "wall" or "table"; a geom "button" lights up with the milestone "pressed"."""
        ...

    def qpos(self, s: np.ndarray) -> np.ndarray:
        """Return MuJoCo's qpos (N, nq) of `scene` for states s; it begins with the qpos of `spec`."""
        ...
