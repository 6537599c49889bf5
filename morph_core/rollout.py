"""Trajectories: collect them with any policy on any hardware, and estimate advantages."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from morph_core.soundness import check_steps
from morph_core.task import Hardware, Task

Act = Callable[[np.ndarray], np.ndarray]
"""Function that chooses actions (N, action_size) from observations (N, o)."""


@dataclass(frozen=True)
class Rollout:
    """All trajectories of an iteration: T steps of N episodes. Steps after an episode's end are not `alive`.

    Episodes whose simulation diverged are left out, all of them: N counts the others.
    """

    s: np.ndarray  # (T, N, state_size)
    observation: np.ndarray  # (T, N, o) float32, what the policy saw: the design at its end, where it sees phi
    action: np.ndarray  # (T, N, action_size) float32, what the policy asked for
    a: np.ndarray  # (T, N, action_size) what was executed, physical units
    z: np.ndarray  # (T, N, z_size)
    reward: np.ndarray  # (T, N)
    reward_terms: dict[str, np.ndarray]  # each (T, N)
    alive: np.ndarray  # (T, N) bool
    success: np.ndarray  # (T, N) bool
    milestones: dict[str, np.ndarray]  # each (T, N) bool
    contact: np.ndarray  # (T, N, C, 3) m
    last_s: np.ndarray  # (N, state_size)
    successes: np.ndarray  # (N,) bool: whether each episode reached the goal
    kept: np.ndarray  # (episodes started,) bool: which of them are here
    steps: int
    """Environment steps taken, those of the episodes left out included."""
    seconds: float = 0.0
    """Time that collecting them took, in seconds, from which it is known what others will take."""

    @property
    def episodes(self) -> int:
        """Number of episodes that were started."""
        return len(self.kept)

    @property
    def diverged(self) -> int:
        """Number of episodes that were left out because their simulation diverged."""
        return int((~self.kept).sum())

    @property
    def holds_enough(self) -> bool:
        """Whether there is something to learn from: what an episode counts is relative to the others."""
        return bool(self.kept.sum() > 1)

    @property
    def returns(self) -> np.ndarray:
        """Return the undiscounted return (N,) of each episode."""
        return (self.reward * self.alive).sum(0)

    @property
    def mean_return(self) -> float:
        """Return the mean return of the episodes that were not left out; 0 if there are none."""
        return float(self.returns.mean()) if self.kept.any() else 0.0

    @property
    def success_rate(self) -> float:
        """Share of the episodes started that reached the goal."""
        return float(self.successes.sum() / self.episodes)


def collect(task: Task, act: Act, hardware: Hardware, s: np.ndarray, phi_seen: np.ndarray | None = None) -> Rollout:
    """Run N episodes from start states s (N, state_size) in the world of `hardware`.

    `phi_seen` (N, k) float32, where it is given, stands at the end of every observation of its episode. Raise
    FloatingPointError that names the number which is NaN, infinite or too large to learn from, if there is one.
    """
    began, alive = time.monotonic(), np.ones(len(s), dtype=bool)
    kept = alive.copy()
    steps = []
    for _ in range(task.horizon):
        observation = task.observe(s)
        if phi_seen is not None:
            observation = np.concatenate([observation, phi_seen], 1)
        action = act(observation)
        # What has ended rests: some tasks take longer over a move, and nothing of it is read.
        transition = task.step(hardware, s, np.where(alive[:, None], action, np.float32(0)))
        steps.append((s, observation, action, transition, alive))
        kept = kept & ~(transition.diverged & alive)
        s, alive = transition.s, alive & ~transition.terminated & ~transition.diverged
        if not alive.any():
            break
    states, observations, actions, transitions, lives = zip(*steps, strict=True)

    def stack(arrays: Iterable[np.ndarray]) -> np.ndarray:
        return np.stack([array[kept] for array in arrays])

    def stack_named(tables: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        return {name: stack(table[name] for table in tables) for name in tables[0]}

    success = stack(t.success & life for t, life in zip(transitions, lives, strict=True))
    rollout = Rollout(
        s=stack(states),
        observation=stack(observations),
        action=stack(actions),
        a=stack(t.a for t in transitions),
        z=stack(t.z for t in transitions),
        reward=stack(t.reward for t in transitions),
        reward_terms=stack_named([t.reward_terms for t in transitions]),
        alive=stack(lives),
        success=success,
        milestones=stack_named([t.milestones for t in transitions]),
        contact=stack(t.contact for t in transitions),
        last_s=s[kept],
        successes=task.solved(success),
        kept=kept,
        steps=int(np.sum(lives)),
        seconds=time.monotonic() - began,
    )
    terms = {f"the term {name} of the reward": term for name, term in rollout.reward_terms.items()}
    check_steps(
        {
            "the state s": rollout.s, "the observation": rollout.observation, "the policy's action": rollout.action,
            "the executed action a": rollout.a, "the hardware's output z": rollout.z, **terms,
            "the reward": rollout.reward,
        },
        rollout.alive,
    )  # fmt: skip
    return rollout


def advantages(rollout: Rollout, values: np.ndarray, gamma: float, gae_lambda: float) -> np.ndarray:
    """Return generalised advantage estimates (T, N) from values (T, N) (Schulman et al. 2016).

    A_t = sum_k (gamma lambda)^k delta_{t+k}, delta_t = r_t + gamma V_{t+1} - V_t. Beyond the horizon V is 0: the
    horizon is part of the task and the critic sees the time, so that its end is an end and no truncation.
    """
    result = np.zeros_like(rollout.reward)
    running = np.zeros(rollout.reward.shape[1])
    following = np.zeros_like(running)
    goes_on = np.zeros(len(running), dtype=bool)
    for t in reversed(range(len(result))):
        delta = rollout.reward[t] + gamma * following * goes_on - values[t]
        running = delta + gamma * gae_lambda * running * goes_on
        result[t] = running
        following, goes_on = values[t], rollout.alive[t]
    return result
