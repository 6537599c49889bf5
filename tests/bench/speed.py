"""Environment steps per second including learning, one core: ours against Gymnasium's SyncVectorEnv.

Both sides run the same task, episodes, policy, critic and PPO update; only what steps the environments differs. They
take turns in the same process, so that whatever else the machine does hits both alike.
"""

import time
from dataclasses import dataclass

import gymnasium
import numpy as np
import torch
import tyro
from gymnasium.vector import SyncVectorEnv

from morph_core.catalogue import make_method, make_task
from morph_core.envs import env_id
from morph_core.exploration import run_trajectories
from morph_core.rollout import Rollout
from morph_core.state import State, start
from morph_core.task import Task


@dataclass(frozen=True)
class Speed:
    """What to compare."""

    task: str = "reacher"
    iterations: int = 3
    """Iterations per side."""


def through_gymnasium(envs: SyncVectorEnv, task: Task, state: State, seed: int) -> Rollout:
    """Collect one episode per environment through SyncVectorEnv."""
    observation, _ = envs.reset(seed=seed)
    alive = np.ones(envs.num_envs, dtype=bool)
    rows = []
    for _ in range(task.horizon):
        action = state.control.policy.act(observation, state.rng)
        following, reward, terminated, truncated, _ = envs.step(action)
        rows.append((observation, action, reward, alive, terminated))
        observation, alive = following, alive & ~(terminated | truncated)
    observations, actions, rewards, lives, successes = (np.stack(column) for column in zip(*rows, strict=True))
    unused = np.zeros((*rewards.shape, 1))
    return Rollout(
        s=unused, observation=observations, action=actions, a=unused, z=unused, reward=rewards, reward_terms={},
        alive=lives, success=successes, milestones={}, contact=unused, last_s=unused[0],
        successes=successes.any(0), kept=np.ones(envs.num_envs, dtype=bool), steps=int(lives.sum()),
    )  # fmt: skip


def through_morph(task: Task, trajectories: int, state: State) -> Rollout:
    """Collect one episode per environment as the methods do."""
    return run_trajectories(task, state, task.hw_phy(np.tile(state.phi, (trajectories, 1))), trajectories)


def main(options: Speed) -> None:
    torch.set_num_threads(1)
    task = make_task(options.task)
    method = make_method("no_hw_opt", task)
    envs = SyncVectorEnv([lambda: gymnasium.make(env_id(task.name))] * method.trajectories)
    ours, theirs = start(task, method, 0), start(task, method, 0)
    seconds, steps = {"ours": 0.0, "SyncVectorEnv": 0.0}, {"ours": 0, "SyncVectorEnv": 0}
    for iteration in range(1, options.iterations + 1):
        for side, state in (("ours", ours), ("SyncVectorEnv", theirs)):
            began = time.process_time()
            if side == "ours":
                rollout = through_morph(task, method.trajectories, state)
            else:
                rollout = through_gymnasium(envs, task, state, iteration)
            state.control.learn(state, rollout, iteration)
            seconds[side] += time.process_time() - began
            steps[side] += rollout.steps
    rate = {side: steps[side] / seconds[side] for side in seconds}
    for side, value in rate.items():
        print(f"{side}: {value:,.0f} environment steps per CPU second, learning included")
    print(f"ratio: {rate['ours'] / rate['SyncVectorEnv']:.1f}")


if __name__ == "__main__":
    main(tyro.cli(Speed, description=__doc__))
