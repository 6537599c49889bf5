"""The rows of a study: what is read from the run folders, and what is left out."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.protocol import Evaluation, Progress
from morph_core.run_folder import EventLog, RunFolder
from studio.study.plan import StudyError
from studio.study.report.results import CurveRow, DesignRow, RunRow, SettingRow, read_results
from studio.study.report.tables import read_tables, table_of, write_tables
from tests.studies import MADE, STEPS, Made, write_study

MORPH, DIRECT = Made("morph", "morph"), Made("direct", "direct")
INITIAL = [3.0] * 5


def by_hand(folder: Path, *events: Progress | Evaluation, made: Made = MORPH) -> RunRow:
    """Return the row of a run with these events alone."""
    study = write_study(folder, [made], [0], iterations=10, status={(made.label, 0): None})
    write_study_run(folder, study.runs[0].run, events, made)
    return read_results(folder).runs[0]


def write_study_run(folder: Path, run: str, events: tuple[Progress | Evaluation, ...], made: Made) -> None:
    other = folder.parent / "other"
    write_study(other, [made], [0], iterations=10)
    (other / run).rename(folder / run)
    (folder / run / "events.jsonl").write_text("")
    log = EventLog(RunFolder(folder / run))
    for event in events:
        log.append(event)
    log.close()


def progress(i: int, first: float = 3.0, **metrics: object) -> Progress:
    return Progress(
        iteration=i, env_steps=100 * i, phi=[first, *INITIAL[1:]], episode_return=0.0, success=0.0, policy_std=0.1,
        cpu_seconds=float(i), **metrics,
    )  # fmt: skip


def evaluation(i: int, sampled: float, mean: float = 0.0, **more: object) -> Evaluation:
    return Evaluation(
        iteration=i, env_steps=100 * i, phi=INITIAL, sampled_success=sampled, sampled_return=-1.0, cpu_seconds=float(i),
        deterministic_success=mean, deterministic_return=-2.0, **more,
    )  # fmt: skip


def test_the_cosine_counts_only_while_phi_moves(tmp_path: Path) -> None:
    row = by_hand(
        tmp_path / "study",
        progress(1, 2.0, cosine_negative=0.25, cosine=0.5),
        progress(2, 2.0, cosine_negative=1.0, cosine=-1.0),
        progress(3, 1.0, cosine_negative=0.75, cosine=-0.1),
    )
    assert row.negative_share == 0.5
    assert row.cosine == pytest.approx(0.2)


def test_the_run_is_solved_at_the_first_evaluation_at_the_level(tmp_path: Path) -> None:
    row = by_hand(
        tmp_path / "study",
        evaluation(1, 0.94),
        evaluation(2, 0.95, 0.2),
        evaluation(3, 0.5, 0.96),
        evaluation(4, 0.99, 0.99),
    )
    assert (row.sampled_solved_steps, row.sampled_solved_cpu_seconds) == (200, 2.0)
    assert (row.deterministic_solved_steps, row.deterministic_solved_cpu_seconds) == (300, 3.0)


def test_the_end_is_the_final_evaluation_whatever_comes_beside_it(tmp_path: Path) -> None:
    final = evaluation(4, 0.5, 0.25, final=True, episodes=256, milestones={"lifted": 0.75})
    row = by_hand(tmp_path / "study", evaluation(4, 1.0, 1.0, episodes=64), final, evaluation(5, 1.0, episodes=64))
    assert (row.sampled_success, row.sampled_successes, row.deterministic_successes) == (0.5, 128, 64)
    assert row.end_is_final
    assert row.milestone("lifted") == 0.75
    assert row.milestone("pressed") is None


def test_a_run_without_its_final_evaluation_ends_with_its_last_one(tmp_path: Path) -> None:
    row = by_hand(tmp_path / "study", evaluation(1, 1.0), evaluation(2, 0.25))
    assert row.sampled_success == 0.25
    assert not row.end_is_final
    assert row.sampled_successes is None  # nobody wrote down of how many


def test_first_and_last_are_means_of_five_iterations(tmp_path: Path) -> None:
    events = [progress(i, 3.0 - 0.1 * i, divergence=float(i), search_cost=10.0 * i) for i in range(1, 13)]
    row = by_hand(tmp_path / "study", *events)
    assert (row.divergence_first, row.divergence_last) == (3.0, 10.0)
    assert (row.search_cost_first, row.search_cost_last) == (30.0, 100.0)
    assert row.loss_and_cost_rank == pytest.approx(1)


def test_curves_that_fall_and_rise_have_a_negative_rank_correlation(tmp_path: Path) -> None:
    events = [progress(i, 3.0 - 0.1 * i, divergence=1.0 / i, search_cost=float(i)) for i in range(1, 13)]
    assert by_hand(tmp_path / "study", *events).loss_and_cost_rank == pytest.approx(-1)


@pytest.mark.parametrize("cost", [None, math.nan, 1.0])
def test_a_search_cost_that_says_nothing_gives_no_correlation(tmp_path: Path, cost: float | None) -> None:
    events = [progress(i, 3.0 - 0.1 * i, divergence=1.0 / i, search_cost=cost) for i in range(1, 13)]
    assert by_hand(tmp_path / "study", *events).loss_and_cost_rank is None


def test_steps_of_relabelling_and_search_are_told_apart(tmp_path: Path) -> None:
    row = by_hand(tmp_path / "study", progress(1, relabelled_steps=7, search_steps=11))
    assert (row.env_steps, row.relabelled_steps, row.search_steps) == (100, 7, 11)


def test_a_method_without_a_proxy_has_neither_cosine_nor_loss(tmp_path: Path) -> None:
    write_study(tmp_path / "study", [DIRECT], [0])
    (row,) = read_results(tmp_path / "study").runs
    assert (row.exploration, row.search, row.projection, row.alpha) == (None, None, None, None)
    assert (row.negative_share, row.divergence_first, row.search_cost_last) == (None, None, None)


def test_a_failed_seed_counts_as_not_solved_and_one_that_waits_does_not_count(tmp_path: Path) -> None:
    write_study(
        tmp_path / "study", [DIRECT], range(4),
        status={("direct", 1): "failed", ("direct", 2): "running", ("direct", 3): None},
    )  # fmt: skip
    rows = read_results(tmp_path / "study").runs
    assert [row.has_ended for row in rows] == [True, True, False, False]
    assert [row.ends_at(0.95) for row in rows] == [True, False, False, False]
    assert [row.score > 0 for row in rows] == [True, False, False, False]
    assert rows[1].reason == "disk full"
    assert rows[3].status == "not started"


def test_a_run_that_cannot_be_read_is_a_row_with_the_reason(tmp_path: Path) -> None:
    study = write_study(tmp_path / "study", [DIRECT], [0, 1])
    (tmp_path / "study" / study.runs[0].run / "run.json").write_text("{")
    rows = read_results(tmp_path / "study").runs
    assert rows[0].status == "unreadable"
    assert "run.json" in rows[0].reason
    assert rows[1].status == "finished"


def test_a_folder_without_a_study_says_so(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"no study\.json"):
        read_results(tmp_path)


def test_a_curve_has_a_row_for_each_iteration_and_the_evaluation_after_it(tmp_path: Path) -> None:
    write_study(tmp_path / "study", [MORPH], [3], iterations=10)
    rows = read_results(tmp_path / "study").curves
    assert [row.iteration for row in rows] == list(range(1, 11))
    assert [row.env_steps for row in rows] == [STEPS * i for i in range(1, 11)]
    assert [row.iteration for row in rows if row.sampled_success is not None] == [5, 10]
    assert rows[9].seed == 3


def test_phi_is_one_row_for_each_parameter_with_its_box(tmp_path: Path) -> None:
    write_study(tmp_path / "study", [MORPH], [0], tasks=["pen_press"])
    rows = read_results(tmp_path / "study").designs
    assert [row.unit for row in rows] == ["rad"] * 4 + ["m"] * 4
    assert all(row.lo <= row.final <= row.hi for row in rows)
    assert {row.initial for row in rows[4:]} == {0.12}


def test_tables_are_read_back_as_they_were_written(tmp_path: Path) -> None:
    odd = Made('π "a", b|c,\n2'.replace("\n", " "), "direct")
    write_study(tmp_path / "study", [*MADE[:2], odd], [0, 1], status={(odd.label, 1): "failed", ("paper", 0): None})
    results = read_results(tmp_path / "study")
    write_tables(results, tmp_path / "report")
    again = read_tables(tmp_path / "report")
    assert again.study == results.study
    for name in ("runs", "curves", "designs", "settings"):
        assert getattr(again, name) == getattr(results, name), name


@pytest.mark.parametrize("kind", [RunRow, CurveRow, DesignRow, SettingRow])
def test_a_table_without_rows_has_all_its_columns(kind: type) -> None:
    assert table_of(kind, []).column_names == [field.name for field in dataclasses.fields(kind)]


@settings(max_examples=10)
@given(
    st.lists(
        st.none() | st.floats(-1e100, 1e100) | st.sampled_from([np.nan, np.inf, -np.inf]), min_size=12, max_size=20
    )
)
def test_whatever_a_trainer_measured_only_finite_numbers_are_kept(
    tmp_path_factory: pytest.TempPathFactory, values: list[float | None]
) -> None:
    folder = tmp_path_factory.mktemp("any")
    events = [
        progress(i, 2.9 - 0.01 * i, divergence=value, search_cost=value, cosine=value, cosine_negative=value)
        for i, value in enumerate(values, 1)
    ]
    row = by_hand(folder / "study", *events)
    numbers = [value for value in dataclasses.asdict(row).values() if isinstance(value, float)]
    assert np.isfinite(numbers).all()
    json.dumps(dataclasses.asdict(row), allow_nan=False)
