"""A new run: its settings checked, its record written, with what would be needed to run it again."""

import contextlib
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from morph_core.catalogue import make_method, make_task
from morph_core.config import recorded
from morph_core.design import DesignSpace
from morph_core.protocol import FORMAT, Parameter, Parent, RunRecord
from morph_core.run_folder import RunFolder, RunFolderError, create_run, new_run_id
from studio import limits
from studio.versions import versions_of

_PACKAGES = ("morph-studio", "numpy", "torch", "mujoco", "cma", "viser")


@dataclass(frozen=True)
class Machine:
    """What a record says of where a run was made: `machine()` asks for it, once for many runs."""

    versions: dict[str, str]
    git_revision: str | None
    git_dirty: bool | None


def machine() -> Machine:
    """Return the versions of what runs depend on, and the state of the checkout this code runs from."""
    return Machine(versions_of(*_PACKAGES), *git_state())


def prepare_run(runs: Path, **wishes: Any) -> RunFolder:
    """Create the folder of a new run, as `record_of` has it, under a name that is free."""
    record = record_of(**wishes)
    number = 1
    while True:
        name = record.id if number == 1 else f"{record.id}-{number}"
        if not (runs / name).exists():
            with contextlib.suppress(RunFolderError):  # another process was faster: take the next name
                return create_run(runs, msgspec.structs.replace(record, id=name))
        number += 1


def record_of(
    *,
    task: str,
    preset: str | None = None,
    method: str | None = None,
    seed: int = 0,
    iterations: int = 100,
    settings: Mapping[str, object] | None = None,
    task_options: Mapping[str, object] | None = None,
    parameters: Sequence[Parameter] | None = None,
    parent: Parent | None = None,
    env_steps: int | None = None,
    final_episodes: int = 0,
    made_on: Machine | None = None,
) -> RunRecord:
    """Return the record of a new run; raise ValueError that says what is allowed.

    `settings` are laid over those of the `preset`, if one is named, and those over what was found to work for the task.
    """
    try:
        chosen = make_task(task, task_options)
        configured = make_method(method, chosen, settings, preset)
    except (TypeError, OverflowError) as error:  # a list where a number belongs, 10**400 where a float does
        raise ValueError(f"a setting of {task} has the wrong type or size: {error}") from error
    seed, iterations = limits.seed(seed), limits.iterations(iterations)
    env_steps = None if env_steps is None else limits.env_steps(env_steps)
    space = chosen.design_space
    if parameters is not None:
        space = _edited(space, parameters)
    chosen.check_buildable(space.initial)
    here = machine() if made_on is None else made_on
    return RunRecord(
        format=FORMAT,
        id=new_run_id(task, configured.name, seed),
        task=task,
        task_options=dict(task_options or {}),
        method=configured.name,
        seed=seed,
        iterations=iterations,
        env_steps=env_steps,
        final_episodes=limits.final_episodes(final_episodes),
        config=recorded(configured),
        parameters=list(space.parameters),
        versions=here.versions,
        git_revision=here.git_revision,
        git_dirty=here.git_dirty,
        created=time.time(),
        parent=parent,
    )


def _edited(space: DesignSpace, parameters: Sequence[Parameter]) -> DesignSpace:
    """Return `space` with the bounds, locks and initial values of `parameters`; the rest is the task's."""
    for p in parameters:
        i = space.index(p.name)
        space = space.with_bound(p.name, p.lo, p.hi)
        if p.locked_at is not None:
            space = space.with_lock(p.name, p.locked_at)
        if not space.parameters[i].lo <= p.initial <= space.parameters[i].hi:
            raise ValueError(f"the initial {p.name} must lie inside [{p.lo:g}, {p.hi:g}] {p.unit}, not {p.initial:g}")
        moved = msgspec.structs.replace(space.parameters[i], initial=p.initial)
        space = DesignSpace((*space.parameters[:i], moved, *space.parameters[i + 1 :]))
    return space


def git_state() -> tuple[str | None, bool | None]:
    """Return revision and dirty flag of the checkout this code runs from; None outside one."""
    here = Path(__file__).resolve()

    def git(*words: str) -> str:
        command = ["git", "--no-optional-locks", "-C", str(here.parent), *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout

    try:
        git("ls-files", "--error-unmatch", here.name)  # not some other checkout that this is installed in
        return git("rev-parse", "HEAD").strip(), bool(git("status", "--porcelain", "--untracked-files=no").strip())
    except (OSError, subprocess.SubprocessError):
        return None, None
