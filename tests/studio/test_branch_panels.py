"""Branches in the viewer: the button and the form, trees and logs on screen, and a run with bounds of its own."""

import shutil

import msgspec
import pytest
from conftest import Page, design_of

from morph_core.history import History
from morph_core.protocol import Parent
from morph_core.run_folder import RunFolder
from morph_core.train import Trainer
from studio.branches import Member
from studio.new_run import Branch, StartRun, prepare_run


def test_the_button_branches_where_the_timeline_stands(page: Page, trained: RunFolder) -> None:
    page.show(trained)
    viewer = page.viewer
    assert viewer.run.branch.label == "Branch from here (iteration 4)"
    viewer.timeline.follow.value, viewer.timeline.iteration.value = False, 3
    page.show(trained)
    assert viewer.run.branch.label == "Branch from here (iteration 3)"
    viewer.beginning.open_branch(None)
    form = viewer.start
    assert form.folder.visible
    assert f"branches at iteration 2 of {trained.id}, the nearest checkpoint up to iteration 3" in form.source.content
    assert (form.task.disabled, form.task.value, form.method.value, form.seed.value) == (True, "reacher", "morph", 5)
    assert (form.iterations.value, form.settings.alpha.value) == (2, 2.5)
    assert not form.options["reacher"]["tunnel"].visible
    assert form.preview
    assert list(form.preview.phi) == History(trained).progress[1].phi
    form.submit(None)
    assert page.started == [
        StartRun(
            task="reacher", method="morph", seed=5, iterations=2, task_options={"tunnel": "paper"},
            branch=Branch(trained.id, 3),
        )
    ]  # fmt: skip
    assert not form.source.visible


def test_the_form_of_a_branch_asks_for_what_is_changed(page: Page, trained: RunFolder) -> None:
    page.show(trained)
    page.viewer.beginning.open_branch(None)
    form = page.viewer.start
    form.settings.alpha.value = 0.5
    assert form._bounds
    assert form._bounds.rows["link_5"].locked.value
    form._bounds.rows["link_5"].locked.value = False
    form._bounds.rows["link_1"].bounds.value = (0.5, 4.0)
    form.submit(None)
    (wish,) = page.started
    assert wish.settings == {"alpha": 0.5}
    assert [(p.name, p.lo, p.hi, p.locked_at) for p in wish.parameters or []] == [
        ("link_1", 0.5, 4.0, None), ("link_5", 0.05, 5.0, None)
    ]  # fmt: skip
    page.viewer.select(trained.id)
    page.viewer.beginning.open_branch(None)
    form.method.value = "direct"
    assert "another method counts from 0" in form.source.content
    form.submit(None)
    assert (page.started[-1].method, page.started[-1].settings) == ("direct", {})


def test_a_new_run_can_be_started_with_bounds_of_its_own(page: Page) -> None:
    form = page.viewer.start
    assert form._bounds
    form._bounds.rows["link_1"].bounds.value = (0.5, 4.0)
    form.submit(None)
    assert [(p.name, p.lo, p.hi) for p in page.started[0].parameters or []] == [("link_1", 0.5, 4.0)]


def test_bounds_and_a_design_to_start_from_go_together(page: Page, trained: RunFolder) -> None:
    form = page.viewer.start
    form.take(msgspec.json.encode(design_of(History(trained), [2.0] * 5)))
    assert form._bounds
    form._bounds.rows["link_1"].bounds.value = (0.5, 4.0)
    form.submit(None)
    assert [(p.lo, p.hi, p.initial) for p in page.started[0].parameters or []][:2] == [
        (0.5, 4.0, 2.0), (0.05, 5.0, 2.0)
    ]  # fmt: skip
    assert page.started[0].parent == Parent(trained.id, 1)


@pytest.mark.parametrize("way", ["opened", "button"])
def test_a_branch_is_forgotten_for_a_new_run(page: Page, trained: RunFolder, way: str) -> None:
    page.show(trained)
    page.viewer.beginning.open_branch(None)
    if way == "button":
        page.viewer.start._forget()
    else:
        page.viewer.open(None)
    form = page.viewer.start
    assert (form.source.visible, form.task.disabled, form.options["reacher"]["tunnel"].visible) == (False, False, True)
    form.submit(None)
    assert page.started[0].branch is None


def test_what_can_not_be_branched_from_is_said(page: Page, parent: RunFolder) -> None:
    shutil.rmtree(parent.checkpoint(2))
    (parent.checkpoint(4) / "state.json").write_text("{")
    page.show(parent)
    page.viewer.beginning.open_branch(None)
    assert f"checkpoint 4 of {parent.id} can" in page.viewer.notice.content
    assert page.viewer.selected == parent.id


def test_tree_and_log_are_shown_in_their_tab(page: Page, trained: RunFolder) -> None:
    page.show(trained)
    panel = page.viewer.log
    assert "No run was branched from this one yet" in panel.tree.content
    assert not panel._links.list.visible
    assert "α set to 2.5, in force from iteration 1" in panel.log.content
    assert "a test" in panel.log.content
    assert panel.log.content.index("finished") < panel.log.content.index("trainer started")
    child = Member("child<b>", Parent(trained.id, 3, 2))
    page.family = Member(trained.id, children=[child, Member("gone", Parent(trained.id, 4), here=False)])
    page.viewer.log._found = (None, None)
    page.show(trained)
    assert "child&lt;b&gt;" in panel.tree.content
    assert "from iteration 2, asked for 3" in panel.tree.content
    (button,) = [button for button in panel._links._buttons if button.visible]
    assert button.label == "child<b>"
    assert f'<label for="{button._impl.uuid}" title="open child&lt;b&gt;"' in panel.tree.content
    panel._open(1)
    assert page.viewer.selected == trained.id
    panel._open(0)
    assert page.viewer.selected == "child<b>"


def test_a_branch_begins_on_the_timeline_where_its_parent_was(page: Page, parent: RunFolder) -> None:
    folder = prepare_run(parent.path.parent, StartRun(branch=Branch(parent.id, 2), iterations=2))
    Trainer(folder).run()
    page.show(folder)
    timeline = page.viewer.timeline
    assert (timeline.iteration.min, timeline.iteration.max, timeline.iteration.value) == (2, 4, 4)
    timeline.follow.value, timeline.iteration.value = False, 1
    timeline._pick(None)
    assert "choose 2 to 4" in page.viewer.notice.content
    assert timeline.iteration.value == 2
    page.show(folder)
    assert "initial design" in timeline.what.content
