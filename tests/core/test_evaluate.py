"""Evaluation of a run from its folder."""

import dataclasses
import json
from dataclasses import dataclass

import numpy as np
import pytest

from morph_core.evaluate import evaluate_run, measure
from morph_core.run_folder import RunFolder, RunFolderError, hold
from morph_core.state import start
from morph_core.task import Hardware, Transition
from morph_core.tasks.reacher import Reacher
from morph_core.train import train
from tests.core.conftest import SMALL, make_run
from tests.forked import Forked


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = make_run(tmp_path_factory.mktemp("runs"))
    assert train(folder) == 0
    return folder


def test_best_latest_and_an_iteration_can_be_evaluated(run: RunFolder) -> None:
    latest = evaluate_run(run, "latest", 4)
    assert (latest["iteration"], latest["policy_iteration"], latest["episodes"]) == (6, 6, 4)
    assert evaluate_run(run, "5", 4)["policy_iteration"] == 4
    assert evaluate_run(run, "best", 4)["iteration"] in (2, 4, 6)
    assert evaluate_run(run, "latest", 4) == latest


def test_a_design_without_a_policy_is_refused(run: RunFolder) -> None:
    with pytest.raises(RunFolderError, match="no checkpoint up to iteration 1"):
        evaluate_run(run, "1", 4)
    with pytest.raises(RunFolderError, match="no iteration 99"):
        evaluate_run(run, "99", 4)


@pytest.mark.slow
def test_the_process_prints_one_document(run: RunFolder) -> None:
    words = ("--run", str(run.path), "--episodes", "2")
    done = Forked("morph_core.evaluate", *words)
    assert done.wait() == 0
    document = json.loads(done.said("output"))
    assert set(document["phi"]) == {f"link_{i}" for i in range(1, 6)}
    assert 0 <= document["sampled"]["success"] <= 1
    wrong = Forked("morph_core.evaluate", *words, "--design", "worst")
    assert wrong.wait() == 2
    assert "choose best, latest" in wrong.said("errors")


def test_evaluating_needs_no_hold(run: RunFolder) -> None:
    with hold(run):
        assert evaluate_run(run, "latest", 2)["run"] == run.id


@dataclass(frozen=True)
class Short(Reacher):
    """A reacher whose episodes are over once the first joint has turned by 0.2 rad."""

    def step(self, hardware: Hardware, s: np.ndarray, action: np.ndarray) -> Transition:
        step = super().step(hardware, s, action)
        return dataclasses.replace(step, terminated=np.abs(step.s[:, 0] - self.start[0]) > 0.2)


def test_the_terms_of_the_reward_add_up_to_the_return_of_the_steps_before_the_end() -> None:
    task = Short()
    policy = start(task, SMALL, 0).control.policy
    measured, rollout = measure(task, policy, task.design_space.initial, 16, (0, 0), sampled=True)
    assert rollout.alive.sum() < rollout.alive.size
    assert sum(measured.reward_terms.values()) == pytest.approx(measured.episode_return)
    assert measured.episode_return == pytest.approx(rollout.returns.mean())
    lo, hi = measured.return_interval
    assert lo < measured.episode_return < hi


def test_another_design_may_lie_anywhere_in_the_tasks_own_box(run: RunFolder) -> None:
    found = evaluate_run(run, "latest", 2, other_phi=[4.9, 0.1, 1.0, 1.0, 1.0])
    assert found["phi"] == {"link_1": 4.9, "link_2": 0.1, "link_3": 1.0, "link_4": 1.0, "link_5": 1.0}
    with pytest.raises(ValueError, match=r"link_1 must lie inside \[0.05, 5\] m, not 6"):
        evaluate_run(run, "latest", 2, other_phi=[6.0, 1.0, 1.0, 1.0, 1.0])


def test_an_evaluation_ends_early_where_it_is_told_to() -> None:
    steps = []

    def before_step() -> None:
        steps.append(len(steps))
        if len(steps) == 3:
            raise InterruptedError

    task = Reacher()
    with pytest.raises(InterruptedError):
        measure(task, start(task, SMALL, 0).control.policy, task.design_space.initial, 2, (0, 0), True, before_step)
    assert len(steps) == 3
