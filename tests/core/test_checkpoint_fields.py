"""Every field of a State survives a checkpoint: a new one without a place in it fails here."""

import dataclasses
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from morph_core.checkpoint import load_checkpoint, save_checkpoint
from morph_core.explorations.gaussian import Gaussian
from morph_core.protocol import RunRecord
from morph_core.run_folder import RunFolder, create_run
from morph_core.searches.drift import Drift
from morph_core.state import State, start
from tests.core.scales import Scales, replaced

METHOD = replaced(search=Drift(pairs=8, designs=8), exploration=Gaussian(), design_interval=2)
NOT_KEPT = {
    "generation": "shown to people with the next evaluation, and drawn anew in every search for phi",
    "explored": "shown to people with the next evaluation, and drawn anew in every iteration",
    "learnt_in": "says only how long a run will take, and is measured anew in every iteration",
    "searched_in": "says only how long a run will take, and is measured anew in every search for phi",
    "collected_in": "says only how long a run will take, and is measured anew in every iteration",
}
"""Fields that no checkpoint holds, with the reason."""


def networks(hardware: Any) -> dict[str, Any]:
    """Return all numbers of what learns: a proxy, what a search keeps, or policy and critic."""
    if hasattr(hardware, "learners"):
        return {name: networks(hw_nn) for name, hw_nn in hardware.learners.items()} | {"facts": hardware.facts}
    modules = [getattr(hardware, name) for name in ("policy", "critic", "proxy") if hasattr(hardware, name)]
    weights = [{name: value.tolist() for name, value in module.state_dict().items()} for module in modules]
    moments = hardware.optimizer.state_dict()["state"]
    return {"weights": weights, "moments": {i: {n: v.tolist() for n, v in m.items()} for i, m in moments.items()}}


AS_NUMBERS: dict[str, Callable[[Any], Any]] = {
    "phi": lambda phi: phi.tolist(),
    "notes": lambda notes: {name: array.tolist() for name, array in notes.arrays.items()},
    "rng": lambda rng: rng.bit_generator.state,
    "control": networks,
    "proxy": networks,
    "memory": networks,
}
"""How the fields are compared that don't compare themselves."""


def numbers(state: State, name: str) -> Any:
    return AS_NUMBERS.get(name, lambda value: value)(getattr(state, name))


def lived() -> State:
    """Return a state of which no field is as it was at the start."""
    state = start(Scales(), METHOD, 5)
    list(itertools.islice(METHOD.iterations(Scales(), state), 3))  # after a search, proxy and reference parted again
    state.design_space = state.design_space.with_bound("first", -1.0, 19.0).with_lock("second", 3.5)
    state.phi = state.design_space.clip(state.phi)
    state.alpha, state.projection = 7.25, "as_printed"
    state.diverged, state.control_start, state.last_reached = 11, 2, 3
    state.frozen = True
    state.notes.recall({"directions": np.arange(12.0).reshape(2, 2, 3)})
    return state


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    record = RunRecord(
        id="run", task="scales", method="morph", seed=0, iterations=6, config={},
        parameters=list(Scales().design_space.parameters), versions={}, created=time.time(),
    )  # fmt: skip
    return create_run(tmp_path, record)


FIELDS = [field.name for field in dataclasses.fields(State)]


@pytest.mark.parametrize("name", [name for name in FIELDS if name not in NOT_KEPT])
def test_a_field_that_has_changed_survives_a_checkpoint(name: str, folder: RunFolder) -> None:
    state, fresh = lived(), start(Scales(), METHOD, 0)
    assert numbers(state, name) != numbers(fresh, name), f"let lived() change {name}, so that its loss would show"
    save_checkpoint(folder, state, 1.5)
    loaded, _ = load_checkpoint(folder, state.iteration, Scales(), METHOD)
    assert numbers(loaded, name) == numbers(state, name)


def test_what_is_not_kept_is_a_field_with_a_reason() -> None:
    assert set(NOT_KEPT) <= set(FIELDS)
    assert all(NOT_KEPT.values())


def test_notes_of_an_exploration_have_the_name_that_checkpoints_of_before_have(folder: RunFolder) -> None:
    save_checkpoint(folder, lived(), 0.0)
    assert "exploration/directions" in load_file(folder.checkpoint(3) / "weights.safetensors")


def test_a_loaded_run_goes_on_as_the_saved_one(folder: RunFolder) -> None:
    state = lived()
    save_checkpoint(folder, state, 1.5)
    loaded, cpu_seconds = load_checkpoint(folder, state.iteration, Scales(), METHOD)
    assert cpu_seconds == 1.5
    ahead, behind = (list(itertools.islice(METHOD.iterations(Scales(), s), 3)) for s in (state, loaded))
    assert ahead == behind
    for name, module in state.modules.items():
        for key, value in module.state_dict().items():
            assert torch.equal(loaded.modules[name].state_dict()[key], value)


def test_phi_is_checked_against_the_box_that_was_saved(folder: RunFolder) -> None:
    state = lived()
    state.phi = np.array([0.0, 3.5])
    save_checkpoint(folder, state, 0.0)
    loaded, _ = load_checkpoint(folder, state.iteration, Scales(), METHOD)
    assert loaded.phi.tolist() == [0.0, 3.5]
    assert loaded.design_space == state.design_space
