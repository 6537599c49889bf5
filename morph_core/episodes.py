"""Success and return, always on Hw-Phy with the given phi; and one recorded episode for playback."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from morph_core.networks import Policy
from morph_core.rollout import Rollout, collect
from morph_core.task import Task


@dataclass(frozen=True)
class Score:
    """Means over episodes; one whose simulation diverged has failed, and has no return."""

    success: float
    episode_return: float
    milestones: dict[str, float]
    diverged: int


def evaluate(
    task: Task, policy: Policy, phi: np.ndarray, episodes: int, rng: np.random.Generator, sampled: bool
) -> tuple[Score, Rollout]:
    """Run the policy, sampled or deterministic, on Hw-Phy with phi (d,), which it is told where it sees phi."""
    rollout = play(task, policy, phi, episodes, rng, sampled)
    return score_of(task, rollout), rollout


def score_of(task: Task, rollout: Rollout) -> Score:
    """Return what the episodes came to."""
    milestones = {
        name: float(task.solved(reached & rollout.alive).sum() / rollout.episodes)
        for name, reached in rollout.milestones.items()
    }
    return Score(rollout.success_rate, rollout.mean_return, milestones, rollout.diverged)


def play(
    task: Task,
    policy: Policy,
    phi: np.ndarray,
    episodes: int,
    rng: np.random.Generator,
    sampled: bool,
    before_step: Callable[[], None] = lambda: None,
) -> Rollout:
    """Return episodes of the policy on Hw-Phy with phi (d,), which it is told where it sees phi.

    Whatever `before_step` raises before one of the control steps ends them early.
    """
    hw_phy, policy = task.hw_phy(phi), policy.at(phi)

    def act(observation: np.ndarray) -> np.ndarray:
        before_step()
        return policy.act(observation, rng if sampled else None)

    return collect(task, act, hw_phy, task.reset(hw_phy, episodes, rng))


def record_episode(task: Task, rollout: Rollout, phi: np.ndarray, episode: int = 0) -> dict[str, np.ndarray]:
    """Return one episode of a rollout as the arrays of a rollout file; T steps, T + 1 postures."""
    if not rollout.alive.shape[1]:  # every simulation diverged: there is only the design to record
        return {"phi": phi}
    steps = int(rollout.alive[:, episode].sum())
    after = rollout.s[steps, episode] if steps < len(rollout.s) else rollout.last_s[episode]
    states = np.concatenate([rollout.s[:steps, episode], after[None]])
    return {
        "qpos": task.qpos(states),
        "action": rollout.a[:steps, episode],
        "contact": rollout.contact[:steps, episode],
        "success": rollout.success[:steps, episode],
        "reward": rollout.reward[:steps, episode],
        "phi": phi,
        **{f"milestones/{name}": reached[:steps, episode] for name, reached in rollout.milestones.items()},
        **{f"reward_terms/{name}": term[:steps, episode] for name, term in rollout.reward_terms.items()},
    }
