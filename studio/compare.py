"""Two designs of any runs of one task, side by side: what each came to, what it weighs, and how they differ."""

import functools
import json
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.protocol import Evaluation
from morph_core.what_if import wilson_interval


class Side(msgspec.Struct, frozen=True, kw_only=True):
    """One of two designs, and what its policy came to in the evaluation of its iteration; None and empty without one.

    Success and return are those of the sampled policy on Hw-Phy.
    """

    run: str
    iteration: int
    task: str
    method: str
    phi: dict[str, float]
    masses: dict[str, float]
    """kg: the masses of the robot's bodies; empty where the task of another version can't build it."""
    mass: float | None
    """kg: the mass of the robot."""
    episodes: int | None = None
    success: float | None = None
    success_interval: tuple[float, float] | None = None
    """Wilson's interval of the success, at 95 %; None in a run that did not write down how many episodes it was."""
    episode_return: float | None = None
    return_interval: tuple[float, float] | None = None
    """Interval of the mean return, at 95 %; None in a run that did not write it down."""
    reward_terms: dict[str, float] = {}
    """Terms of the reward, summed over an episode: their means, which add up to the return."""
    note: str = ""
    """Sentence on why there is no success; empty where there is one."""


class Differences(msgspec.Struct, frozen=True, kw_only=True):
    """Second design less the first, in everything that both have."""

    phi: dict[str, float]
    masses: dict[str, float]
    mass: float | None
    success: float | None
    episode_return: float | None
    reward_terms: dict[str, float]


class Compared(msgspec.Struct, frozen=True, kw_only=True):
    """Two designs and their differences, b - a; phi in its own `units`."""

    units: dict[str, str]
    a: Side
    b: Side
    differences: Differences


def split_place(word: str) -> tuple[str, str]:
    """Return the run and the design of RUN@DESIGN, where the design is best, latest or an iteration; RUN alone means
    the best one."""
    run, at, which = word.rpartition("@")
    return (run, which) if at else (word, "best")


def compare(first: History, which: str, second: History, other: str) -> Compared:
    """Return two designs side by side: design `which` of the first run and `other` of the second one.

    Raise RunFolderError with the choices where there is no such design, ValueError where the tasks differ.
    """
    check_alike(first, second)
    a, b = side_of(first, which), side_of(second, other)
    return Compared(
        units={p.name: p.unit for history in (first, second) for p in history.record.parameters},
        a=a,
        b=b,
        differences=Differences(
            phi=_less(b.phi, a.phi),
            masses=_less(b.masses, a.masses),
            mass=_minus(b.mass, a.mass),
            success=_minus(b.success, a.success),
            episode_return=_minus(b.episode_return, a.episode_return),
            reward_terms=_less(b.reward_terms, a.reward_terms),
        ),
    )


def check_alike(first: History, second: History) -> None:
    """Raise ValueError with the reason unless the designs of two runs can be compared."""
    if first.record.task != second.record.task:
        raise ValueError(
            f"designs of different tasks can't be compared: {first.folder.id} is of {first.record.task}, "
            f"{second.folder.id} of {second.record.task}; choose two runs of one task"
        )


def side_of(history: History, which: str) -> Side:
    """Return one design of a run: best, latest or an iteration. RunFolderError says what is allowed."""
    iteration, phi = history.design(which)
    record = history.record
    masses = dict(_masses(record.task, json.dumps(record.task_options, sort_keys=True), tuple(phi.tolist())))
    said = evaluation_of(history, iteration)
    measured: dict[str, Any] = _measured(said) if said else {"note": _why_not_evaluated(history, iteration)}
    return Side(
        run=history.folder.id,
        iteration=iteration,
        task=record.task,
        method=record.method,
        phi=dict(zip(history.design_space.names, phi.tolist(), strict=True)),
        masses=masses,
        mass=sum(masses.values()) if masses else None,
        **measured,
    )


def evaluation_of(history: History, iteration: int) -> Evaluation | None:
    """Return the evaluation of an iteration, of several the one with the most episodes; None without any."""
    known = [e for e in history.evaluations if e.iteration == iteration]
    return max(known, key=lambda e: (e.episodes or 0, e.final), default=None)


def _measured(said: Evaluation) -> dict[str, Any]:
    interval = wilson_interval(round(said.sampled_success * said.episodes), said.episodes) if said.episodes else None
    return {
        "episodes": said.episodes,
        "success": said.sampled_success,
        "success_interval": interval,
        "episode_return": said.sampled_return,
        "return_interval": said.return_interval,
        "reward_terms": said.reward_terms,
    }


def _why_not_evaluated(history: History, iteration: int) -> str:
    known = sorted({e.iteration for e in history.evaluations}, key=lambda i: (abs(i - iteration), i))
    nearest = f"the nearest evaluation is of iteration {known[0]}" if known else "no evaluation was made yet"
    return f"iteration {iteration} of {history.folder.id} was not evaluated: {nearest}"


@functools.lru_cache(maxsize=64)
def _masses(task: str, options: str, phi: tuple[float, ...]) -> Mapping[str, float]:
    """Return the masses in kg of the robot's bodies; of a task of another version, which can't be made, none."""
    try:
        model = make_task(task, json.loads(options)).spec(np.array(phi)).compile()
    except (ValueError, TypeError):
        return {}
    return {model.body(i).name: float(model.body_mass[i]) for i in range(1, model.nbody) if model.body_mass[i] > 0}


def _less(b: Mapping[str, float], a: Mapping[str, float]) -> dict[str, float]:
    return {name: value - a[name] for name, value in b.items() if name in a}


def _minus(b: float | None, a: float | None) -> float | None:
    return None if a is None or b is None else b - a
