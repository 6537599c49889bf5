"""A new run: what can be wished for, checked, and its record written with what would be needed to run it again."""

import contextlib
import subprocess
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from morph_core.catalogue import configured, make_method, make_task, read_method
from morph_core.config import flattened, paths_of, recorded
from morph_core.design import DesignSpace
from morph_core.history import History
from morph_core.keeping import pin
from morph_core.method import Method
from morph_core.origin import Origin, origin_at
from morph_core.protocol import FORMAT, Parameter, Parent, RunRecord, Whole
from morph_core.run_folder import RunFolder, RunFolderError, create_run, find_run, new_run_id
from morph_core.task import Task
from studio import limits
from studio.cost import check_cost
from studio.versions import hardware, versions_of

DEFAULT_ITERATIONS = 100
PACKAGES = ("morph-studio", "numpy", "torch", "mujoco", "cma", "viser")
"""Packages whose versions a record holds: the results of a run may depend on them."""
Number = Annotated[int, msgspec.Meta(ge=1, le=limits.MAX_ITERATIONS)]


@dataclass(frozen=True)
class Machine:
    """What a record says of where a run was made: `machine()` asks for it, once for many runs."""

    versions: dict[str, str]
    git_revision: str | None
    git_dirty: bool | None


def machine() -> Machine:
    """Return the versions of what runs depend on, the processor, and the state of the checkout this code runs from."""
    return Machine(versions_of(*PACKAGES) | hardware(), *git_state())


class Branch(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The place in a run of the same folder from which a new run begins, with what was learnt up to there."""

    run: str
    iteration: Whole | None = None
    """Iteration of that run, by default its last one; the nearest checkpoint up to there is taken."""


class StartRun(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Wish for a new run. `settings` are those of the method under dotted names, such as `search.ridge`, or nested;
    `task_options` are fields of the task; unset ones are defaults, or those of the run that is branched from."""

    task: str | None = None
    """Task of the run; a branch keeps that of its parent, and its options."""
    preset: str | None = None
    """Word for a whole set of settings of a method; `settings` are laid over it. GET /api/tasks lists them."""
    method: str | None = None
    """Method of the run; without it, the one of the preset, of the run that is branched from, or morph."""
    seed: Annotated[int, msgspec.Meta(ge=0, le=limits.LARGEST_SEED)] | None = None
    """Seed of all randomness, by default 0. A branch keeps its parent's, and with it the random state."""
    iterations: Number | None = None
    """Number of iterations, by default 100, or as many as the budget holds; of a branch those after the one it begins
    at, by default as many as its parent had planned."""
    settings: dict[str, object] = {}
    task_options: dict[str, object] = {}
    parameters: list[Parameter] | None = None
    """Bounds, locks and initial values to start with; unnamed parameters keep those of the task, or of the run that is
    branched from."""
    parent: Parent | None = None
    """Run and iteration whose design this run begins with, for the record: nothing of it is taken along."""
    branch: Branch | None = None
    """Run and iteration to go on from, with what was learnt up to there."""
    env_steps: Annotated[int, msgspec.Meta(ge=1, le=limits.MAX_ENV_STEPS)] | None = None
    """Budget of environment steps after which the run ends; a branch that counts on has some behind it."""
    final_episodes: Annotated[int, msgspec.Meta(ge=0, le=limits.MAX_FINAL_EPISODES)] = 0
    """Episodes of each kind in an evaluation at the end."""
    costly: bool = False
    """Yes to a run of which an iteration may take longer than ten minutes."""


def again(record: RunRecord) -> StartRun:
    """Return the wish for a run once again: with its settings, its seed, and what it began with."""
    return StartRun(
        task=record.task,
        method=record.method,
        seed=record.seed,
        iterations=record.iterations if record.env_steps is None else None,
        settings=record.config,
        task_options=record.task_options,
        parameters=record.parameters,
        env_steps=record.env_steps,
    )


def prepare_run(runs: Path, wish: StartRun) -> RunFolder:
    """Create the folder of a new run, as `record_of` has it, under a name that is free.

    Raise ValueError that says what is allowed; RunFolderError where the run to branch from can't be used.
    """
    origin = origin_at(History(find_run(runs, wish.branch.run)), wish.branch.iteration) if wish.branch else None
    record = record_of(wish, origin)
    files = origin.files if origin else {}
    number = 1
    while True:
        name = record.id if number == 1 else f"{record.id}-{number}"
        if not (runs / name).exists():
            with contextlib.suppress(RunFolderError):  # another process was faster: take the next name
                created = create_run(runs, msgspec.structs.replace(record, id=name), files)
                if origin and origin.checkpoint is not None:
                    pin(find_run(runs, origin.run), origin.checkpoint)
                return created
        number += 1


def record_of(wish: StartRun, origin: Origin | None = None, made_on: Machine | None = None) -> RunRecord:
    """Return the record of a new run; raise ValueError that says what is allowed.

    Settings are laid over those of the preset, if one is named, and those over what was found to work for the task. A
    branch, which begins at `origin`, is like its parent in all that is not wished for.
    """
    try:
        task = _task_of(wish, origin)
        method = _method_of(wish, origin, task)
    except (TypeError, OverflowError) as error:  # a list where a number belongs, 10**400 where a float does
        raise ValueError(f"a setting of {wish.task} has the wrong type or size: {error}") from error
    space = _space_of(wish, task, origin)
    task.check_buildable(space.initial)
    check_cost(task, method, wish.costly)
    goes_on = origin is not None and method.name == origin.record.method
    begins_at, spent = (origin.begins_at, origin.env_steps) if origin and goes_on else (0, 0)
    iterations, env_steps = _length(wish, origin, begins_at, spent)
    seed = limits.seed(wish.seed if wish.seed is not None else origin.record.seed if origin else 0)
    here = machine() if made_on is None else made_on
    return RunRecord(
        format=FORMAT,
        id=new_run_id(task.name, method.name, seed),
        task=task.name,
        task_options=dict(origin.record.task_options if origin else wish.task_options),
        method=method.name,
        seed=seed,
        iterations=iterations,
        env_steps=env_steps,
        final_episodes=limits.final_episodes(wish.final_episodes),
        config=recorded(method),
        parameters=list(space.parameters),
        versions=here.versions,
        git_revision=here.git_revision,
        git_dirty=here.git_dirty,
        created=time.time(),
        parent=origin.parent if origin else wish.parent,
        begins_at=begins_at,
    )


# --- branches ---------------------------------------------------------------------------------------------------------


def method_at(origin: Origin) -> Method:
    """Return the method of the run that is branched from, with alpha and projection as they were in force there."""
    method = read_method(origin.record)
    in_force = {"alpha": origin.in_force.alpha, "projection": origin.in_force.projection}
    return configured(method, {path: value for path, value in in_force.items() if path in dict(paths_of(method))})


def resettled(method: Method, task: Task, settings: Mapping[str, object]) -> Method:
    """Return a method with `settings` on top of its own; ValueError says what is allowed.

    Where they choose another exploration or search, that has what was found to work for the task.
    """
    kept, asked = dict(paths_of(method)), flattened(dict(settings))
    chosen_anew = [
        path for path, value in asked.items()
        if value != kept.get(path) and any(other.startswith(f"{path}.") for other in kept)
    ]  # fmt: skip
    for path in chosen_anew:
        kept = {other: value for other, value in kept.items() if not f"{other}.".startswith(f"{path}.")}
    return make_method(method.name, task, kept | asked)


def space_at(origin: Origin) -> DesignSpace:
    """Return the design space of the task with the bounds and locks in force at `origin`, and phi as initial design.

    Raise ValueError where the task has other design parameters by now.
    """
    theirs, task = origin.in_force.space, make_task(origin.record.task, origin.record.task_options)
    if theirs.names != task.design_space.names:
        raise ValueError(
            f"{origin.run} is of another version of {task.name}: its design parameters were "
            f"{', '.join(theirs.names)}, and now they are {', '.join(task.design_space.names)}"
        )
    held = zip(theirs.parameters, origin.in_force.phi.tolist(), strict=True)
    return _edited(task.design_space, [msgspec.structs.replace(p, initial=value) for p, value in held])


def _task_of(wish: StartRun, origin: Origin | None) -> Task:
    if origin is None:
        if wish.task is None:
            raise ValueError("a task is missing, or a run to branch from")
        return make_task(wish.task, wish.task_options)
    record = origin.record
    if wish.parent:
        raise ValueError("a branch has the run that it branches from as its parent: leave out parent")
    if wish.task not in (None, record.task):
        raise ValueError(f"{origin.run} is a run of the task {record.task}: a branch of it can't be one of {wish.task}")
    task, asked = make_task(record.task, record.task_options), make_task(record.task, wish.task_options)
    if any(getattr(task, option) != getattr(asked, option) for option in wish.task_options):
        raise ValueError(
            f"a branch keeps the options of its parent's task, which are {record.task_options or 'default'}"
        )
    return task


def _method_of(wish: StartRun, origin: Origin | None, task: Task) -> Method:
    if origin is None or wish.preset is not None or wish.method not in (None, origin.record.method):
        return make_method(wish.method, task, wish.settings, wish.preset)
    return resettled(method_at(origin), task, wish.settings)


def _space_of(wish: StartRun, task: Task, origin: Origin | None) -> DesignSpace:
    space = space_at(origin) if origin else task.design_space
    if not wish.parameters:
        return space
    return _edited(space, wish.parameters, f" {origin.words}" if origin else "")


def _length(wish: StartRun, origin: Origin | None, begins_at: int, spent: int) -> tuple[int, int | None]:
    """Return the last iteration of a run, and its budget of environment steps."""
    budget = None if wish.env_steps is None else limits.env_steps(wish.env_steps)
    if budget is not None and budget <= spent:
        raise ValueError(f"env_steps must be above the {spent} that the branch has behind it, not {budget}")
    if wish.iterations is not None:
        return begins_at + limits.iterations(wish.iterations), budget
    if budget is not None:
        return limits.iterations_within(budget, 1), budget
    planned = origin.record if origin else None
    if planned and planned.env_steps is not None and planned.env_steps > spent:
        return planned.iterations, planned.env_steps
    if planned and planned.env_steps is None and planned.iterations > begins_at:
        return planned.iterations, None
    return begins_at + DEFAULT_ITERATIONS, None


def _edited(space: DesignSpace, parameters: Iterable[Parameter], where: str = "") -> DesignSpace:
    """Return `space` with the bounds, locks and initial values of `parameters`; the rest stays.

    `where` says in words which design the initial values are of.
    """
    for p in parameters:
        i = space.index(p.name)
        space = space.without_lock(p.name).with_bound(p.name, p.lo, p.hi)
        if p.locked_at is not None:
            space = space.with_lock(p.name, p.locked_at)
        if not space.parameters[i].lo <= p.initial <= space.parameters[i].hi:
            raise ValueError(
                f"the initial {p.name} must lie inside [{p.lo:g}, {p.hi:g}] {p.unit}, not {p.initial:g}{where}"
            )
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
