"""`direct`, ours and not the paper's: a natural evolution strategy on phi from whole-episode returns."""

import itertools
from collections.abc import Iterator

from morph_core.config import Config
from morph_core.exploration import design_sigma, episode_advantage, explore_designs, nearest_buildable, run_trajectories
from morph_core.objective import improve_control, make_batch, restart_control, set_learning_rates
from morph_core.protocol import Progress
from morph_core.state import State
from morph_core.task import Task


def direct(task: Task, config: Config, state: State) -> Iterator[Progress]:
    """Yield one Progress per iteration, for ever; the yardstick for how much design signal an iteration holds."""
    learner = state.learner
    for iteration in itertools.count(state.iteration + 1):
        sigma = 0.0 if state.frozen else design_sigma(iteration, config)
        set_learning_rates(state, iteration, config)
        designs = explore_designs(state, config.trajectories, sigma, config.design_correlation)
        hw_phy = task.hw_phy(designs)
        rollout = run_trajectories(task, state, hw_phy, config)
        if not rollout.holds_enough:
            yield state.skip(iteration, rollout, config)
            continue
        improve_control(state, make_batch(task, learner, rollout, config), iteration, config)
        restart_control(task, state, rollout, iteration, config)
        advantage = episode_advantage(rollout.returns, config)
        # E[A (phi_i - phi)], the natural gradient
        step = (advantage[:, None] * (designs[rollout.kept] - state.phi)).mean(0)
        state.phi = nearest_buildable(task, state.phi, state.design_space.clip(state.phi + config.direct_step * step))
        state.advance(iteration, rollout, config)
        yield Progress(
            iteration=iteration,
            env_steps=state.env_steps,
            phi=state.phi.tolist(),
            episode_return=rollout.mean_return,
            success=rollout.success_rate,
            policy_std=learner.policy.mean_std,
            design_sigma=sigma,
        )
