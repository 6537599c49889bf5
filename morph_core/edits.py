"""What a command does to a run: the one judge of box, locks, phi, alpha and projection, for studio and trainer."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from morph_core.config import Alpha, Projection, check_value
from morph_core.design import DesignSpace
from morph_core.history import InForce
from morph_core.protocol import InjectDesign, Lock, SetAlpha, SetBound, SetProjection, Status, Unlock
from morph_core.task import Task

AnyEdit = SetAlpha | SetProjection | SetBound | Lock | Unlock | InjectDesign
"""The commands that change what is in force; all others only steer the trainer."""
TAKES_LATER_EDITS: tuple[Status, ...] = ("failed", "lost")
"""States of a run without a trainer that takes edits all the same: they are obeyed before it goes on."""


@dataclass(frozen=True)
class Edit:
    """A command that is allowed, with what it does."""

    in_force: InForce
    """Bounds, locks, phi, alpha and projection that are in force after the command."""
    message: str
    """Sentence that says what the command does."""
    concerns_design: bool
    """Whether box, locks or phi were set, even to what they were: then the search for phi goes on."""


def edited(task: Task, in_force: InForce, command: AnyEdit) -> Edit:
    """Return what is in force after `command`; raise ValueError with a sentence that says what is allowed."""
    space, phi = in_force.space, in_force.phi
    match command:
        case SetAlpha(alpha=alpha):
            check_value("alpha", Alpha, alpha)
            return Edit(dataclasses.replace(in_force, alpha=float(alpha)), f"alpha is {alpha:g}", False)
        case SetProjection(projection=rule):
            check_value("projection", Projection, rule)
            return Edit(dataclasses.replace(in_force, projection=rule), f"projection is {rule}", False)
        case SetBound(name=name, lo=lo, hi=hi):
            moved = _moved(task, in_force, space.with_bound(name, lo, hi), phi)
            message = f"{name} is kept inside [{lo:g}, {hi:g}] {space.parameters[space.index(name)].unit}"
        case Lock(name=name, value=value):
            held = float(phi[space.index(name)]) if value is None else value
            moved = _moved(task, in_force, space.with_lock(name, held), phi)
            message = f"{name} is locked at {held:g} {space.parameters[space.index(name)].unit}"
        case Unlock(name=name):
            moved, message = _moved(task, in_force, space.without_lock(name), phi), f"{name} is free"
        case InjectDesign(phi=given):
            moved = _moved(task, in_force, space, _check_locks(space, space.check(given)))
            message = "going on from the given design"
    return Edit(moved, message, True)


def _moved(task: Task, in_force: InForce, space: DesignSpace, phi: np.ndarray) -> InForce:
    """Return what is in force with another box and phi; raise ValueError for a design that can't be put together."""
    inside = space.clip(phi)
    task.check_buildable(inside)
    return dataclasses.replace(in_force, space=space, phi=inside)


def _check_locks(space: DesignSpace, phi: np.ndarray) -> np.ndarray:
    for p, value in zip(space.parameters, phi, strict=True):
        if p.locked_at is not None and not math.isclose(value, p.locked_at):
            raise ValueError(f"{p.name} is locked at {p.locked_at:g} {p.unit}, not {value:g}: unlock it first")
    return phi
