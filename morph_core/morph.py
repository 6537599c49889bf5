"""Algorithm 1: co-optimise policy and proxy, then find the design whose physics match the proxy."""

import itertools
from collections.abc import Iterator

import torch

from morph_core.config import Config
from morph_core.derive import derive_design, relabel
from morph_core.exploration import (
    clipped_pull,
    design_sigma,
    explored_world,
    linearised_pull,
    relabel_on_hardware,
    run_trajectories,
)
from morph_core.objective import (
    fit_proxy,
    improve_control,
    improve_proxy,
    make_batch,
    restart_control,
    set_learning_rates,
)
from morph_core.protocol import Progress
from morph_core.state import State
from morph_core.task import Task


def morph(task: Task, config: Config, state: State) -> Iterator[Progress]:
    """Yield one Progress per iteration, for ever; between two of them `state` is the caller's to read and to edit."""
    learner = state.learner
    for iteration in itertools.count(state.iteration + 1):  # line 1
        if not state.fitted:
            fit_proxy(task, state, config)
            state.fitted = True
        sigma = 0.0 if state.frozen else design_sigma(iteration, config)
        set_learning_rates(state, iteration, config)
        hw_phy = task.hw_phy(state.phi)

        world = explored_world(task, state, config, sigma)  # line 2
        rollout = run_trajectories(task, state, world, config)
        if not rollout.holds_enough:
            yield state.skip(iteration, rollout, config)
            continue

        batch = make_batch(task, learner, rollout, config)  # line 3, Eq. 2
        pairs = relabel_on_hardware(rollout, hw_phy, config.proxy_pairs, state.rng)
        if not len(pairs):
            yield state.skip(iteration, rollout, config)
            continue
        if config.exploration == "gaussian":
            with torch.no_grad():
                m_before = learner.proxy(torch.from_numpy(task.proxy_input(pairs.s, pairs.a)))
            pull = clipped_pull(pairs, m_before, batch.advantage, config)
        else:
            pull = linearised_pull(rollout, pairs, config)
        improve_control(state, batch, iteration, config)
        restart_control(task, state, rollout, iteration, config)
        update = improve_proxy(task, state, pairs, hw_phy, pull, config)
        state.relabelled_steps += pairs.steps

        search_cost = None
        if iteration % config.design_interval == 0 and not state.frozen:  # line 4
            dataset = relabel(rollout, learner, config.search_pairs, state.rng)  # line 5
            seed = int(state.rng.integers(1, 2**31))
            search = derive_design(  # line 6, Eq. 3
                task, state.design_space, dataset, state.phi, config, seed, sigma
            )
            learner.settle()
            state.phi, search_cost = search.phi, search.cost
            state.relabelled_steps += search.steps

        state.advance(iteration, rollout, config)
        yield Progress(
            iteration=iteration,
            env_steps=state.env_steps,
            phi=state.phi.tolist(),
            episode_return=rollout.mean_return,
            success=rollout.success_rate,
            policy_std=learner.policy.mean_std,
            design_sigma=sigma if config.exploration == "design" else None,
            divergence=update.divergence,
            search_cost=search_cost,
            cosine=update.cosine,
            cosine_negative=update.cosine_negative,
            cosine_by_parameter=update.cosine_by_parameter,
            alpha=state.alpha,
            projection=state.projection,
        )
