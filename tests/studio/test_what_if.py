"""What-if questions: the process that answers them, its queue, and wishes about runs."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
import pytest
from conftest import add_checkpoint, eventually, make_run
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from morph_core.catalogue import make_task
from morph_core.evaluate import evaluate_run
from morph_core.history import History
from morph_core.run_folder import RunFolder, RunFolderError
from morph_core.what_if import mean_interval, wilson_interval
from studio import evaluator as module
from studio.cancellation import Cancellation, CancelledError
from studio.evaluator import Evaluator, EvaluatorError
from studio.what_if import POINTS, WhatIfs, Wish, phi_of, sweep_designs
from tests.forked import morph_studio

LONG = 10_000  # episodes: seconds of work


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> History:
    """A run of three iterations, with a checkpoint of the second."""
    folder = make_run(tmp_path_factory.mktemp("runs"))
    add_checkpoint(folder, 2)
    return History(folder)


@pytest.fixture(scope="module")
def evaluator() -> Iterator[Evaluator]:
    evaluator = Evaluator()
    yield evaluator
    evaluator.close()


@pytest.fixture
def what_ifs(evaluator: Evaluator) -> WhatIfs:
    return WhatIfs(evaluator)


def pid_of(evaluator: Evaluator) -> int:
    assert evaluator._process is not None
    return evaluator._process._child.pid


def at_work(evaluator: Evaluator) -> bool:
    return evaluator._at_work is not None


# --- numbers ---


@given(episodes=st.integers(1, 500), share=st.floats(0, 1))
def test_the_interval_of_a_success_is_that_of_scipy(episodes: int, share: float) -> None:
    successes = round(share * episodes)
    theirs = stats.binomtest(successes, episodes).proportion_ci(0.95, method="wilson")
    assert wilson_interval(successes, episodes) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


@given(values=st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=50))
def test_the_interval_of_a_mean_is_as_wide_as_its_standard_error_says(values: list[float]) -> None:
    mean = float(np.mean(values))
    lo, hi = mean_interval(values, mean)
    half = stats.norm.ppf(0.975) * stats.sem(values)
    assert (lo, hi) == pytest.approx((mean - half, mean + half), abs=1e-6)
    assert mean_interval([3.0], 3.0) == (3.0, 3.0)


def test_a_sweep_goes_through_the_whole_box_of_each_parameter_and_changes_nothing_else() -> None:
    space = make_task("pen_press").design_space
    designs = sweep_designs(space, space.initial)
    assert len(designs) == POINTS * len(space)
    for i, p in enumerate(space.parameters):
        mine = [phi for j, phi in designs if j == i]
        assert sorted(phi[i] for phi in mine) == pytest.approx(np.linspace(p.hard_lo, p.hard_hi, POINTS))
        assert all(np.array_equal(np.delete(phi, i), np.delete(space.initial, i)) for phi in mine)
    assert {i for i, _ in designs[: 2 * len(space)]} == set(range(len(space)))  # every curve has both ends early


SPACE = make_task("reacher").design_space.with_bound("link_1", 2.0, 3.0).with_lock("link_2", 1.0)


def test_a_design_may_be_given_whole_or_by_name_and_anywhere_in_the_tasks_own_box() -> None:
    recorded = SPACE.whole.initial
    assert phi_of(SPACE.whole, recorded, [4.0, 2.0, 3.0, 3.0, 3.0]).tolist() == [4.0, 2.0, 3.0, 3.0, 3.0]
    assert phi_of(SPACE.whole, recorded, {"link_2": 2.5})[1] == 2.5
    assert np.array_equal(np.delete(phi_of(SPACE.whole, recorded, {"link_2": 2.5}), 1), np.delete(recorded, 1))


@pytest.mark.parametrize(
    ("phi", "said"),
    [
        ({"link_9": 1.0}, 'unknown design parameter "link_9".*choose from: link_1'),
        ({"link_1": 99.0}, r"link_1 must lie inside \[0.05, 5\] m, not 99"),
        ({"link_1": float("nan")}, "link_1 must be finite, not nan"),
        ([1.0, 2.0], "phi has 2 entries; 5 are needed: link_1"),
        ([1.0, 2.0, 3.0, 4.0, float("inf")], "link_5 must be finite"),
    ],
)
def test_a_design_that_is_none_is_refused(phi: list[float] | dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        phi_of(SPACE.whole, SPACE.whole.initial, phi)


# --- the process ---


def test_the_answer_is_that_of_the_command_and_says_whose_policy_it_is(what_ifs: WhatIfs, history: History) -> None:
    found = what_ifs.evaluate(history, Wish(design="3", phi={"link_1": 2.0}, episodes=8), Cancellation())
    phi = [2.0, 2.7, 2.7, 2.7, 2.7]
    alone = evaluate_run(history.folder, "3", 8, other_phi=phi)
    assert found.phi == alone["phi"] == dict(zip(history.design_space.names, phi, strict=True))
    sampled = alone["sampled"]
    assert isinstance(sampled, dict)
    assert (found.success, found.episode_return) == (sampled["success"], sampled["episode_return"])
    assert sum(found.reward_terms.values()) == pytest.approx(found.episode_return)
    assert found.return_interval[0] < found.episode_return < found.return_interval[1]
    assert (found.iteration, found.policy_iteration) == (3, 2)
    assert found.note == "iteration 3 has no checkpoint: the policy is that of iteration 2, the nearest before"
    mean = what_ifs.evaluate(history, Wish(design="2", episodes=8, policy="deterministic"), Cancellation())
    assert mean.episode_return != found.episode_return
    assert mean.note == ""


def test_an_episode_on_the_design_comes_before_the_answer(what_ifs: WhatIfs, history: History) -> None:
    seen: list[bytes] = []
    what_ifs.evaluate(history, Wish(episodes=4, phi={"link_3": 1.5}), Cancellation(), on_played=seen.append)
    (episode,) = seen
    assert episode.startswith(b"PK")


def test_an_iteration_before_the_first_checkpoint_has_no_policy(what_ifs: WhatIfs, history: History) -> None:
    with pytest.raises(RunFolderError, match=r"no checkpoint up to iteration 1.*the first is of iteration 2"):
        what_ifs.evaluate(history, Wish(design="1"), Cancellation())
    with pytest.raises(RunFolderError, match="no iteration 9"):
        what_ifs.sweep(history, Wish(design="9"), Cancellation())


def test_a_sweep_measures_every_point(what_ifs: WhatIfs, history: History) -> None:
    points = list(what_ifs.sweep(history, Wish(episodes=2), Cancellation()))
    assert [point.number for point in points] == list(range(1, 46))
    assert all(point.of == 45 and point.measured is not None for point in points)
    assert {point.parameter for point in points} == set(history.design_space.names)
    assert {point.unit for point in points} == {"m"}


def test_what_is_cancelled_is_given_up_at_once_and_the_process_stays(
    evaluator: Evaluator, what_ifs: WhatIfs, history: History
) -> None:
    what_ifs.evaluate(history, Wish(episodes=1), Cancellation())
    before, cancellation, ended = pid_of(evaluator), Cancellation(), []

    def ask() -> None:
        try:
            what_ifs.evaluate(history, Wish(episodes=LONG), cancellation)
        except CancelledError:
            ended.append(time.monotonic())

    thread = threading.Thread(target=ask)
    thread.start()
    assert eventually(lambda: at_work(evaluator))
    time.sleep(0.3)
    cancelled = time.monotonic()
    cancellation.cancel()
    thread.join(10)
    assert ended
    assert ended[0] - cancelled < module.GRACE
    assert what_ifs.evaluate(history, Wish(episodes=1), Cancellation()).episodes == 1
    assert pid_of(evaluator) == before


def test_whoever_waits_can_give_up_and_hurried_questions_go_before_patient_ones(
    evaluator: Evaluator, what_ifs: WhatIfs, history: History
) -> None:
    first, waiting = Cancellation(), Cancellation()
    order: list[str] = []

    def ask(name: str, cancellation: Cancellation, sweep: bool, episodes: int) -> threading.Thread:
        def run() -> None:
            try:
                if sweep:
                    next(what_ifs.sweep(history, Wish(episodes=episodes), cancellation))
                else:
                    what_ifs.evaluate(history, Wish(episodes=episodes), cancellation)
            except CancelledError:
                order.append(f"{name} cancelled")
            else:
                order.append(name)

        thread = threading.Thread(target=run)
        thread.start()
        return thread

    threads = [ask("first", first, False, LONG)]
    assert eventually(lambda: at_work(evaluator))
    threads.append(ask("patient", Cancellation(), True, 1))
    assert eventually(lambda: len(evaluator._waiting) == 1)
    threads.append(ask("hurried", Cancellation(), False, 1))
    threads.append(ask("waiting", waiting, False, 1))
    assert eventually(lambda: len(evaluator._waiting) == 3)
    waiting.cancel()
    assert eventually(lambda: order == ["waiting cancelled"])
    first.cancel()
    for thread in threads:
        thread.join(20)
    assert order == ["waiting cancelled", "first cancelled", "hurried", "patient"]


def test_a_process_that_dies_is_an_error_of_one_question_alone(
    evaluator: Evaluator, what_ifs: WhatIfs, history: History
) -> None:
    what_ifs.evaluate(history, Wish(episodes=1), Cancellation())
    said: list[str] = []

    def ask() -> None:
        try:
            what_ifs.evaluate(history, Wish(episodes=LONG), Cancellation())
        except EvaluatorError as error:
            said.append(str(error))

    thread = threading.Thread(target=ask)
    thread.start()
    assert eventually(lambda: at_work(evaluator))
    os.kill(pid_of(evaluator), signal.SIGKILL)
    thread.join(10)
    assert said == ["the process that evaluates designs was killed by signal 9; the next question starts another one"]
    assert what_ifs.evaluate(history, Wish(episodes=1), Cancellation()).episodes == 1


@pytest.mark.slow
def test_a_process_that_ended_for_want_of_questions_is_started_again(
    monkeypatch: pytest.MonkeyPatch, history: History
) -> None:
    monkeypatch.setattr(module, "IDLE", 0.1)
    evaluator = Evaluator()
    evaluator.warm_up()
    first = evaluator._process
    assert first is not None
    assert eventually(lambda: first.is_gone, 20)
    assert first._child.returncode == 0
    looks = iter([False])  # it ends between the look and the question
    monkeypatch.setattr(module._Process, "is_gone", property(lambda _: next(looks, True)))
    monkeypatch.setattr(module, "IDLE", 60.0)
    assert WhatIfs(evaluator).evaluate(history, Wish(episodes=1), Cancellation()).episodes == 1
    assert evaluator._process is not first
    evaluator.close()


def test_what_takes_too_long_is_given_up(monkeypatch: pytest.MonkeyPatch, what_ifs: WhatIfs, history: History) -> None:
    what_ifs.evaluate(history, Wish(episodes=1), Cancellation())
    monkeypatch.setattr(module, "LONGEST", 0.3)
    with pytest.raises(EvaluatorError, match=r"longer than 0\.3 s.*fewer episodes"):
        what_ifs.evaluate(history, Wish(episodes=LONG), Cancellation())


def test_memory_beyond_the_limit_is_refused_and_not_taken(monkeypatch: pytest.MonkeyPatch, history: History) -> None:
    monkeypatch.setattr(module, "MEMORY", 400 << 20)
    evaluator = Evaluator()
    with pytest.raises((ValueError, EvaluatorError), match=r"memory|process"):
        WhatIfs(evaluator).evaluate(history, Wish(episodes=LONG), Cancellation())
    evaluator.close()


def test_too_many_at_once_are_refused(monkeypatch: pytest.MonkeyPatch, what_ifs: WhatIfs, history: History) -> None:
    monkeypatch.setattr(module, "MOST_WAITING", 0)
    with pytest.raises(EvaluatorError, match="0 evaluations wait already"):
        what_ifs.evaluate(history, Wish(episodes=1), Cancellation())


def test_the_process_ends_when_nobody_can_ask_any_more() -> None:
    def spawn(said: IO[bytes]) -> subprocess.Popen[bytes]:
        children.append(module.spawn_evaluator(said))
        return children[0]

    children: list[subprocess.Popen[bytes]] = []
    Evaluator(spawn).warm_up()
    assert children[0].stdin is not None
    children[0].stdin.close()  # as the system does for a server that was killed
    assert children[0].wait(20) == 0


def test_asking_loads_no_torch() -> None:
    code = "import sys, studio.what_if; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_checkpoint_that_has_gone_is_said(what_ifs: WhatIfs, tmp_path: Path) -> None:
    folder: RunFolder = make_run(tmp_path / "runs")
    add_checkpoint(folder, 2)
    (folder.checkpoint(2) / "weights.safetensors").unlink()
    with pytest.raises(ValueError, match=r"checkpoint 2 of .* is gone"):
        what_ifs.evaluate(History(folder), Wish(), Cancellation())


# --- the command ---


def evaluate(*words: str) -> subprocess.CompletedProcess[str]:
    return morph_studio("evaluate", *words)


@pytest.mark.slow
def test_the_command_measures_another_design_and_along_each_parameter(history: History) -> None:
    run = str(history.folder.path)
    done = evaluate(run, "--design", "3", "--phi", "link_1=2", "--episodes", "4", "--json")
    assert done.returncode == 0, done.stderr
    alone = evaluate_run(history.folder, "3", 4, other_phi=[2.0, 2.7, 2.7, 2.7, 2.7])
    assert json.loads(done.stdout) == json.loads(json.dumps(alone))
    said = evaluate(run, "--phi", "2", "1", "1", "1", "1", "--episodes", "4").stdout
    assert "link_1 2, link_2 1" in said
    assert "the policy is that of iteration 2" in said
    swept = evaluate(run, "--sensitivity", "--episodes", "2", "--json")
    points = json.loads(swept.stdout)["points"]
    assert [p["parameter"] for p in points] == [name for name in history.design_space.names for _ in range(POINTS)]
    assert [p["value"] for p in points[:POINTS]] == pytest.approx(np.linspace(0.05, 5, POINTS))


@pytest.mark.slow
def test_the_command_says_a_sweep_in_a_table(history: History) -> None:
    done = evaluate(str(history.folder.path), "--sensitivity", "--episodes", "1", "--policy", "deterministic")
    lines = [line for line in done.stdout.splitlines() if line.strip()]
    assert len(lines) == 1 + 5 * POINTS + 1
    assert lines[1].startswith("link_1")
    assert lines[-1] == "deterministic policy, 1 episodes on Hw-Phy at each value"
