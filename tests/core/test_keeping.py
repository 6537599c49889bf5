"""Of the checkpoints of a long run, few are kept: the newest, the best, those that were chosen, and every n-th."""

import itertools
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morph_core.history import History
from morph_core.keeping import MOST, PINS, dropped, pin, tidy
from morph_core.run_folder import MARKS, RunFolder
from morph_core.train import Trainer
from tests.core.conftest import make_run, small_method


def kept_after(iterations: int, interval: int, chosen: set[int]) -> list[int]:
    """Return what is left of the checkpoints of a run of so many iterations, one saved after another."""
    saved: list[int] = []
    for iteration in range(interval, iterations + 1, interval):
        saved.append(iteration)
        gone = set(dropped(saved, interval, chosen))
        saved = [i for i in saved if i not in gone]
    return saved


@given(st.integers(1, 20_000), st.integers(1, 50), st.sets(st.integers(1, 20_000), max_size=5))
def test_few_are_kept_spread_over_the_whole_run_and_all_that_were_chosen(
    iterations: int, interval: int, chosen: set[int]
) -> None:
    kept = kept_after(iterations, interval, chosen)
    everything = range(interval, iterations + 1, interval)
    assert len(kept) <= MOST + 3 + len(chosen)
    assert set(kept) >= {*everything[:1], *everything[-2:], *(chosen & set(everything))}
    if len(everything) <= MOST:
        assert kept == list(everything)
    gaps = [later - earlier for earlier, later in itertools.pairwise(kept)]
    assert max(gaps, default=0) <= max(interval, 4 * interval * len(everything) / MOST + interval)


def test_a_run_of_5000_iterations_of_a_hand_keeps_as_much_as_fits_into_300_megabytes() -> None:
    of_a_checkpoint, of_an_episode, of_an_event = 984e3, 60e3, 800.0  # bytes, as a run of pen_press has them
    kept = len(kept_after(5000, 5, set()))
    assert kept * of_a_checkpoint + 1000 * of_an_episode + 6000 * of_an_event < 200e6


def saved(folder: RunFolder, iterations: range) -> None:
    for iteration in iterations:
        folder.checkpoint(iteration).mkdir(parents=True, exist_ok=True)
        (folder.checkpoint(iteration) / "state.json").write_text("{}")


def test_starred_branched_and_best_ones_stay_or_the_nearest_before(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    saved(folder, range(2, 2 * MOST + 40, 2))
    (folder.path / MARKS).write_text('{"starred_designs": [33, 7]}')
    pin(folder, 14)
    tidy(folder, 2, best=22)
    left = folder.checkpoint_iterations()
    assert {2, 6, 14, 22, 32} <= set(left)
    assert len(left) < MOST
    assert not [path for path in folder.checkpoints.iterdir() if path.name.startswith(".")]
    with_nearest = folder.checkpoint_up_to(31)
    assert with_nearest == max(i for i in left if i <= 31)


@pytest.mark.parametrize("marks", ["", "{", '{"starred_designs": "all"}', '{"starred_designs": [1e400]}'])
def test_nothing_is_removed_while_it_can_not_be_read_what_is_starred(tmp_path: Path, marks: str) -> None:
    folder = make_run(tmp_path)
    saved(folder, range(2, 2 * MOST + 4, 2))
    (folder.path / MARKS).write_text(marks)
    tidy(folder, 2, best=None)
    assert len(folder.checkpoint_iterations()) == MOST + 1
    (folder.path / MARKS).unlink()
    (folder.path / PINS).write_text("a file in place of the folder")
    tidy(folder, 2, best=None)
    assert len(folder.checkpoint_iterations()) == MOST + 1
    (folder.path / PINS).unlink()
    tidy(folder, 2, best=None)
    assert len(folder.checkpoint_iterations()) < MOST


def test_a_trainer_keeps_what_the_rule_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("morph_core.keeping.MOST", 4)
    folder = make_run(tmp_path, method=small_method("no_hw_opt"), iterations=20)
    Trainer(folder).run()
    left = folder.checkpoint_iterations()
    assert left[0] == 2
    assert left[-2:] == [18, 20]
    assert len(left) < 9
    best = History(folder).best
    assert best is not None
    assert best.iteration in left
