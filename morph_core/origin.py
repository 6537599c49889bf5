"""Where a branch begins: one checkpoint of another run, copied into the new run's folder, so that its parent may go."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import safetensors.numpy

from morph_core import inside
from morph_core.config import Projection
from morph_core.design import DesignSpace
from morph_core.history import History, InForce
from morph_core.protocol import Parameter, Parent, RunRecord
from morph_core.run_folder import (
    ORIGIN,
    SMALL_BYTES,
    STATE_BYTES,
    WEIGHTS_BYTES,
    RunFolder,
    RunFolderError,
    find_run,
    foreign,
    unsealed,
)

_SAVED = {"state.json": STATE_BYTES, "weights.safetensors": WEIGHTS_BYTES}
"""The files of a checkpoint, and the largest that is read of each."""
_TRIES = 5


class _Facts(msgspec.Struct, frozen=True):
    """What a checkpoint's state.json says of where a branch begins."""

    iteration: int
    env_steps: int
    phi: list[float]
    parameters: list[Parameter]
    alpha: float
    projection: Projection


@dataclass(frozen=True)
class Origin:
    """The place in a run from which a branch begins, and the files that it takes along."""

    run: str
    record: RunRecord
    """Record of the run that is branched from."""
    iteration: int
    """Iteration that was asked for."""
    checkpoint: int | None
    """Iteration of the checkpoint that is taken, the nearest up to `iteration`; None where there is none."""
    in_force: InForce
    """Bounds, locks, phi, alpha and projection of that checkpoint."""
    env_steps: int
    """Environment steps that the run had taken by then."""
    files: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    """Content of the files of the new run's folder that hold the checkpoint, by their path in it."""

    @property
    def begins_at(self) -> int:
        """Iteration whose state is taken; 0 is the beginning."""
        return self.checkpoint or 0

    @property
    def parent(self) -> Parent:
        """Return how a record names this place."""
        return Parent(self.run, self.iteration, self.checkpoint)

    @property
    def words(self) -> str:
        """Return in words where a branch from here begins, and why there."""
        if self.checkpoint is None:
            here = f"at the beginning of {self.run}"
            return here if self.iteration == 0 else f"{here}: no checkpoint was saved up to iteration {self.iteration}"
        here = f"at iteration {self.checkpoint} of {self.run}"
        if self.checkpoint == self.iteration:
            return here
        return f"{here}, the nearest checkpoint up to iteration {self.iteration}"


def origin_at(history: History, iteration: int | None = None) -> Origin:
    """Return the place at `iteration` of a run, by default its last one, with the nearest checkpoint up to there.

    Raise RunFolderError where there is no such iteration, or that checkpoint is damaged.
    """
    folder, record, first = history.folder, history.record, history.begins_at
    asked = history.iteration if iteration is None else iteration
    if not first <= asked <= history.iteration:
        choice = (
            f"choose {first} to {history.iteration}" if history.iteration > first else f"it is at iteration {first}"
        )
        raise RunFolderError(f"{folder.id} has no iteration {asked}; {choice}")
    saved = [i for i in folder.checkpoint_iterations() if i <= asked]
    if not saved and record.parent and record.parent.checkpoint is not None:
        raise RunFolderError(f"{folder.id} has saved nothing yet: branch from its parent, {record.parent.run}")
    if not saved:
        return Origin(folder.id, record, asked, None, history.at(0), 0)
    try:
        with foreign(f"checkpoint {saved[-1]} of {folder.id}"):
            written, files = read_saved(folder, saved[-1])
            facts = msgspec.convert(written, _Facts)
            space = DesignSpace(tuple(facts.parameters))
            in_force = InForce(space, space.check(facts.phi), facts.alpha, facts.projection)
            weights = safetensors.numpy.load(files["weights.safetensors"])
            if not all(np.isfinite(tensor).all() for tensor in weights.values()):
                raise ValueError("a weight is infinite or NaN")
            run_json = inside.read(folder.path, "run.json", SMALL_BYTES)
    except RunFolderError as error:
        earlier = f"; the one before is of iteration {saved[-2]}" if len(saved) > 1 else ""
        raise RunFolderError(f"{error}{earlier}") from error
    here = f"{ORIGIN}/{folder.id}"
    taken = {f"{here}/checkpoints/{saved[-1]:06d}/{name}": content for name, content in files.items()}
    return Origin(
        folder.id, record, asked, saved[-1], in_force, facts.env_steps, {f"{here}/run.json": run_json, **taken}
    )


def taken_along(folder: RunFolder, record: RunRecord) -> RunFolder | None:
    """Return what a branch has of its parent, as a run folder with one checkpoint; None for a run without that.

    Raise RunFolderError where it is missing.
    """
    if record.parent is None or record.parent.checkpoint is None:
        return None
    return find_run(folder.path / ORIGIN, record.parent.run)


def read_saved(folder: RunFolder, iteration: int) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the facts and the files of a checkpoint; OSError or ValueError where it is not there, or not whole.

    The trainer may be putting a newer one of the same iteration in its place.
    """
    path = f"checkpoints/{iteration:06d}"
    for tries_left in reversed(range(_TRIES)):
        try:
            files = {name: inside.read(folder.path, f"{path}/{name}", most) for name, most in _SAVED.items()}
            return unsealed(files["state.json"], files["weights.safetensors"]), files
        except (FileNotFoundError, ValueError):
            if not tries_left:
                raise
            time.sleep(0.05)
    raise AssertionError("unreachable")
