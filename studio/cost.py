"""What an iteration of a run may take, from counts of its steps and a short look at how fast they are done here."""

import time

import numpy as np

from morph_core.catalogue import make_task, read_method
from morph_core.config import Settings
from morph_core.method import Method
from morph_core.protocol import RunRecord
from morph_core.task import Task

ABSURD = 600.0
"""Seconds of an iteration from which on a run is started only where somebody has said yes to it: a trainer looks for
commands between two iterations."""
_LOOK = 64
"""Number of environments of which the steps are timed."""
_PASSES = 6.0
"""Floating-point operations per weight and sample: forward, and twice as many backward."""
_PER_SECOND = 1e10
"""Floating-point operations of small layers that one core of today does in a second."""
_PER_GRADIENT_STEP = 2e-3
"""Seconds that a gradient step of policy, critic and proxy takes however small it is."""


class CostlyError(ValueError):
    """A run whose iterations would take absurdly long, to which nobody has said yes; it says how long."""


def seconds_per_iteration(task: Task, method: Method) -> float:
    """Return about how many seconds an iteration takes on this machine, evaluations and the search for phi included."""
    return _simulated(task, method) * seconds_per_step(task) + _learning(task, method)


def check_cost(task: Task, method: Method, agreed: bool) -> None:
    """Raise CostlyError with the estimate where an iteration would take absurdly long and nobody has `agreed`."""
    if agreed or (estimate := seconds_per_iteration(task, method)) < ABSURD:
        return
    raise CostlyError(
        f"an iteration of this run would take {in_words(estimate)}, and only between two can it be stopped or steered: "
        "ask for less (trajectories, epochs, hidden, pairs, generations), or say yes to it with costly"
    )


def in_words(seconds: float) -> str:
    """Return a duration as a person says it: "about 40 s"."""
    for size, unit in ((86400, "days"), (3600, "hours"), (60, "minutes")):
        if seconds >= 2 * size:
            return f"about {seconds / size:.0f} {unit}"
    return f"about {seconds:.0f} s" if seconds >= 1.5 else "about a second or less"


def seconds_per_step(task: Task) -> float:
    """Return how many seconds a step of one environment of a task takes here, of one core, measured on a few."""
    rng = np.random.default_rng(0)
    hw_phy = task.hw_phy(task.design_space.initial)
    s, still = task.reset(hw_phy, _LOOK, rng), np.zeros((_LOOK, task.action_size))
    s = task.step(hw_phy, s, still).s  # compiles
    began = time.process_time()  # what else the machine does is not the run's
    task.step(hw_phy, s, still)
    return (time.process_time() - began) / _LOOK


def _simulated(task: Task, method: Method) -> float:
    """Return how many steps an iteration simulates: trajectories, its share of the evaluations, and the search."""
    evaluation = method.evaluation
    evaluated = 2 * evaluation.episodes * task.horizon / evaluation.interval
    return method.trajectories * task.horizon + evaluated + _searched(method)


def _searched(method: Method) -> float:
    """Return how many steps the search for phi takes per iteration, by what such settings are called."""
    search = getattr(method, "search", None)
    if not isinstance(search, Settings):
        return 0.0
    counts = ("pairs", "population", "generations", "designs", "groups", "steps")
    steps = float(np.prod([getattr(search, name) for name in counts if hasattr(search, name)], dtype=float))
    return steps / getattr(method, "design_interval", 1)


def _learning(task: Task, method: Method) -> float:
    """Return how many seconds the gradient steps of policy, critic and proxy take."""
    inputs = task.observation_size + task.action_size
    weights = 3 * method.hidden * (method.hidden + 2 * inputs)
    samples = method.trajectories * task.horizon * method.ppo.epochs
    return samples * weights * _PASSES / _PER_SECOND + method.ppo.epochs * method.ppo.minibatches * _PER_GRADIENT_STEP


def cost_of(record: RunRecord) -> str:
    """Return in words what an iteration of a run may take."""
    task = make_task(record.task, record.task_options)
    return in_words(seconds_per_iteration(task, read_method(record)))
