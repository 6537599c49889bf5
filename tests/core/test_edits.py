"""What a command does to box, locks, phi, alpha and projection."""

import contextlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from morph_core.catalogue import make_task
from morph_core.edits import AnyEdit, edited
from morph_core.history import InForce
from morph_core.protocol import InjectDesign, Lock, SetAlpha, SetBound, SetProjection, Unlock

TASKS = {name: make_task(name) for name in ("reacher", "pen_press")}


def initial(task: str) -> InForce:
    space = TASKS[task].design_space
    return InForce(space, space.initial, 1.0, "none")


def edits(task: str) -> st.SearchStrategy[AnyEdit]:
    """Return any edit of a task: of parameters that exist or not, to values inside, outside and on the edge."""
    space = TASKS[task].design_space
    names = st.sampled_from([*space.names, "link_9"])
    numbers = st.floats(float(space.lo.min()) - 1, float(space.hi.max()) + 1) | st.sampled_from([1.0, 2.0, math.nan])
    designs = st.tuples(*(st.floats(p.lo, p.hi) | st.just(p.initial) for p in space.parameters)).map(list)
    return st.one_of(
        st.builds(SetAlpha, numbers),
        st.builds(SetProjection, st.sampled_from(["none", "one_sided", "as_printed", "sideways"])),
        st.builds(SetBound, names, numbers, numbers),
        st.builds(Lock, names, st.none() | numbers),
        st.builds(Unlock, names),
        st.builds(InjectDesign, designs | st.lists(numbers, max_size=10)),
    )


@pytest.mark.parametrize("task", list(TASKS))
@given(data=st.data())
def test_after_any_commands_phi_lies_in_its_box_on_its_locks_and_can_be_built(task: str, data: st.DataObject) -> None:
    in_force = initial(task)
    for command in data.draw(st.lists(edits(task), max_size=12)):
        before = (in_force.space, in_force.phi.tolist(), in_force.alpha, in_force.projection)
        after = in_force
        with contextlib.suppress(ValueError):
            after = edited(TASKS[task], in_force, command).in_force
        assert (in_force.space, in_force.phi.tolist(), in_force.alpha, in_force.projection) == before
        in_force = after
        assert in_force.space.check(in_force.phi).tolist() == in_force.space.clip(in_force.phi).tolist()
        TASKS[task].check_buildable(in_force.phi)
        assert in_force.alpha >= 0


def test_an_edit_says_what_is_in_force() -> None:
    task, before = TASKS["reacher"], initial("reacher")
    said = [
        (SetAlpha(2.5), "alpha is 2.5"),
        (SetProjection("one_sided"), "projection is one_sided"),
        (SetBound("link_1", 1.0, 2.0), "link_1 is kept inside [1, 2] m"),
        (Lock("link_2", 1.25), "link_2 is locked at 1.25 m"),
        (Lock("link_2"), "link_2 is locked at 3 m"),
        (Unlock("link_2"), "link_2 is free"),
        (InjectDesign([1.0] * 5), "going on from the given design"),
    ]
    assert [edited(task, before, command).message for command, _ in said] == [sentence for _, sentence in said]
    assert edited(task, before, SetBound("link_1", 1.0, 2.0)).in_force.phi.tolist() == [2.0, 3.0, 3.0, 3.0, 3.0]
    moved = edited(task, before, InjectDesign([1.0] * 5)).in_force
    assert edited(task, moved, Lock("link_2")).message == "link_2 is locked at 1 m"
    assert edited(task, before, Lock("link_2", 1.25)).in_force.phi.tolist() == [3.0, 1.25, 3.0, 3.0, 3.0]


def test_a_design_against_a_lock_is_refused_and_one_on_it_is_taken() -> None:
    task = TASKS["reacher"]
    locked = edited(task, initial("reacher"), Lock("link_2", 1.0)).in_force
    with pytest.raises(ValueError, match=r"^link_2 is locked at 1 m, not 2: unlock it first$"):
        edited(task, locked, InjectDesign([2.0] * 5))
    almost = edited(task, locked, InjectDesign([2.0, 1.0 + 1e-12, 2.0, 2.0, 2.0])).in_force
    assert almost.phi[1] == 1.0


def test_only_what_concerns_the_design_says_so() -> None:
    task, before = TASKS["reacher"], initial("reacher")
    design = (SetBound("link_1", 0.5, 4.0), Lock("link_1"), Unlock("link_1"), InjectDesign([3.0] * 5))
    assert all(edited(task, before, command).concerns_design for command in design)
    assert not any(edited(task, before, command).concerns_design for command in (SetAlpha(1.0), SetProjection("none")))
    assert np.array_equal(edited(task, before, SetAlpha(9.0)).in_force.phi, before.phi)
