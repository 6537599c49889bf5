"""RL-NoHWOpt: the same PPO on Hw-Phy with the initial design."""

import itertools
from collections.abc import Iterator

from morph_core.config import Config
from morph_core.exploration import run_trajectories
from morph_core.objective import improve_control, make_batch, restart_control, set_learning_rates
from morph_core.protocol import Progress
from morph_core.state import State
from morph_core.task import Task


def no_hw_opt(task: Task, config: Config, state: State) -> Iterator[Progress]:
    """Yield one Progress per iteration, for ever; phi moves only when the caller moves it."""
    learner = state.learner
    for iteration in itertools.count(state.iteration + 1):
        set_learning_rates(state, iteration, config)
        hw_phy = task.hw_phy(state.phi)
        rollout = run_trajectories(task, state, hw_phy, config)
        if not rollout.holds_enough:
            yield state.skip(iteration, rollout, config)
            continue
        improve_control(state, make_batch(task, learner, rollout, config), iteration, config)
        restart_control(task, state, rollout, iteration, config)
        state.advance(iteration, rollout, config)
        yield Progress(
            iteration=iteration,
            env_steps=state.env_steps,
            phi=state.phi.tolist(),
            episode_return=rollout.mean_return,
            success=rollout.success_rate,
            policy_std=learner.policy.mean_std,
        )
