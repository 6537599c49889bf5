"""Exploration `gaussian`: the paper's letter, trajectories in the proxy's world with noise on its z."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np

from morph_core.config import CountOrNone, Positive, most
from morph_core.exploration import Exploration, Metric, Notes, Pull, Relabelled, run_trajectories
from morph_core.rollout import Rollout
from morph_core.spread import ExploredDesigns, Spread
from morph_core.task import Hardware, Task

if TYPE_CHECKING:
    from morph_core.hw_nn import HwNN
    from morph_core.state import State

LARGEST_LOG_RATIO = 10.0
"""Largest logarithm of a probability ratio, so that the ratio of a z that the proxy has left far behind does not
overflow."""
SMALLEST_STD = 0.01
"""Smallest standard deviation of z, in units of z, with which ratios and D are formed where designs hardly differ."""
FITTED_PAIRS = 2048
"""Pairs (s, a) of a rollout on which it is fitted what designs ask of the last layer."""
START_PAIRS = 512
"""Pairs for that fit before the first rollout, spread over the workspace."""
RIDGE = 1e-4
"""Ridge of that fit, as a share of the features' mean square."""


@dataclass
class HeldNoise(Notes):
    """The noise that each episode keeps, and the directions along which it is drawn."""

    directions: np.ndarray | None = None  # (d, z_size, k)
    """What a change of each design parameter by 1 asks of the last layer of the proxy; None before the first
    rollout."""
    noise: np.ndarray | None = None  # (N, z_size, k)
    """What noise adds to the last layer in each episode of this iteration, drawn anew in the next; None where phi is
    frozen."""

    @property
    def arrays(self) -> Mapping[str, np.ndarray]:
        return {} if self.directions is None else {"directions": self.directions}

    def recall(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.directions = arrays.get("directions")

    @staticmethod
    def of(state: "State") -> "HeldNoise":
        """Return those of a run; ValueError for one that was not begun with them."""
        if not isinstance(state.notes, HeldNoise):
            raise ValueError("the exploration gaussian needs the notes that it made before the first iteration")
        return state.notes


@dataclass(frozen=True)
class Gaussian(ExploredDesigns, Exploration):
    """Trajectories run in the proxy's world with Gaussian noise on its z, as in the paper.

    What the paper leaves open is settled so that phi arrives. The noise is on the last layer of the proxy, along what
    changes of the design would ask of it, and each episode keeps its own; Sigma is that of those designs.
    """

    contact: Literal["swept", "end"] = "swept"
    """Collision test in the proxy's world: `swept` tests the whole of each move, as Hw-Phy does, `end` its end alone.
    For a task that makes no such difference both are the same."""
    divergence: Literal["noise", "plain"] = "noise"
    """Metric of D: `noise` is the KL divergence of two Gaussian hardware models with the noise's standard deviation,
    `plain` the squared distance."""
    spread_pairs: Annotated[CountOrNone, most(65_536, "they are simulated and kept at once")] = 512
    """Pairs (s, a), spread over the workspace, at which D is taken beside the sampled ones, each iteration anew. Each
    costs one step of Hw-Phy."""
    credit: Literal["episode", "step"] = "episode"
    """A: what credits z, the standardised return of its episode or the advantage of its step."""
    clip_coef: Annotated[Positive, most(100.0, "a ratio that may change a hundredfold is not clipped")] = 0.6
    """Clip of the probability ratio of z, as in PPO."""
    largest_log_ratio: Annotated[Positive, most(50.0, "the ratio must fit single precision")] = 1.1
    """Dual clip: largest logarithm of the probability ratio of z. PPO's clip leaves it unbounded where A is
    negative."""
    finish: Literal["hw_phy", "proxy"] = "hw_phy"
    """World of the trajectories once phi is frozen: Hw-Phy, or still that of the proxy, without noise."""

    name: ClassVar[str] = "gaussian"

    def check(self, task: Task) -> None:
        if not task.runs_on_proxy:
            raise ValueError(
                f"{task.name} can't be explored by \"gaussian\": it can't be simulated in the proxy's world; "
                'choose from: "design"'
            )

    def notes(self) -> HeldNoise:
        return HeldNoise()

    def sigma_shown(self, spread: Spread) -> None:
        """Return None: no design is built and tried."""

    def world(self, task: Task, state: "State", spread: Spread, trajectories: int) -> Hardware:
        notes = HeldNoise.of(state)
        notes.noise = None if state.frozen else self._noise(task, state, spread, trajectories)
        if state.frozen and self.finish == "hw_phy":
            return task.hw_phy(state.phi)
        shape = (trajectories, *state.hw_nn.last_weights.shape)
        world = EpisodicProxy(state.hw_nn, np.zeros(shape, np.float32) if notes.noise is None else notes.noise)
        return world if self.contact == "swept" else world.__call__  # of a function no task can sweep the outline

    def _noise(self, task: Task, state: "State", spread: Spread, trajectories: int) -> np.ndarray:
        """Return what is added to the last layer in each episode (N, z_size, k): sigma xi_k dW_k, antithetic pairs."""
        space, notes = state.design_space, HeldNoise.of(state)
        if notes.directions is None:
            notes.directions = directions(task, state, spread, *task.sample_pairs(START_PAIRS, state.rng))
        half = spread.sigma * space.scale * spread.noise(space, trajectories // 2, state.rng)
        offset = np.einsum("nd,dzk->nzk", half, notes.directions)
        return np.concatenate([offset, -offset]).astype(np.float32)

    def prepare(self, task: Task, state: "State", spread: Spread, rollout: Rollout) -> None:
        """Fit on this rollout what designs ask of the last layer."""
        if not state.frozen:
            t, n = rollout.alive.nonzero()
            chosen = state.rng.integers(len(t), size=FITTED_PAIRS)
            at = t[chosen], n[chosen]
            HeldNoise.of(state).directions = directions(task, state, spread, rollout.s[at], rollout.a[at])

    def success(self, task: Task, state: "State", rollout: Rollout, level: float) -> float:
        """Return the success on Hw-Phy, which is tried once the proxy's world has reached the level."""
        success = rollout.success_rate
        if state.frozen or not 0 < level <= success:
            return success
        proof = run_trajectories(task, state, task.hw_phy(state.phi), rollout.episodes)
        state.env_steps += proof.steps
        return proof.success_rate

    def metric(self, task: Task, state: "State", pairs: Relabelled, hw_phy: Hardware) -> Metric:
        further = None
        if self.spread_pairs:
            s, a = task.sample_pairs(self.spread_pairs, state.rng)
            z_phi = hw_phy(s, a)
            state.relabelled_steps += len(s)
            sound = np.isfinite(z_phi).all(1)
            row = np.arange(sound.sum())
            further = Relabelled(row, row, s[sound], a[sound], z_phi[sound], z_phi[sound], len(s)) if len(row) else None
        hw_nn, noise = state.hw_nn, HeldNoise.of(state).noise
        if self.divergence == "plain" or noise is None:
            return Metric(None, further)
        weight = precision(hw_nn, noise, pairs)
        return Metric(weight, further, None if further is None else precision(hw_nn, noise, further))

    def pull(self, state: "State", rollout: Rollout, pairs: Relabelled, advantage: np.ndarray) -> Pull:
        """Return the gradient of PPO's clipped surrogate with the probability ratio of z.

        r = N(z; m, sigma) / N(z; m_before, sigma), L = -mean(min(r A, clip(r) A)), with sigma that of the noise at
        (s, a). While phi is frozen nothing pulls: the proxy follows Hw-Phy alone.
        """
        import torch

        from morph_core.networks import log_normal

        noise = HeldNoise.of(state).noise
        if noise is None:
            return lambda m, _: np.zeros_like(m)
        by_episode = self.credit == "episode"
        credit = self.advantage(rollout.returns)[pairs.episode] if by_episode else advantage[pairs.row]
        weight = torch.from_numpy(credit.astype(np.float32))
        z = torch.from_numpy(pairs.z.astype(np.float32))
        m_before = torch.from_numpy(state.hw_nn(pairs.s, pairs.a).astype(np.float32))
        sigma = torch.from_numpy(noise_std(state.hw_nn, noise, pairs.s, pairs.a))
        log_before = log_normal(z, m_before, sigma)

        def pull(m: np.ndarray, index: np.ndarray) -> np.ndarray:
            output = torch.from_numpy(m).requires_grad_()
            log_ratio = log_normal(z[index], output, sigma[index]) - log_before[index]
            ratio = log_ratio.clamp(-LARGEST_LOG_RATIO, self.largest_log_ratio).exp()
            limited = ratio.clamp(1 - self.clip_coef, 1 + self.clip_coef)
            loss = -torch.min(ratio * weight[index], limited * weight[index]).mean()
            return torch.autograd.grad(loss, output)[0].numpy()

        return pull


@dataclass(frozen=True)
class EpisodicProxy:
    """The proxy's world in which each episode has a last layer of its own, as `HardwareOfEpisodes`: z is the same
    however often it is asked for."""

    hw_nn: "HwNN"
    noise: np.ndarray  # (N, z_size, k)

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        weights = self.hw_nn.last_weights + self.noise
        f = self.hw_nn.last_features(s, a).reshape(-1, *weights.shape[::2])  # (times, N, k)
        z = np.matmul(f.transpose(1, 0, 2), weights.transpose(0, 2, 1)).transpose(1, 0, 2)
        return z.reshape(len(s), -1).astype(float)

    def of(self, episodes: np.ndarray) -> "EpisodicProxy":
        """Return the world of some of the episodes."""
        return EpisodicProxy(self.hw_nn, self.noise[episodes])


def noise_std(hw_nn: "HwNN", noise: np.ndarray, s: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the standard deviation (B, z_size) float32 of z over the noise (N, z_size, k) of all episodes."""
    f = hw_nn.last_features(s, a)
    changes = (f @ noise.reshape(-1, noise.shape[-1]).T).reshape(len(f), *noise.shape[:2])
    return np.maximum(np.sqrt((changes**2).mean(1)), np.float32(SMALLEST_STD))


def precision(hw_nn: "HwNN", noise: np.ndarray, pairs: Relabelled) -> np.ndarray:
    """Return 1 / 2 sigma^2 (B, z_size), the weight of squared differences in the KL divergence of two Gaussians."""
    return 0.5 / noise_std(hw_nn, noise, pairs.s, pairs.a) ** 2


def directions(task: Task, state: "State", spread: Spread, s: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return dW (d, z_size, k): what a change of each design parameter by 1 asks of the last layer, at pairs (s, a).

    dW_k is fitted by ridge to (F_{phi + delta} - F_{phi - delta}) / 2 delta, delta = Sigma of that parameter. It is 0
    for a parameter that is locked.
    """
    space, phi = state.design_space, state.phi
    shift = np.diag(spread.sigma * space.scale)
    above, below = space.clip(phi + shift), space.clip(phi - shift)  # (d, d) each
    z = np.stack([task.hw_phy(np.tile(one, (len(s), 1)))(s, a) for one in (*above, *below)])  # (2 d, n, z_size)
    state.relabelled_steps += z.shape[0] * z.shape[1]
    width = np.diag(above - below)
    change = (z[: len(phi)] - z[len(phi) :]) / np.where(width > 0, width, 1.0)[:, None, None]
    sound = np.isfinite(change).all((0, 2))
    f = state.hw_nn.last_features(s, a)[sound].astype(float)
    square = f.T @ f
    square += RIDGE * (f**2).sum() / f.shape[1] * np.eye(f.shape[1])
    return np.ascontiguousarray(np.linalg.solve(square, f.T @ change[:, sound]).transpose(0, 2, 1))
