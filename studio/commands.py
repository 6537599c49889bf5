"""Commands, checked where they enter: before anything is put into a run's inbox."""

import math

import msgspec

from morph_core.config import NotNegative, Projection, check_value
from morph_core.design import DesignSpace
from morph_core.protocol import AnyCommand, InjectDesign, Lock, SetAlpha, SetBound, SetProjection, Unlock
from morph_core.task import Task


def check_command(command: AnyCommand, space: DesignSpace, task: Task) -> AnyCommand:
    """Return the command with its fields' types made sure of; raise ValueError that says what is allowed."""
    try:
        command = msgspec.convert(msgspec.to_builtins(command), AnyCommand)
    except (msgspec.ValidationError, TypeError, OverflowError) as error:
        raise ValueError(f"this is no command: {error}") from error
    match command:
        case SetAlpha(alpha=alpha):
            check_value("alpha", NotNegative, alpha)
        case SetProjection(projection=projection):
            check_value("projection", Projection, projection)
        case SetBound(name=name, lo=lo, hi=hi):
            space.with_bound(name, lo, hi)
        case Lock(name=name, value=value):
            space.index(name)
            if value is not None:
                space.with_lock(name, value)
        case Unlock(name=name):
            space.index(name)
        case InjectDesign(phi=phi):
            task.check_buildable(space.check(phi))
            for p, value in zip(space.parameters, phi, strict=True):
                if p.locked_at is not None and not math.isclose(value, p.locked_at):
                    raise ValueError(f"{p.name} is locked at {p.locked_at:g} {p.unit}, not {value:g}: unlock it first")
    return command
