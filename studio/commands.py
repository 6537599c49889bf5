"""Commands, checked where they enter: before anything is put into a run's inbox."""

import msgspec

from morph_core.edits import AnyEdit, edited
from morph_core.history import InForce
from morph_core.protocol import AnyCommand
from morph_core.task import Task


def check_command(command: AnyCommand, in_force: InForce, task: Task) -> AnyCommand:
    """Return the command with its fields' types made sure of; raise ValueError that says what is allowed."""
    try:
        command = msgspec.convert(msgspec.to_builtins(command), AnyCommand)
    except (msgspec.ValidationError, TypeError, OverflowError) as error:
        raise ValueError(f"this is no command: {error}") from error
    if isinstance(command, AnyEdit):
        edited(task, in_force, command)
    return command
