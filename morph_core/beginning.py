"""The state with which a run begins: as its seed makes it, or with what a branch took along of its parent."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from torch import nn

from morph_core.catalogue import read_method
from morph_core.checkpoint import load_checkpoint, restore, tensors_of
from morph_core.design import DesignSpace
from morph_core.method import Method
from morph_core.origin import taken_along
from morph_core.protocol import Parent, RunRecord
from morph_core.run_folder import RunFolder
from morph_core.state import State, start
from morph_core.task import Task

_COUNTS = (
    "iteration", "env_steps", "relabelled_steps", "search_steps", "diverged", "control_start", "last_reached",
)  # fmt: skip


@dataclass(frozen=True)
class Beginning:
    """The state before the first iteration, and how it came about."""

    state: State
    cpu_seconds: float
    """CPU time that went into the state before this run."""
    words: str
    """Clause that says where the state comes from, and what of it was made afresh."""


def begin(folder: RunFolder, record: RunRecord, task: Task, method: Method) -> Beginning:
    """Return the state with which a run begins; RunFolderError says what is damaged.

    A branch with its parent's method goes on where the parent was: iterations, steps and schedules count on, and it
    takes along policy, critic and proxy with their optimisers, the memory of the search, and, with the parent's seed,
    the random state; with another seed the random numbers are that seed's. So a branch in which nothing is changed
    goes on exactly as its parent did. Networks of another size than the parent's start afresh, policy and critic with
    their schedule, and the proxy is fitted anew; it is fitted anew, too, where phi was moved or the search keeps a
    network that the parent's does not have.

    A branch with another method counts from 0 with the random numbers of its own seed, and takes along phi, the bounds
    and the weights of those networks of policy and critic that have the same size; its optimisers and its proxy start
    afresh.
    """
    state = start(task, method, record.seed, DesignSpace(tuple(record.parameters)))
    source, parent = taken_along(folder, record), record.parent
    if source is None or parent is None or parent.checkpoint is None:
        return Beginning(state, 0.0, _from_design(parent))
    theirs = source.record()
    before, cpu_seconds = load_checkpoint(source, parent.checkpoint, task, read_method(theirs))
    here = f"branched at iteration {parent.checkpoint} of {parent.run}"
    if parent.checkpoint != parent.iteration:
        here += f" (its nearest checkpoint up to iteration {parent.iteration})"
    if record.method != theirs.method:
        return Beginning(state, 0.0, f"{here} with another method: counts from 0, {_adopt(state, before)}")
    taken, afresh = _go_on(state, before, same_seed=record.seed == theirs.seed)
    return Beginning(state, cpu_seconds, f"{here}: takes along {', '.join(taken)}" + "".join(f"; {a}" for a in afresh))


def _from_design(parent: Parent | None) -> str:
    return f"from the design of iteration {parent.iteration} of {parent.run}" if parent else "from the initial design"


def _go_on(state: State, before: State, same_seed: bool) -> tuple[list[str], list[str]]:
    """Let a state go on where another one of the same method was; return what was taken, and what was not."""
    for name in _COUNTS:
        setattr(state, name, getattr(before, name))
    taken, afresh = ["phi", "bounds"], []
    moved = not np.array_equal(state.phi, before.phi)
    state.frozen = before.frozen and not moved and _box_of(state) == _box_of(before)
    if same_seed:
        state.rng = before.rng
        taken.append("random state")
    else:
        afresh.append("random numbers of another seed")
    tensors = tensors_of(before)
    if _fits(state.control.modules, before.control.modules):
        restore(state.control.modules, {"control": state.control.optimizer}, tensors)
        taken.append("policy and critic")
    else:
        state.control_start = state.last_reached = state.iteration
        state.frozen = False
        afresh.append("policy and critic start afresh: their networks have another size")
    if _fits(_networks(state), _networks(before)):
        restore(_networks(state), {name: hw_nn.optimizer for name, hw_nn in state.proxies.items()}, tensors)
        state.fitted = before.fitted and not moved
        if type(state.notes) is type(before.notes):
            state.notes.recall(before.notes.arrays)
        taken += ["proxy"] * bool(state.proxies)
    if state.proxies and before.fitted and not state.fitted:
        afresh.append("the proxy is fitted anew")
    if type(state.memory) is type(before.memory):
        state.memory.recall(before.memory.facts)
    return taken, afresh


def _adopt(state: State, before: State) -> str:
    """Take the weights of policy and critic that fit from the state of another method; return in words what was taken.

    phi and the bounds are in `state` already: they stand in the run's record.
    """
    tensors = tensors_of(before)
    fitting = [
        name for name, module in state.control.modules.items()
        if _fits({name: module}, {n: m for n, m in before.control.modules.items() if n == name})
    ]  # fmt: skip
    restore({name: state.control.modules[name] for name in fitting}, {}, tensors)
    others = [name for name in state.control.modules if name not in fitting]
    taken = "takes along " + ", ".join(["phi", "bounds", *(f"weights of the {name}" for name in fitting)])
    return taken + (f"; {' and '.join(others)} start afresh: their networks have another size" if others else "")


def _networks(state: State) -> Mapping[str, nn.Module]:
    return {name: hw_nn.proxy for name, hw_nn in state.proxies.items()}


def _fits(ours: Mapping[str, nn.Module], theirs: Mapping[str, nn.Module]) -> bool:
    """Tell whether each of our networks is there among theirs with weights of the same shapes."""
    return all(name in theirs and _shapes(module) == _shapes(theirs[name]) for name, module in ours.items())


def _shapes(module: nn.Module) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}


def _box_of(state: State) -> list[tuple[float, float, float | None]]:
    return [(p.lo, p.hi, p.locked_at) for p in state.design_space.parameters]
