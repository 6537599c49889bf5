"""A study on a real Slurm that loses a node, ends tasks and queues them again; its runs are as if nothing had been."""

import itertools
import subprocess
from pathlib import Path

import pytest
from cluster import Cluster, slurm_cluster
from conftest import eventually

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.protocol import StateChanged
from morph_core.run_folder import RunFolder
from morph_core.state import start
from studio.study.slurm import Slurm, SlurmOptions, slurm_launch
from tests.core.conftest import make_run, small_method

__all__ = ["slurm_cluster"]  # a fixture
ITERATIONS = 12
METHOD = small_method("morph", {"proxy.prefit": 5})
RUNS = [f"run-{seed}" for seed in range(8)]


def course(folder: RunFolder) -> list[tuple[list[float], float]]:
    """Return phi and the return of every iteration."""
    return [(progress.phi, progress.episode_return) for progress in History(folder).progress]


def uninterrupted(seed: int) -> list[tuple[list[float], float]]:
    """Return the course of a run to which nothing happens."""
    task = make_task("reacher")
    iterations = METHOD.iterations(task, start(task, METHOD, seed))
    return [(progress.phi, progress.episode_return) for progress in itertools.islice(iterations, ITERATIONS)]


def starts(folder: RunFolder) -> int:
    return sum(isinstance(event, StateChanged) and event.status == "starting" for event in History(folder).events)


def task_of(folder: RunFolder) -> str:
    launch = slurm_launch(folder)
    assert launch is not None
    return launch.job


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_study_survives_whatever_a_cluster_does_to_it(slurm_cluster: Cluster, tmp_path: Path) -> None:
    study = tmp_path / "study"
    folders = [make_run(study, name, METHOD, seed, ITERATIONS) for seed, name in enumerate(RUNS)]
    slurm = Slurm(SlurmOptions(mem="1G", parallel=2))
    slurm.check()
    slurm.submit(study, RUNS)
    most = 0

    def places() -> list[tuple[str, bool]]:
        nonlocal most
        slurm._queue.forget()
        found = [(place.where, place.given_up) for place in slurm.states(study, RUNS).values()]
        most = max(most, sum(bool(where) for where, _ in found))
        return found

    def at_work(folder: RunFolder) -> bool:
        places()
        history = History(folder)
        return history.status == "running" and 2 <= history.iteration < ITERATIONS - 4

    # A power cut.
    assert eventually(lambda: at_work(folders[0]), 60)
    places()
    node = slurm.states(study, RUNS)[RUNS[0]].where.split()[0]
    assert slurm_cluster.kill_node(node) >= 3, "the daemon, a step and the trainer"
    # The last run is cancelled while it waits, another one as it works.
    slurm.cancel(study, RUNS[-1:])
    assert eventually(lambda: slurm_cluster.state(node).startswith("down"), 90)
    slurm_cluster.start_node(node)
    # The time limit: what Slurm sends to the job script when it is near.
    assert eventually(lambda: any(map(at_work, folders[2:5])), 90)
    limited = next(folder for folder in folders[2:5] if at_work(folder))
    subprocess.run(["scancel", "--batch", "--signal=USR1", task_of(limited)], check=True)
    assert eventually(lambda: History(limited).status == "stopped", 30)
    slurm.requeue(study, RUNS)
    assert eventually(lambda: all(over for _, over in places()), 240), slurm.states(study, RUNS)
    assert most == 2
    assert [History(folder).status for folder in folders] == ["finished"] * 8
    assert starts(folders[0]) >= 2
    assert starts(limited) >= 2
    assert [course(folder) for folder in folders] == [uninterrupted(seed) for seed in range(8)]
