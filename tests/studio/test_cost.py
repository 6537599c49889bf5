"""What an iteration may take is said at the start, and asked about when it is absurd."""

from pathlib import Path
from typing import Any

import pytest
from conftest import Page, stand_in
from hypothesis import given
from hypothesis import strategies as st

from morph_core.catalogue import METHODS, TASKS, make_method, make_task
from studio.cost import ABSURD, check_cost, in_words, seconds_per_iteration
from studio.new_run import StartRun, prepare_run, record_of
from studio.runs import Runs

REACHER = make_task("reacher")


@pytest.mark.parametrize("name", list(TASKS))
def test_no_method_is_absurd_as_it_was_found_to_work(name: str) -> None:
    task = make_task(name)
    for method in METHODS:
        assert 0.01 < seconds_per_iteration(task, make_method(method, task)) < ABSURD / 10


@pytest.mark.parametrize(
    "settings",
    [
        {"ppo.epochs": 1000, "trajectories": 16_384},
        {"hidden": 2048, "trajectories": 16_384, "ppo.epochs": 20},
        {"search.population": 1000, "search.generations": 1000},
        {"ppo.epochs": 1000, "ppo.minibatches": 4096},
    ],
)
def test_what_is_absurd_is_asked_about_and_leaves_nothing(tmp_path: Path, settings: dict[str, Any]) -> None:
    wish = StartRun(task="reacher", settings=settings)
    with pytest.raises(ValueError, match=r"an iteration of this run would take about \d+ (minutes|hours|days)"):
        prepare_run(tmp_path, wish)
    assert not list(tmp_path.iterdir())
    method = make_method("morph", REACHER, settings)
    check_cost(REACHER, method, agreed=True)


def test_what_an_iteration_takes_is_said_at_the_start(runs_folder: Path) -> None:
    runs = Runs(runs_folder, stand_in)
    line = runs.summary(runs.start(StartRun(task="reacher")))
    assert line.status != "starting" or "an iteration takes about" in line.reason


def test_the_form_asks_for_a_yes_where_it_is_needed_and_each_time_anew(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    form, begun = page.viewer.start, list[bool]()
    monkeypatch.setattr(form, "_on_start", lambda request, _: begun.append(bool(record_of(request))))
    form.submit(None)
    assert not form.costly.visible
    monkeypatch.setattr("studio.cost.ABSURD", 0.0)
    for tries in (1, 2):
        form.submit(None)
        assert "an iteration of this run would take" in form.notice.content
        assert form.costly.visible
        assert not form.costly.value
        form.costly.value = True
        form.submit(None)
        assert len(begun) == 1 + tries
        assert not form.costly.visible
        assert not form.notice.visible


@given(st.floats(0, 1e9))
def test_a_duration_is_said_in_words_that_are_about_right(seconds: float) -> None:
    said = in_words(seconds)
    if seconds < 1.5:
        assert said == "about a second or less"
        return
    _, number, unit = said.split()
    size = {"s": 1, "minutes": 60, "hours": 3600, "days": 86400}[unit]
    assert abs(int(number) * size - seconds) <= size / 2 + 1e-6 * seconds
