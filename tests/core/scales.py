"""A robot so small that its gradients, searches and rewards are known by hand, and what sets learning up on it."""

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import mujoco
import numpy as np
import torch
from msgspec import Meta
from torch import Tensor, nn

from morph_core.config import CountOrNone, Settings, Share
from morph_core.design import DesignSpace
from morph_core.exploration import Relabelled
from morph_core.hw_nn import HwNN
from morph_core.method import Method
from morph_core.methods.proxy import Morph
from morph_core.parts import Evaluation, Ppo, ProxyFit, Schedule
from morph_core.protocol import Parameter
from morph_core.rollout import Rollout
from morph_core.searches.cma import Cma
from morph_core.state import State, start
from morph_core.task import Hardware, Task, Transition

BATCH_OF_ALL = Ppo(epochs=1, minibatches=1, max_grad_norm=1e9, std=0.5, std_end=0.5)
"""One gradient step on everything, whose gradients are not clipped."""
TINY = Morph(
    trajectories=8, hidden=4, ppo=Ppo(epochs=1, minibatches=2), proxy=ProxyFit(prefit=0),
    schedule=Schedule(10), evaluation=Evaluation(2, 4), search=Cma(pairs=16, population=4, generations=2),
)  # fmt: skip
"""A method whose iterations take milliseconds."""


@dataclass(frozen=True)
class Multiplied:
    """Hw-Phy of `Scales`: z_i = phi_i s_i."""

    phi: np.ndarray  # (2,) or (N, 2)

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        return self.phi * s[:, :2]

    def jacobian(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        return s[:, :2, None] * np.eye(2)


@dataclass(frozen=True)
class Scales(Settings, Task):
    """Two scales: z_i = phi_i s_i. s holds two numbers, which stay, and the steps taken; a step pays z_1 + z_2."""

    ends: CountOrNone = 0
    """The step with which an episode ends, successfully; 0: none does."""
    succeeding: Share = 1.0
    """Share of the episodes that can end so."""
    near: Share = 0.0
    """Share of the episodes that reach the milestone "near" in their first step."""
    largest: Annotated[float, Meta(gt=0)] = 10.0
    """A design with a larger phi_1 can't be built."""
    grouped: bool = False
    """Whether both parameters are one group."""

    name: ClassVar[str] = "scales"
    title: ClassVar[str] = "two scales"
    horizon: ClassVar[int] = 3
    control_dt: ClassVar[float] = 0.1
    state_size: ClassVar[int] = 3
    observation_size: ClassVar[int] = 1
    action_size: ClassVar[int] = 2
    proxy_input_size: ClassVar[int] = 2
    z_size: ClassVar[int] = 2
    z_scale: ClassVar[float] = 1.0
    z_unit: ClassVar[str] = "m"

    @property
    def design_space(self) -> DesignSpace:
        def parameter(name: str, scale: float) -> Parameter:
            group = "both" if self.grouped else ""
            return Parameter(name, "m", -20.0, 20.0, 2.0, -20.0, 20.0, scale=scale, group=group)

        return DesignSpace((parameter("first", 1.0), parameter("second", 2.0)))

    @property
    def initial_action(self) -> np.ndarray:
        return np.zeros(2)

    def buildable(self, phi: np.ndarray) -> np.ndarray:
        return phi[..., 0] <= self.largest

    def check_buildable(self, phi: np.ndarray) -> None:
        if not self.buildable(phi):
            raise ValueError(f"first must not exceed {self.largest}")

    def hw_phy(self, phi: np.ndarray) -> Multiplied:
        return Multiplied(np.asarray(phi, dtype=float))

    def reset(self, hw_phy: Hardware, environments: int, rng: np.random.Generator) -> np.ndarray:
        return np.tile([1.0, 1.0, 0.0], (environments, 1))

    def observe(self, s: np.ndarray) -> np.ndarray:
        return s[:, :1].astype(np.float32)

    def proxy_input(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        return s[:, :2].astype(np.float32)

    def sample_pairs(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        return np.pad(rng.standard_normal((count, 2)), ((0, 0), (0, 1))), np.zeros((count, 2))

    def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
        z, share = hardware(s, action), (np.arange(len(s)) + 0.5) / len(s)
        ended = (s[:, 2] + 1 == self.ends) & (share < self.succeeding)
        return Transition(
            s=s + np.array([0.0, 0.0, 1.0]),
            a=action.astype(float),
            z=z,
            reward=z.sum(1),
            reward_terms={"scales": z.sum(1)},
            terminated=ended,
            diverged=~np.isfinite(z).all(1),
            success=ended,
            milestones={"near": (s[:, 2] == 0) & (share < self.near), "late": s[:, 2] >= 2},
            contact=np.full((len(s), 1, 3), np.nan),
        )

    def solved(self, reached: np.ndarray) -> np.ndarray:
        return reached.any(0)

    def spec(self, phi: np.ndarray) -> mujoco.MjSpec:
        return mujoco.MjSpec()

    def scene(self, phi: np.ndarray) -> mujoco.MjSpec:
        return mujoco.MjSpec()

    def qpos(self, s: np.ndarray) -> np.ndarray:
        return s


def linear(weight: list[list[float]], bias: list[float] | None = None) -> nn.Linear:
    """Return a network of one layer with these weights."""
    layer = nn.Linear(len(weight[0]), len(weight), bias=bias is not None)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor(weight))
        if bias is not None:
            layer.bias.copy_(torch.tensor(bias))
    return layer


def plain(parameters: Any, rate: float = 1.0) -> Any:
    """Return gradient descent, which moves weights by the gradient itself."""
    return torch.optim.SGD(parameters, rate)


def proxy(weight: list[list[float]], rate: float = 1.0, fit: ProxyFit | None = None) -> HwNN:
    """Return a proxy of one layer, z = weight s, that learns by gradient descent."""
    hw_nn = HwNN(Scales(), fit or ProxyFit(), 4, torch.Generator().manual_seed(0))
    hw_nn.proxy.net = linear(weight)
    hw_nn.optimizer = plain(hw_nn.proxy.parameters(), rate)
    return hw_nn


def weights_of(hw_nn: HwNN) -> list[list[float]]:
    """Return the weights of a proxy of one layer."""
    return hw_nn.proxy.net.weight.tolist()  # pyright: ignore[reportAttributeAccessIssue]


def started(method: Method = TINY, task: Task | None = None, rate: float = 1.0, seed: int = 0) -> State:
    """Return a state at its start whose policy and critic have one layer of zeros, and learn by gradient descent."""
    state = start(task or Scales(), method, seed)
    control = state.control
    control.policy.mean = linear([[0.0], [0.0]], [0.0, 0.0])  # pyright: ignore[reportAttributeAccessIssue]
    control.critic.value = linear([[0.0, 0.0]], [0.0])  # pyright: ignore[reportAttributeAccessIssue]
    control.optimizer = plain([*control.policy.parameters(), *control.critic.parameters()], rate)
    return state


def trajectories(reward: Any, alive: Any, **others: Any) -> Rollout:
    """Return a rollout with these rewards (T, N) and steps alive (T, N); what is not given is zero."""
    reward, alive = np.asarray(reward, dtype=float), np.asarray(alive, dtype=bool)
    steps, episodes = reward.shape
    numbers = {name: np.zeros((steps, episodes, size)) for name, size in (("s", 3), ("action", 2), ("a", 2), ("z", 2))}
    numbers["observation"] = np.zeros((steps, episodes, 1), dtype=np.float32)
    numbers["action"] = numbers["action"].astype(np.float32)
    return Rollout(
        **numbers | {
            "reward": reward, "reward_terms": {}, "alive": alive, "success": np.zeros_like(alive), "milestones": {},
            "contact": np.zeros((steps, episodes, 1, 3)), "last_s": np.zeros((episodes, 3)),
            "successes": np.zeros(episodes, dtype=bool), "kept": np.ones(episodes, dtype=bool),
            "steps": int(alive.sum()),
        } | others
    )  # fmt: skip


def pairs_of(s: Any, z: Any, z_phi: Any, episode: Any = None) -> Relabelled:
    """Return sampled pairs, the first steps alive of a rollout; each from an episode of its own if not given."""
    s, z, z_phi = (np.asarray(array, dtype=float) for array in (s, z, z_phi))
    row = np.arange(len(s))
    episode = row if episode is None else np.asarray(episode)
    return Relabelled(row, episode, np.pad(s, ((0, 0), (0, 1))), np.zeros((len(s), 2)), z, z_phi, len(s))


def tensor(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)


def replaced(method: Morph = TINY, **changes: Any) -> Morph:
    """Return the tiny method with other settings."""
    return dataclasses.replace(method, **changes)
