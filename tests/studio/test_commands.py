"""Commands are judged where they enter as the trainer will judge them, with the same words."""

import dataclasses
import math
import tempfile
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.catalogue import make_method, make_task
from morph_core.config import LARGEST_ALPHA, recorded
from morph_core.history import History, InForce
from morph_core.protocol import (
    FORMAT,
    AnyCommand,
    InjectDesign,
    Lock,
    Order,
    Progress,
    RunRecord,
    SetAlpha,
    SetBound,
    SetProjection,
    Unlock,
)
from morph_core.run_folder import create_run
from morph_core.state import start
from morph_core.task import Task
from morph_core.train import Trainer
from studio.commands import check_command

REACHER = make_task("reacher")
SPACE = REACHER.design_space
INITIAL = InForce(SPACE, SPACE.initial, 1.0, "none")


def refusal(command: AnyCommand, in_force: InForce = INITIAL, task: Task = REACHER) -> str | None:
    """Return why the studio refuses a command; None if it does not."""
    try:
        check_command(command, in_force, task)
    except ValueError as error:
        return str(error)
    return None


def accepted(command: AnyCommand) -> bool:
    return refusal(command) is None


# --- both doors -------------------------------------------------------------------------------------------------------


def commands(task: Task) -> st.SearchStrategy[AnyCommand]:
    space = task.design_space
    names = st.sampled_from([*space.names[:3], "link_9"])
    numbers = st.floats(float(space.lo.min()) - 1, float(space.hi.max()) + 1) | st.sampled_from([1.0, 2.0])
    designs = st.tuples(*(st.floats(p.lo, p.hi) | st.just(p.initial) for p in space.parameters)).map(list)
    return st.one_of(
        st.builds(SetAlpha, st.floats(-1, 9)),
        st.builds(SetProjection, st.sampled_from(["none", "one_sided"])),
        st.builds(SetBound, names, numbers, numbers),
        st.builds(Lock, names, st.none() | numbers),
        st.builds(Unlock, names),
        st.builds(InjectDesign, designs | st.just([1.0] * len(space)) | st.lists(numbers, max_size=9)),
    )


@pytest.mark.parametrize("name", ["reacher", "pen_press"])
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_studio_and_trainer_agree_on_any_sequence_of_commands(name: str, data: st.DataObject) -> None:
    task = make_task(name)
    method = make_method("morph", task, {"hidden": 4})
    record = RunRecord(
        id="run", task=name, method="morph", seed=0, iterations=9, format=FORMAT, config=recorded(method),
        parameters=list(task.design_space.parameters), versions={}, created=time.time(),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as runs:
        folder = create_run(Path(runs), record)
        trainer, history, state = Trainer(folder), History(folder), start(task, method, 0)
        trainer._checkpoint = lambda _: None  # tests/core/test_train.py sees to it
        for number, step in enumerate(data.draw(st.lists(commands(task) | st.just("iterate"), max_size=10)), 1):
            if isinstance(step, str):
                state.iteration += 1
                trainer._write(
                    Progress(
                        iteration=state.iteration, env_steps=1, phi=state.phi.tolist(), episode_return=0, success=0,
                        policy_std=0.5, alpha=state.alpha, projection=state.projection,
                    )
                )  # fmt: skip
                history.poll()
                continue
            refused = refusal(step, history.in_force, task)
            trainer._answer(Order(number, step), state)
            history.poll()
            answer = history.acknowledged[-1]
            assert answer.accepted is (refused is None)
            assert refused in (None, answer.message)
            seen = history.in_force
            assert (seen.space, seen.phi.tolist()) == (state.design_space, state.phi.tolist())
            assert (seen.alpha, seen.projection) == (state.alpha, state.projection)


# --- the studio's door ------------------------------------------------------------------------------------------------

numbers = st.floats() | st.sampled_from([0.05, 5.0, 1e6, 1e39, 1e308, -1e308, -0.0])


@given(st.sampled_from(SPACE.names), numbers, numbers)
def test_a_bound_is_accepted_exactly_when_it_lies_in_the_hard_box(name: str, lo: float, hi: float) -> None:
    assert accepted(SetBound(name, lo, hi)) == (0.05 <= lo < hi <= 5.0)


@given(st.sampled_from(SPACE.names), numbers)
def test_a_lock_is_accepted_exactly_inside_the_bounds(name: str, value: float) -> None:
    assert accepted(Lock(name, value)) == (0.05 <= value <= 5.0)


@given(st.lists(numbers, max_size=7))
def test_a_design_is_accepted_exactly_inside_the_bounds(phi: list[float]) -> None:
    assert accepted(InjectDesign(phi)) == (len(phi) == 5 and all(0.05 <= value <= 5.0 for value in phi))


@given(numbers)
def test_alpha_is_accepted_exactly_in_its_range(alpha: float) -> None:
    assert accepted(SetAlpha(alpha)) == (0 <= alpha <= LARGEST_ALPHA)


@pytest.mark.parametrize(
    "command",
    [
        SetProjection("sideways"), SetAlpha("1"), SetAlpha(None), SetBound("link_9", 1, 2), SetBound(1, 1, 2),  # pyright: ignore
        Lock("link_9"), Unlock(""), InjectDesign("12345"), InjectDesign([[1]] * 5), Lock("link_1", True),  # pyright: ignore
    ],
)  # fmt: skip
def test_fields_of_the_wrong_kind_are_refused(command: AnyCommand) -> None:
    assert not accepted(command)


def test_a_locked_parameter_keeps_its_value_in_an_injected_design() -> None:
    locked = dataclasses.replace(INITIAL, space=SPACE.with_lock("link_2", 1.0))
    assert refusal(InjectDesign([1.0] * 5), locked) is None
    assert refusal(InjectDesign([2.0] * 5), locked) == "link_2 is locked at 1 m, not 2: unlock it first"


def test_a_design_whose_fingers_stand_in_each_other_is_refused_with_the_reason() -> None:
    hand = make_task("pen_press")
    in_force = InForce(hand.design_space, hand.design_space.initial, 1.0, "none")
    said = refusal(InjectDesign([math.pi / 2, *[0.0] * 3, *[0.2] * 4]), in_force, hand)
    assert said is not None
    assert "fingers 1 and 2 stand 0 mm apart" in said
