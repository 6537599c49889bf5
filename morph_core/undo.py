"""Commands that a run can't go on with, taken back: what is in a checkpoint can always be resumed."""

from morph_core.checkpoint import load_checkpoint, save_checkpoint
from morph_core.config import Alpha, check_value
from morph_core.edits import AnyEdit
from morph_core.history import History, InForce
from morph_core.method import Method
from morph_core.protocol import Acknowledged, AnyEvent, DesignSpaceChanged, InjectDesign, SetAlpha, SetProjection
from morph_core.run_folder import RunFolder
from morph_core.state import State
from morph_core.task import Task

BY = "trainer"
"""Who says in a log that a command was taken back."""


def edits_since(history: History) -> list[Acknowledged]:
    """Return the edits that were obeyed after the last iteration, and with which none has been run yet."""
    last = history.iteration
    return [e for e in history.commands() if isinstance(e.command, AnyEdit) and e.iteration == last]


def earlier_edits(history: History) -> str:
    """Return in words which edits were obeyed last by a run that has failed, and how they are changed; nothing where
    nobody has asked for any."""
    edits = [e for e in history.commands() if isinstance(e.command, AnyEdit) and e.sender != BY]
    if not edits:
        return ""
    at = edits[-1].iteration
    asked = ", ".join(e.message for e in edits if e.iteration == at)
    before = f": morph-studio train --branch {history.folder.id}@{at - 1}" if at > history.begins_at else ""
    return (
        f"; in force since iteration {at} is what was asked for then ({asked}): where that is why, ask for something "
        f"else, which is obeyed when the run is resumed, or branch from before{before}"
    )


def take_back(folder: RunFolder, task: Task, method: Method) -> list[AnyEvent]:
    """Put what was in force before the edits since the last iteration into its checkpoint.

    Return what is to be said of it, which is nothing where no edit changes anything.
    """
    history = History(folder)
    if not edits_since(history):
        return []
    before = _before_edits(history)
    state, cpu_seconds = load_checkpoint(folder, history.iteration, task, method)
    said = _differences(state, before)
    if said:
        state.fitted = state.fitted and state.phi.tolist() == before.phi.tolist()
        state.design_space, state.phi = before.space, before.phi
        state.alpha, state.projection = before.alpha, before.projection
        save_checkpoint(folder, state, cpu_seconds)
    return said


def unruly_alpha(history: History, state: State) -> list[AnyEvent]:
    """Return what is to be said where the alpha that a version without an upper bound accepted was left out of a
    checkpoint as it was loaded; nothing anywhere else."""
    accepted = history.in_force.alpha
    try:
        check_value("alpha", Alpha, accepted)
    except ValueError as error:
        why = f"taken back, it is {state.alpha:g} again: {error}"
        return [_said(state.iteration, SetAlpha(state.alpha), why)]
    return []


def _before_edits(history: History) -> InForce:
    """Return what was in force when the last iteration had ended."""
    then = history.at(history.iteration)
    phi = history.phi
    return InForce(then.space, then.space.clip(phi), then.alpha, then.projection)


def _differences(state: State, before: InForce) -> list[AnyEvent]:
    at, why = state.iteration, "taken back: the next iteration failed with what was asked for"
    said: list[AnyEvent] = []
    if state.design_space != before.space:
        said.append(DesignSpaceChanged(iteration=at, parameters=list(before.space.parameters)))
    if state.phi.tolist() != before.phi.tolist():
        said.append(_said(at, InjectDesign(before.phi.tolist()), why))
    if state.alpha != before.alpha:
        said.append(_said(at, SetAlpha(before.alpha), why))
    if state.projection != before.projection:
        said.append(_said(at, SetProjection(before.projection), why))
    return said


def _said(iteration: int, command: AnyEdit, why: str) -> Acknowledged:
    return Acknowledged(id=0, iteration=iteration, accepted=True, command=command, message=why, sender=BY)
