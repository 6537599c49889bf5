"""The A/B panel: a second design beside or over the one on screen, the table of differences, and what it can't show."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import NAME, Page, eventually, make_hand_run, make_run

from morph_core.history import History
from morph_core.protocol import Status
from morph_core.run_folder import RunFolder
from studio.compare import compare
from studio.viewer.compare import View
from studio.viewer.comparison import comparison_table
from studio.viewer.take import Take

OTHER = "20260102-000000-reacher-direct-s1"
HAND = "20260103-000000-hand-direct-s0"


@pytest.fixture
def histories(tmp_path: Path) -> dict[str, History]:
    runs = tmp_path / "runs"
    reachers = [make_run(runs, name, "finished") for name in (NAME, OTHER)]
    folders = [*reachers, make_hand_run(runs, "pen_press", HAND)]
    return {folder.id: History(folder) for folder in folders}


@pytest.fixture
def show(page: Page, histories: dict[str, History]) -> Callable[[], None]:
    page.others.histories |= histories
    statuses: dict[str, tuple[Status, str]] = {name: (history.status, "") for name, history in histories.items()}
    return lambda: page.viewer.show(histories, statuses, NAME)


def second(page: Page, wanted: Callable[[Take], bool] = lambda _: True) -> Take:
    return page.take(lambda take: take.second is not None and wanted(take))


def show_b(page: Page, view: View, run: str) -> None:
    """Show a run beside the one on screen, as a person does."""
    panel = page.viewer.compare
    panel.view.value = view
    panel._set_view(None)
    panel.run.value = run
    panel._choose_run(None)


def test_nothing_is_compared_until_somebody_asks(page: Page, show: Callable[[], None]) -> None:
    show()
    panel = page.viewer.compare
    assert (panel.view.value, panel.run.visible, panel.table.visible) == ("off", False, False)
    assert page.take(lambda take: take.shot.episode is not None).second is None
    assert "Choose a second one" in panel.introduction.content


def test_the_initial_design_stands_beside_the_one_on_screen(page: Page, show: Callable[[], None]) -> None:
    show()
    panel = page.viewer.compare
    panel.view.value = "side by side"
    panel._on_choice()
    take = second(page)
    assert take.shot.second is not None
    assert take.shot.second.phi == (3.0,) * 5
    assert take.second is not None
    assert take.second.scenery is not None
    names = eventually(lambda: [n for n in page.viewer.player.node_names if n.startswith("/second_robot/")])
    assert names
    assert "B, iteration 0: in its start posture: no episode was recorded" in panel.note.content
    assert "the nearest one is of iteration 3" in panel.note.content
    panel.view.value = "off"
    panel._on_choice()
    assert page.take(lambda take: take.second is None)
    assert not panel.table.visible


def test_a_pinned_design_stays_while_the_timeline_goes_on(page: Page, show: Callable[[], None]) -> None:
    show()
    panel = page.viewer.compare
    panel._pin(None)
    take = second(page)
    assert take.shot.second is not None
    assert take.shot.second.episode == take.shot.episode
    page.viewer.turn_to(1)
    take = second(page, lambda take: take.shot.phi == pytest.approx([2.9] * 5))
    assert take.shot.second is not None
    assert take.shot.second.phi == pytest.approx([2.7] * 5)
    assert panel.iteration.value == 3


def test_another_run_lies_over_the_first_and_differs_as_the_table_says(
    page: Page, show: Callable[[], None], histories: dict[str, History]
) -> None:
    show()
    panel = page.viewer.compare
    show_b(page, "overlaid", OTHER)
    panel.iteration.value = 2
    panel._choose_iteration(None)
    take = second(page, lambda take: take.shot.second is not None and take.shot.second.phi == pytest.approx([2.8] * 5))
    assert take.second is not None
    assert take.second.scenery is None
    found = compare(histories[NAME], "3", histories[OTHER], "2")
    assert panel.table.content == comparison_table(found, histories[NAME], ("own colours", "tinted"), (150, 60, 220))
    for words in ("2.70 m", "2.80 m", "+0.10 m", "50 %", "unknown", f"iteration 2 of {OTHER} was not evaluated"):
        assert words in panel.table.content
    assert eventually(lambda: "B, tinted" in page.viewer.timeline.legend.content)


def test_every_run_of_the_task_is_offered_by_what_people_call_it_and_read_when_it_is_chosen(
    page: Page, show: Callable[[], None], histories: dict[str, History]
) -> None:
    show()
    old = histories.pop(OTHER)  # too old for browsers to be told of it
    page.others.names[OTHER] = "the good one"
    show()
    panel = page.viewer.compare
    assert panel.second_run is None
    show_b(page, "side by side", f"the good one · {OTHER}")
    assert panel.run.options == (NAME, f"the good one · {OTHER}")
    assert second(page).shot.second is not None
    assert (panel._second, panel.second_run) == (old, OTHER)
    assert page.viewer.runs_on_screen == {NAME, OTHER}  # so that it is followed from now on


def test_a_second_design_without_an_episode_has_one_run(
    page: Page, show: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RunFolder, "checkpoint_up_to", lambda _, iteration: iteration - 1)
    show()
    show_b(page, "side by side", OTHER)
    panel = page.viewer.compare
    panel.iteration.value = 2
    panel._choose_iteration(None)
    assert eventually(lambda: "B, iteration 2: playing an episode that was run just now" in panel.note.content)
    assert "the policy is that of iteration 1" in panel.note.content
    take = second(page, lambda take: take.shot.second is not None and take.shot.second.played is not None)
    assert take.second is not None
    assert take.second.frames > 1


def test_designs_of_different_tasks_are_refused_in_a_sentence(page: Page, show: Callable[[], None]) -> None:
    show()
    panel = page.viewer.compare
    panel._pin(None)
    second(page)
    assert HAND not in panel.run.options
    page.viewer.open(HAND)
    assert panel.run.value == NAME
    assert "designs of different tasks can&#x27;t be compared" in panel.note.content
    assert page.take(lambda take: take.second is None)
    assert not panel.table.visible


def test_a_run_that_was_deleted_is_said_to_be_gone(
    page: Page, show: Callable[[], None], histories: dict[str, History]
) -> None:
    show()
    panel = page.viewer.compare
    show_b(page, "side by side", OTHER)
    second(page)
    shutil.rmtree(histories.pop(OTHER).folder.path)
    show()
    assert f"{OTHER} is gone: it was deleted or moved" in panel.note.content
    assert page.take(lambda take: take.second is None)


def test_other_options_stand_beside_each_other(page: Page, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    first, other = make_run(runs, NAME, "finished"), make_run(runs, OTHER, "finished")
    record = (other.path / "run.json").read_text()
    (other.path / "run.json").write_text(record.replace('"task_options": {}', '"task_options": {"tunnel": "paper"}'))
    histories = page.others.histories = {folder.id: History(folder) for folder in (first, other)}
    assert histories[OTHER].record.task_options == {"tunnel": "paper"}
    statuses: dict[str, tuple[Status, str]] = {name: ("finished", "") for name in histories}
    page.viewer.show(histories, statuses, NAME)
    panel = page.viewer.compare
    show_b(page, "overlaid", OTHER)
    take = second(page, lambda take: take.shot.second is not None and bool(take.shot.second.task_options))
    assert take.second is not None
    assert take.second.scenery is not None
    assert len(take.second.scenery) != len(take.scenery)
    assert "so they stand side by side" in panel.note.content


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [("view", "upside down", "choose from: off"), ("run", "nobody", "unknown run"), ("iteration", 77, "choose 0 to 3")],
)
def test_what_no_browser_offers_is_refused(
    page: Page, show: Callable[[], None], name: str, value: str | int, sentence: str
) -> None:
    show()
    panel = page.viewer.compare
    panel.view.value = "side by side"
    panel._on_choice()
    second(page)
    setattr(getattr(panel, name), "value", value)  # noqa: B010
    {"view": panel._set_view, "run": panel._choose_run, "iteration": panel._choose_iteration}[name](None)
    assert sentence in page.viewer.notice.content
    assert (panel.run.value, panel.iteration.value <= 3) == (NAME, True)


def test_the_start_page_has_nothing_to_compare(page: Page, show: Callable[[], None]) -> None:
    show()
    page.viewer.select(None)
    panel = page.viewer.compare
    assert not panel.view.visible
    assert "no design to compare with" in panel.note.content


def test_masses_and_angles_have_their_units(histories: dict[str, History]) -> None:
    hand = histories[HAND]
    table = comparison_table(compare(hand, "0", hand, "1"), hand, ("", ""), None)
    assert "°" in table
    assert "cm" in table
    assert f"{100 * (hand.phi - hand.initial_phi)[len(hand.phi) // 2]:+.1f} cm" in table
    assert " g</td>" in table or " kg</td>" in table
    assert np.isfinite(compare(hand, "0", hand, "1").differences.mass or np.nan)
