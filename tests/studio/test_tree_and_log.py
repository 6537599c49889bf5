"""The trees of runs that were branched from one another, and the log of what was done to a run."""

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from morph_core.history import History
from morph_core.protocol import Parent, SetAlpha, StateChanged
from morph_core.run_folder import EventLog, RunFolder
from studio.branches import Member, children_of, place_in_words, tree_of, trees
from studio.log import log_of

NAMES = st.sampled_from("abcdefgh")


@given(st.dictionaries(NAMES, st.none() | st.builds(Parent, NAMES, st.integers(0, 9))))
def test_every_run_stands_in_the_trees_exactly_once(parents: dict[str, Parent | None]) -> None:
    def members(one: Member) -> list[Member]:
        return [one, *(below for child in one.children for below in members(child))]

    found = [member for root in trees(parents) for member in members(root)]
    assert sorted(m.run for m in found if m.here) == sorted(parents)
    assert {m.run for m in found if not m.here} == {p.run for p in parents.values() if p and p.run not in parents}
    for member in found:
        assert all(child.parent and child.parent.run == member.run for child in member.children)


def test_a_tree_grows_from_the_oldest_ancestor_with_children_where_they_begin() -> None:
    parents = {
        "late": Parent("root", 9, 8), "early": Parent("root", 2, 2), "below": Parent("late", 9), "alone": None,
        "root": None, "orphan": Parent("gone", 3, 3),
    }  # fmt: skip
    root = tree_of("below", parents)
    assert root
    assert (root.run, [child.run for child in root.children]) == ("root", ["early", "late"])
    assert tree_of("alone", parents) is None
    lost = tree_of("orphan", parents)
    assert lost
    assert (lost.run, lost.here, place_in_words(lost)) == ("gone", False, "not in this folder")
    assert [place_in_words(child) for child in root.children] == ["from iteration 2", "from iteration 8, asked for 9"]
    assert place_in_words(root.children[1].children[0]) == "the design of iteration 9"
    assert children_of("root", parents) == ["early", "late"]


def test_runs_that_name_each_other_as_parents_stand_as_roots() -> None:
    loop: dict[str, Parent | None] = {"a": Parent("b", 1), "b": Parent("a", 1), "c": Parent("a", 2)}
    assert [(root.run, [child.run for child in root.children]) for root in trees(loop)] == [("a", ["c"]), ("b", [])]


# --- the log ----------------------------------------------------------------------------------------------------------


def test_the_log_says_what_was_done_by_whom_and_what_became_of_it(trained: RunFolder) -> None:
    entries = log_of(History(trained))
    assert [entry.words for entry in entries] == [
        "trainer started: from the initial design",
        "α set to 2.5, in force from iteration 1",
        "link_5 locked at 2.75 m, in force from iteration 1",
        "refused: link_1 must lie inside [0.05, 5] m, not 9 (design set to link_1 9 m, link_2 9 m, link_3 9 m, "
        "link_4 9 m, link_5 9 m)",
        "finished: all 4 iterations are done",
    ]
    assert [entry.sender for entry in entries] == ["", "a test", "", "", ""]
    assert [entry.accepted for entry in entries] == [True, True, True, False, True]
    assert not any(entry.undone for entry in entries)


def test_a_command_that_a_resume_voided_is_undone(parent: RunFolder) -> None:
    history = History(parent)
    log = EventLog(parent)
    asked = next(e for e in history.events if getattr(e, "command", None) == SetAlpha(2.5))
    log.append(msgspec.structs.replace(asked, iteration=3, id=9))
    log.append(StateChanged(status="starting", iteration=2))
    log.close()
    assert [entry.iteration for entry in log_of(History(parent)) if entry.undone] == [3]
