"""A run can't be bricked: what the next iteration fails with is taken back, and what was checkpointed is resumed."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from morph_core import train
from morph_core.history import History
from morph_core.morph import morph
from morph_core.protocol import (
    Acknowledged,
    AnyCommand,
    InjectDesign,
    Lock,
    Order,
    Pause,
    Progress,
    SetAlpha,
    SetBound,
    SetProjection,
)
from morph_core.run_folder import EventLog, RunFolder
from morph_core.train import Trainer
from tests.core.conftest import make_run, rewrite

EDITS = (
    SetAlpha(5.0), SetProjection("one_sided"), SetBound("link_2", 1.0, 2.0), Lock("link_1", 2.0),
    InjectDesign([2.0] * 5),
)  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_run(tmp_path, iterations=4)


def run(folder: RunFolder) -> int:
    """Train in this process; the signals that a trainer heeds are then as they were."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        return train.train(folder)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def fail_when_edited(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    """Let an iteration fail with which anything is in force that the run did not begin with."""

    def iterations(task, method, state) -> Iterator[Progress]:
        usual = (state.design_space, state.alpha, state.projection)
        for progress in morph(task, method, state):
            yield progress
            moved = state.phi.tolist() == [2.0] * 5
            if (state.design_space, state.alpha, state.projection) != usual or moved:
                raise error

    monkeypatch.setattr("morph_core.methods.proxy.morph", iterations)


@pytest.mark.parametrize("edit", EDITS, ids=lambda edit: type(edit).__name__)
def test_what_the_next_iteration_fails_with_is_taken_back(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, edit: AnyCommand
) -> None:
    fail_when_edited(monkeypatch, TypeError("unsupported operand: 'NoneType' and 'float'"))
    at_two(monkeypatch, edit)
    before = History(folder).at(0)
    assert run(folder) == 1
    history = History(folder)
    assert history.status == "failed"
    assert "taken back is what was asked for before it" in history.message
    assert history.iteration == 2
    in_force = history.in_force
    assert (in_force.space, in_force.alpha, in_force.projection) == (before.space, before.alpha, before.projection)
    assert in_force.phi.tolist() == history.progress[-1].phi
    assert run(folder) == 0
    history = History(folder)
    assert history.status == "finished"
    learnt_with = [(p.alpha, p.projection) for p in history.progress]
    assert learnt_with == 4 * [(before.alpha, before.projection)], "the checkpoint, too, holds what was before"


def at_two(monkeypatch: pytest.MonkeyPatch, edit: AnyCommand) -> None:
    """Let a trainer obey an edit after its second iteration."""
    obey = Trainer._obey

    def at_the_second(self: Trainer, state) -> None:
        if state.iteration == 2 and 7 not in self._answered:
            self._answer(Order(7, edit), state)
        obey(self, state)

    monkeypatch.setattr(Trainer, "_obey", at_the_second)


@pytest.mark.parametrize("error", [MemoryError(), OSError(28, "No space left on device")])
def test_what_is_not_the_fault_of_an_edit_takes_none_back(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    fail_when_edited(monkeypatch, error)
    at_two(monkeypatch, SetAlpha(5.0))
    assert run(folder) == 1
    assert History(folder).in_force.alpha == 5.0


def test_a_later_failure_takes_no_edit_back_and_says_which_were_the_last(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(task, method, state) -> Iterator[Progress]:
        yield from (progress for progress, _ in zip(morph(task, method, state), range(3), strict=False))
        raise TypeError("of its own")

    monkeypatch.setattr("morph_core.methods.proxy.morph", broken)
    at_two(monkeypatch, SetAlpha(5.0))
    assert run(folder) == 1
    history = History(folder)
    assert history.message.startswith("TypeError: of its own; in force since iteration 2 is what was asked for then")
    assert history.in_force.alpha == 5.0
    folder.send(SetAlpha(2.0))
    monkeypatch.undo()
    assert run(folder) == 0
    history = History(folder)
    assert [e.iteration for e in history.commands() if e.command == SetAlpha(2.0)] == [2]
    assert [p.alpha for p in history.progress] == [1.0, 1.0, 2.0, 2.0]


def test_where_nobody_has_asked_for_anything_no_command_is_named(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_when_edited(monkeypatch, TypeError("of its own"))
    monkeypatch.setattr(Trainer, "_take_in", lambda *_: (_ for _ in ()).throw(TypeError("of its own")))
    assert run(folder) == 1
    assert History(folder).message == "TypeError: of its own"


@pytest.mark.parametrize("alpha", [1e39, 1e308, -1.0])
def test_a_run_that_an_older_version_has_bricked_goes_on(folder: RunFolder, alpha: float) -> None:
    Trainer(folder, until=2).run()
    rewrite(folder.checkpoint(2), alpha=alpha)
    log = EventLog(folder)
    log.append(Acknowledged(id=1, iteration=2, accepted=True, command=SetAlpha(alpha)))
    log.close()
    assert History(folder).in_force.alpha == alpha
    assert run(folder) == 0
    history = History(folder)
    assert history.status == "finished"
    assert history.in_force.alpha == 1.0
    said = history.acknowledged[-1]
    assert said.sender == "trainer"
    assert said.message.startswith("taken back, it is 1 again: alpha must lie in [0, 1000000]")


def test_a_command_that_is_no_edit_is_never_taken_back(folder: RunFolder) -> None:
    Trainer(folder, until=2).run()
    log = EventLog(folder)
    log.append(Acknowledged(id=1, iteration=2, accepted=True, command=Pause()))
    log.close()
    trainer = Trainer(folder)
    assert trainer.take_back(TypeError("x")) == ""
