"""Algorithm 1: co-optimise policy and proxy, then find the design whose physics match the proxy."""

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING

from morph_core.exploration import relabel_on_hardware, run_trajectories
from morph_core.protocol import Progress
from morph_core.search import derive_design, relabel
from morph_core.task import Task

if TYPE_CHECKING:
    from morph_core.methods.proxy import Morph
    from morph_core.state import State


def morph(task: Task, config: "Morph", state: "State") -> Iterator[Progress]:
    """Yield one Progress per iteration, for ever; between two of them `state` is the caller's to read and to edit."""
    exploration, search = config.exploration, config.search
    for iteration in itertools.count(state.iteration + 1):  # line 1
        state.fit_proxy(task)
        state.set_learning_rates(config, iteration)
        spread = exploration.spread(config.schedule, iteration, state.frozen)
        hw_phy = task.hw_phy(state.phi)

        world = exploration.world(task, state, spread, config.trajectories)  # line 2
        rollout = run_trajectories(task, state, world, config.trajectories)
        if rollout.holds_enough and state.frozen and exploration.proxy_rests:
            state.control.learn(state, rollout, iteration)
            sigma = exploration.sigma_shown(spread)
            yield state.advance(iteration, rollout, config.freeze_success, design_sigma=sigma)
            continue
        if not rollout.holds_enough or not len(
            pairs := relabel_on_hardware(rollout, hw_phy, config.proxy.pairs, state.rng)
        ):
            yield state.advance(iteration, rollout, config.freeze_success)
            continue

        advantage = state.control.learn(state, rollout, iteration)  # line 3, Eq. 2
        pull = exploration.pull(state, rollout, pairs, advantage)
        metric = exploration.metric(task, state, pairs, hw_phy)
        update = state.hw_nn.improve(state, pairs, pull, metric, hw_phy, config.ppo, search.pairs)
        state.relabelled_steps += pairs.steps

        search_cost = None
        if iteration % config.design_interval == 0 and not state.frozen:  # line 4
            dataset = relabel(rollout, state.hw_nn, search.pairs, state.rng)  # line 5
            search_cost = derive_design(task, state, dataset, search, spread)  # line 6, Eq. 3

        exploration.prepare(task, state, spread, rollout)
        yield state.advance(
            iteration,
            rollout,
            config.freeze_success,
            exploration.success(task, state, rollout, config.freeze_success),
            design_sigma=exploration.sigma_shown(spread),
            search_cost=search_cost,
            alpha=state.alpha,
            projection=state.projection,
            **vars(update),
        )
