"""Success and return, always on Hw-Phy with the given phi; and recorded episodes for playback."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from morph_core.networks import Policy
from morph_core.protocol import EPISODES, Recorded, Which
from morph_core.rollout import Rollout, collect
from morph_core.task import Task
from morph_core.what_if import mean_interval


@dataclass(frozen=True)
class Score:
    """Means over episodes; one whose simulation diverged has failed, and has no return."""

    success: float
    episode_return: float
    milestones: dict[str, float]
    diverged: int
    reward_terms: dict[str, float]
    return_interval: tuple[float, float]


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
    terms = {
        name: float((term * rollout.alive).sum(0).mean()) if rollout.kept.any() else 0.0
        for name, term in rollout.reward_terms.items()
    }
    interval = mean_interval(rollout.returns.tolist(), rollout.mean_return)
    return Score(rollout.success_rate, rollout.mean_return, milestones, rollout.diverged, terms, interval)


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


def chosen_episodes(rollout: Rollout) -> dict[Which, int]:
    """Return which episodes of a rollout are worth watching, by return: the same one may be chosen twice.

    There is no failed one where all succeeded, and none at all where all diverged.
    """
    order = np.argsort(rollout.returns, kind="stable")
    failed = order[~rollout.successes[order]]
    chosen: dict[Which, int] = {}
    if len(order):
        chosen = {"median": int(_middle(order)), "best": int(order[-1]), "worst": int(order[0])}
    if len(failed):
        chosen["failed"] = int(_middle(failed))
    return chosen


def _middle(episodes: np.ndarray) -> np.ndarray:
    return episodes[(len(episodes) - 1) // 2]


def outcomes(rollout: Rollout) -> list[Recorded]:
    """Return what the chosen episodes came to."""
    return [
        Recorded(which, float(rollout.returns[episode]), bool(rollout.successes[episode]))
        for which, episode in chosen_episodes(rollout).items()
    ]


def record_episodes(task: Task, rollout: Rollout, phi: np.ndarray) -> dict[str, np.ndarray]:
    """Return the chosen episodes of a rollout as the arrays of one file, each episode once.

    The median one has the names of `record_episode`, another one its number before them, such as "7/qpos"; `recorded`
    holds the numbers of all four in the order of EPISODES, -1 for none.
    """
    chosen = chosen_episodes(rollout)
    median = chosen.get("median", 0)
    arrays = record_episode(task, rollout, phi, median)
    arrays["recorded"] = np.array([chosen.get(which, -1) for which in EPISODES])
    for episode in {*chosen.values()} - {median}:
        one = record_episode(task, rollout, phi, episode)
        arrays |= {f"{episode}/{name}": array for name, array in one.items() if name != "phi"}
    return arrays


def record_episode(task: Task, rollout: Rollout, phi: np.ndarray, episode: int = 0) -> dict[str, np.ndarray]:
    """Return one episode of a rollout as the arrays of a rollout file; T steps, T + 1 postures.

    A task that MuJoCo simulates also has qvel (T + 1, nv) and ctrl (T, nu), from which contact forces are worked out.
    """
    if not rollout.alive.shape[1]:  # every simulation diverged: there is only the design to record
        return {"phi": phi}
    steps = int(rollout.alive[:, episode].sum())
    after = rollout.s[steps, episode] if steps < len(rollout.s) else rollout.last_s[episode]
    states = np.concatenate([rollout.s[:steps, episode], after[None]])
    qvel, ctrl = task.qvel(states), task.ctrl(states[:-1], rollout.a[:steps, episode])
    return {
        "qpos": task.qpos(states),
        **({} if qvel is None or ctrl is None else {"qvel": qvel, "ctrl": ctrl}),
        "action": rollout.a[:steps, episode],
        "contact": rollout.contact[:steps, episode],
        "success": rollout.success[:steps, episode],
        "reward": rollout.reward[:steps, episode],
        "phi": phi,
        **{f"milestones/{name}": reached[:steps, episode] for name, reached in rollout.milestones.items()},
        **{f"reward_terms/{name}": term[:steps, episode] for name, term in rollout.reward_terms.items()},
    }
