"""Checkpoints: the whole State as safetensors and JSON, there whole or not at all."""

from collections.abc import Mapping

import msgspec
import torch
from safetensors.torch import load, save
from torch import Tensor, nn

from morph_core import durable, inside
from morph_core.config import Alpha, check_value
from morph_core.design import DesignSpace
from morph_core.method import Method
from morph_core.origin import read_saved
from morph_core.protocol import Parameter
from morph_core.run_folder import CHECKPOINT, RunFolder, RunFolderError, foreign, sealed
from morph_core.state import State, start
from morph_core.task import Task

NOTES = "exploration/"
"""What the names of the exploration's notes begin with among the tensors."""


def save_checkpoint(folder: RunFolder, state: State, cpu_seconds: float) -> None:
    """Write checkpoints/<iteration>/; an earlier one of the same iteration stays until the new one is whole.

    Raise OSError if the disk does not take it, whichever part of it.
    """
    inside.folder(folder.path, "checkpoints")
    with durable.replaced_folder(folder.checkpoint(state.iteration)) as draft:
        # Not save_file: its files are their owner's alone, whatever the umask, and a group could not go on with a run.
        weights = save(tensors_of(state))
        (draft / "weights.safetensors").write_bytes(weights)
        facts = {
            "iteration": state.iteration,
            "env_steps": state.env_steps,
            "relabelled_steps": state.relabelled_steps,
            "search_steps": state.search_steps,
            "diverged": state.diverged,
            "control_start": state.control_start,
            "last_reached": state.last_reached,
            "phi": state.phi.tolist(),
            "parameters": msgspec.to_builtins(state.design_space.parameters),
            "alpha": state.alpha,
            "projection": state.projection,
            "fitted": state.fitted,
            "frozen": state.frozen,
            "memory": state.memory.facts,
            "rng": state.rng.bit_generator.state,
            "cpu_seconds": cpu_seconds,
        }
        (draft / "state.json").write_bytes(sealed(facts, weights))


def recover_checkpoints(folder: RunFolder) -> None:
    """Tidy up after a trainer that died while saving: an old checkpoint moved aside comes back, drafts go."""
    if inside.names(folder.path, "checkpoints"):
        durable.recover(folder.checkpoints, CHECKPOINT)


def load_checkpoint(folder: RunFolder, iteration: int, task: Task, method: Method) -> tuple[State, float]:
    """Return the state after `iteration` and the CPU seconds it took; RunFolderError says what is damaged."""
    with foreign(f"checkpoint {iteration} of {folder.id}"):
        facts, files = read_saved(folder, iteration)
        tensors = load(files["weights.safetensors"])
        if facts["iteration"] != iteration:
            raise ValueError(f"it says that it is of iteration {facts['iteration']}")
        space = DesignSpace(tuple(msgspec.convert(facts["parameters"], list[Parameter])))
        state = start(task, method, 0, space)
        state.iteration, state.env_steps = facts["iteration"], facts["env_steps"]
        diverged = "diverged" if "diverged" in facts else "truncations"  # as format 1 called it
        state.relabelled_steps, state.diverged = facts["relabelled_steps"], facts[diverged]
        state.search_steps = facts.get("search_steps", 0)  # once counted among those of relabelling
        state.control_start, state.last_reached = facts["control_start"], facts["last_reached"]
        state.phi = space.check(facts["phi"])
        state.alpha, state.projection = _runnable(facts["alpha"], method), facts["projection"]
        state.fitted, state.frozen = facts["fitted"], facts["frozen"]
        state.rng.bit_generator.state = facts["rng"]
        state.memory.recall(facts.get("memory", {}))
        restore(state.modules, state.optimizers, tensors)
        state.notes.recall({k.removeprefix(NOTES): v.numpy() for k, v in tensors.items() if k.startswith(NOTES)})
        if damage := damage_of(state):
            raise ValueError(damage)
        return state, float(facts["cpu_seconds"])


def _runnable(alpha: float, method: Method) -> float:
    """Return the alpha of a checkpoint, or that of the method where no iteration can be run with it: versions without
    an upper bound accepted any."""
    try:
        check_value("alpha", Alpha, alpha)
    except ValueError:
        return method.steering[0]
    return alpha


def load_newest(folder: RunFolder, task: Task, method: Method) -> tuple[tuple[State, float] | None, list[str]]:
    """Return the newest checkpoint that can be read, or None, and why each newer one can't be: older ones stand in."""
    damaged = []
    for iteration in reversed(folder.checkpoint_iterations()):
        try:
            return load_checkpoint(folder, iteration, task, method), damaged
        except RunFolderError as error:
            damaged.append(str(error))
    return None, damaged


def tensors_of(state: State) -> dict[str, Tensor]:
    """Return every tensor that a checkpoint holds, by the name that it has there."""
    tensors = {}
    for name, module in state.modules.items():
        tensors |= {f"{name}/{key}": value.contiguous() for key, value in module.state_dict().items()}
    for name, optimizer in state.optimizers.items():
        for index, moments in optimizer.state_dict()["state"].items():
            tensors |= {f"{name}_optimizer/{index}/{key}": value.contiguous() for key, value in moments.items()}
    return tensors | {f"{NOTES}{name}": torch.from_numpy(array) for name, array in state.notes.arrays.items()}


def restore(
    modules: Mapping[str, nn.Module], optimizers: Mapping[str, torch.optim.Optimizer], tensors: Mapping[str, Tensor]
) -> None:
    """Give networks and optimisers what `tensors_of` a state has under their names."""
    for name, module in modules.items():
        prefix = f"{name}/"
        module.load_state_dict({k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)})
    for name, optimizer in optimizers.items():
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith(f"{name}_optimizer/"):
                _, index, moment = key.split("/")
                moments.setdefault(int(index), {})[moment] = value
        optimizer.load_state_dict({**optimizer.state_dict(), "state": moments})


def damage_of(state: State) -> str:
    """Return in words what of a state no iteration can begin with: phi outside its box, a weight or what an optimiser
    remembers that is NaN or infinite. Return nothing where all is well."""
    try:
        state.design_space.check(state.phi)
    except ValueError as error:
        return f"the design phi left its box: {error}"
    for name, module in state.modules.items():
        if not all(bool(torch.isfinite(p).all()) for p in module.parameters()):
            return f"a weight of {name} became infinite or NaN"
    for name, optimizer in state.optimizers.items():
        moments = (moment for entry in optimizer.state.values() for moment in entry.values())
        if not all(bool(torch.isfinite(moment).all()) for moment in moments):
            return f"what Adam remembers of the gradients of {name} became infinite or NaN"
    return ""
