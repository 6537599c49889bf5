"""Evaluation of a run from its folder."""

import json
import subprocess
import sys

import pytest

from morph_core.evaluate import evaluate_run
from morph_core.run_folder import RunFolder, RunFolderError, hold
from morph_core.train import train
from tests.core.conftest import make_run


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


def test_the_process_prints_one_document(run: RunFolder) -> None:
    command = [sys.executable, "-m", "morph_core.evaluate", "--run", str(run.path), "--episodes", "2"]
    document = json.loads(subprocess.run(command, capture_output=True, check=True, text=True).stdout)
    assert set(document["phi"]) == {f"link_{i}" for i in range(1, 6)}
    assert 0 <= document["sampled"]["success"] <= 1
    wrong = subprocess.run([*command, "--design", "worst"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2
    assert "choose best, latest" in wrong.stderr


def test_evaluating_needs_no_hold(run: RunFolder) -> None:
    with hold(run):
        assert evaluate_run(run, "latest", 2)["run"] == run.id
