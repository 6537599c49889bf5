"""Our learner against Stable-Baselines3's PPO, one core: `python tests/bench/peers.py reacher`.

Both learn on a fixed design, with the same vector environment, networks, batch, epochs, learning rates and noise; each
run is a process of its own, and the sides take turns, so that whatever else the machine does hits both alike. CPU
seconds include learning and leave evaluations out. Each side is evaluated on the same episodes by the same code.

Stable-Baselines3 is made to see the task as our learner does: an episode ends at the horizon, and t / T is the last
entry of its observation, because the return depends on it.
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from morph_core.catalogue import make_method, make_task
from morph_core.envs.spaces import action_space
from morph_core.method import Method
from morph_core.rollout import Act, collect
from morph_core.state import start
from morph_core.task import Task

DESIGNS = {"reacher": (2.6, 0.6, 2.9, 1.3, 1.0)}
OPTIONS = {"pen_press": {"initial_length": 0.26}, "mouse_click": {"initial_length": 0.26}}
"""Designs on which the tasks can be learnt, which their initial ones are not: about what `morph` found for the reacher,
and for the hands fingers of .26 m."""
EVALUATED = 256
"""Episodes per evaluation."""
Side = Literal["ours", "Stable-Baselines3"]
SIDES: tuple[Side, ...] = ("ours", "Stable-Baselines3")


@dataclass(frozen=True)
class Peers:
    """What to compare."""

    task: tyro.conf.Positional[str] = "reacher"
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """A pair of runs for each."""
    iterations: int = 30
    """Iterations per run, each as many steps as our trajectories have at most."""
    interval: int = 5
    """Iterations between two evaluations; 0 makes none."""
    core: int = 0
    """The core that both sides run on."""
    out: Path | None = None
    """Append each run to this file as a line of JSON."""
    side: Side | None = None
    """Make the first seed's run of this side in this process, and print it as JSON."""


@dataclass
class Run:
    """What one side did with one seed."""

    side: Side
    seed: int
    env_steps: int = 0
    cpu_seconds: float = 0.0
    curve: list[tuple[int, float, float, float]] = field(default_factory=list)
    """(environment steps, CPU seconds, success, return) of every evaluation, actions sampled."""

    @property
    def rate(self) -> float:
        return self.env_steps / self.cpu_seconds


@dataclass(frozen=True)
class Problem:
    """The task on a fixed design, and the settings that both sides share."""

    task: Task
    method: Method
    phi: np.ndarray

    @classmethod
    def of(cls, peers: Peers) -> "Problem":
        task = make_task(peers.task, OPTIONS.get(peers.task, {}))
        phi = np.array(DESIGNS.get(peers.task, task.design_space.initial))
        return cls(task, make_method("no_hw_opt", task), phi)

    def evaluate(self, run: Run, act: Act) -> None:
        hw_phy = self.task.hw_phy(self.phi)
        begun = self.task.reset(hw_phy, EVALUATED, np.random.default_rng([run.seed, run.env_steps]))
        rollout = collect(self.task, act, hw_phy, begun)
        run.curve.append((run.env_steps, run.cpu_seconds, rollout.success_rate, rollout.mean_return))


class TaskVecEnv(VecEnv):
    """The task as Stable-Baselines3 wants it: N episodes that each begin again where they end."""

    def __init__(self, problem: Problem, seed: int) -> None:
        self._task, self._rng = problem.task, np.random.default_rng(seed)
        self._hw_phy = problem.task.hw_phy(problem.phi)
        size = problem.task.observation_size + 1
        space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        super().__init__(problem.method.trajectories, space, action_space(problem.task))

    def reset(self) -> np.ndarray:
        self._s = self._task.reset(self._hw_phy, self.num_envs, self._rng)
        self._t = np.zeros(self.num_envs, dtype=np.float32)
        return self._observe()

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        transition = self._task.step(self._hw_phy, self._s, self._actions)
        self._s, self._t = transition.s, self._t + 1
        ended = transition.terminated | transition.diverged | (self._t >= self._task.horizon)
        if ended.any():
            self._s[ended] = self._task.reset(self._hw_phy, int(ended.sum()), self._rng)
            self._t[ended] = 0
        return self._observe(), transition.reward, ended, [{}] * self.num_envs

    def _observe(self) -> np.ndarray:
        time = (self._t / self._task.horizon)[:, None]
        return np.concatenate([self._task.observe(self._s), time], 1, dtype=np.float32)

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class Noise(BaseCallback):
    """Keep the actions' noise below the limit that falls over the schedule, as our learner does."""

    def __init__(self, limit: Callable[[], float]) -> None:
        super().__init__()
        self._limit = limit

    def _on_rollout_start(self) -> None:
        with torch.no_grad():
            self.model.policy.log_std.clamp_(max=float(np.log(self._limit())))  # pyright: ignore

    def _on_step(self) -> bool:
        return True


def run_ours(problem: Problem, peers: Peers, seed: int) -> Run:
    run = Run("ours", seed)
    state = start(problem.task, problem.method, seed)
    state.phi = problem.phi
    iterations = problem.method.iterations(problem.task, state)
    for iteration in range(1, peers.iterations + 1):
        began = time.process_time()
        next(iterations)
        run.cpu_seconds += time.process_time() - began
        run.env_steps = state.env_steps
        if peers.interval and iteration % peers.interval == 0:
            rng = np.random.default_rng([seed, iteration])
            problem.evaluate(run, lambda observation, rng=rng: state.control.policy.act(observation, rng))
    return run


def run_theirs(problem: Problem, peers: Peers, seed: int) -> Run:
    run = Run("Stable-Baselines3", seed)
    task, ppo, schedule = problem.task, problem.method.ppo, problem.method.schedule
    steps, iteration = task.horizon * problem.method.trajectories, 1
    model = PPO(
        "MlpPolicy",
        TaskVecEnv(problem, seed),
        learning_rate=lambda _: ppo.learning_rate * schedule.linear(ppo.learning_rate_end, iteration),
        n_steps=task.horizon,
        batch_size=-(-steps // ppo.minibatches),
        n_epochs=ppo.epochs,
        gamma=ppo.gamma,
        gae_lambda=ppo.gae_lambda,
        clip_range=ppo.clip_coef,
        ent_coef=ppo.entropy_coef,
        vf_coef=0.5,
        max_grad_norm=ppo.max_grad_norm,
        policy_kwargs={
            "net_arch": [problem.method.hidden] * 2,
            "activation_fn": torch.nn.Tanh,
            "log_std_init": float(np.log(ppo.std)),
        },
        seed=seed,
        device="cpu",
    )

    with torch.no_grad():
        model.policy.action_net.bias.copy_(torch.from_numpy(task.initial_action))
    noise = Noise(lambda: schedule.geometric(ppo.std, ppo.std_end, iteration))
    for iteration in range(1, peers.iterations + 1):
        began = time.process_time()
        model.learn(steps, callback=noise, reset_num_timesteps=False)
        run.cpu_seconds += time.process_time() - began
        run.env_steps = model.num_timesteps
        if peers.interval and iteration % peers.interval == 0:
            problem.evaluate(run, timed_policy(model, task.horizon))
    return run


def timed_policy(model: PPO, horizon: int) -> Act:
    """Return the sampled policy of a model whose last input is the time, for a collection from t = 0 on."""
    t = 0

    def act(observation: np.ndarray) -> np.ndarray:
        nonlocal t
        time = np.full((len(observation), 1), t / horizon, dtype=np.float32)
        t += 1
        return model.predict(np.concatenate([observation, time], 1))[0]

    return act


def run_apart(peers: Peers, side: Side, seed: int) -> Run:
    """Make a run in a process of its own, on one core."""
    words = ["--seeds", seed, "--iterations", peers.iterations, "--interval", peers.interval, "--side", side]
    command = ["taskset", "--cpu-list", peers.core, sys.executable, __file__, peers.task, *words]
    done = subprocess.run([str(word) for word in command], check=True, stdout=subprocess.PIPE, text=True)
    return Run(**json.loads(done.stdout))


def report(runs: Sequence[Run]) -> None:
    """Print the rates, their ratio over the pairs, and both learning curves."""
    sides = {side: [run for run in runs if run.side == side] for side in SIDES}
    for side, made in sides.items():
        rates = [run.rate for run in made]
        print(f"{side}: median {np.median(rates):,.0f} environment steps per CPU second, learning included")
    ratios = [ours.rate / theirs.rate for ours, theirs in zip(*sides.values(), strict=True)]
    print(f"ratio over {len(ratios)} pairs: median {np.median(ratios):.2f}, {min(ratios):.2f} to {max(ratios):.2f}")
    for at in range(len(runs[0].curve)):
        shown = []
        for side, made in sides.items():
            steps, cpu, success, returns = np.median([run.curve[at] for run in made], 0)
            each = " ".join(f"{run.curve[at][2]:.2f}" for run in made)
            rate = f"{steps / 1e6:.2f} M {cpu:5.1f} CPU-s"
            shown.append(f"{side} {rate} success {success:.2f} ({each}) return {returns:.2f}")
        print(" | ".join(shown))


def main(peers: Peers) -> None:
    if peers.side:
        torch.set_num_threads(1)
        make = run_ours if peers.side == "ours" else run_theirs
        print(json.dumps(vars(make(Problem.of(peers), peers, peers.seeds[0]))))
        return
    runs = []
    for seed in peers.seeds:
        for side in SIDES:
            runs.append(run_apart(peers, side, seed))
            print(f"seed {seed} {side}: {runs[-1].rate:,.0f} steps per CPU second", flush=True)
            if peers.out:
                with peers.out.open("a") as file:
                    file.write(json.dumps(vars(runs[-1])) + "\n")
    report(runs)


if __name__ == "__main__":
    main(tyro.cli(Peers, description=__doc__))
