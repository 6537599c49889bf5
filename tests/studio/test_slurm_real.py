"""A study on a real Slurm that loses a node, ends tasks and queues them again; its runs are as if nothing had been."""

import contextlib
import itertools
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from cluster import Cluster, slurm_cluster
from conftest import eventually

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.protocol import StateChanged
from morph_core.run_folder import RunFolder
from morph_core.state import start
from studio.study.launcher import Place
from studio.study.slurm import Slurm, slurm_launch
from studio.study.slurm_options import SlurmOptions
from tests.core.conftest import make_run, small_method

__all__ = ["slurm_cluster"]  # a fixture
ITERATIONS = 40
"""Iterations of a run: it must last for seconds on an idle machine too, so that it is met at work."""
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


def stops(folder: RunFolder) -> int:
    return sum(isinstance(event, StateChanged) and event.status == "stopped" for event in History(folder).events)


def task_of(folder: RunFolder) -> str:
    launch = slurm_launch(folder)
    assert launch is not None
    return launch.job


class Watch:
    """A study of eight runs on a cluster, and how many of them were at work at once at most."""

    def __init__(self, study: Path) -> None:
        self.study = study
        self.folders = [make_run(study, name, METHOD, seed, ITERATIONS) for seed, name in enumerate(RUNS)]
        self.slurm = Slurm(SlurmOptions(mem="1G", parallel=2))
        self.most = 0

    def places(self) -> Mapping[str, Place]:
        time.sleep(0.2)
        self.slurm._queue.forget()
        places = self.slurm.states(self.study, RUNS)
        self.most = max(self.most, sum(bool(place.where) for place in places.values()))
        return places

    def at_work(self, first: int, last: int, without: str = "") -> RunFolder | None:
        """Return one of these runs that has begun, will not end at once, and is not on the node `without`."""
        places = self.places()
        for folder in self.folders[first : last + 1]:
            history = History(folder)
            where = places[folder.id].where.split()[:1]
            if where not in ([], [without]) and history.status == "running" and 1 <= history.iteration < ITERATIONS - 9:
                return folder
        return None

    def wait_for_work(self, first: int, last: int, without: str = "") -> tuple[RunFolder, str]:
        """Return such a run, and its node."""
        folder = eventually(lambda: self.at_work(first, last, without), 120)
        assert isinstance(folder, RunFolder), self.places()
        return folder, self.places()[folder.id].where.split()[0]

    def stopped_by(self, act: Callable[[RunFolder, str], object], first: int, last: int, without: str) -> RunFolder:
        """Do something to a run at work, and return it once it has stopped; to the next one if it ended before."""
        for _ in range(last):
            folder, node = self.wait_for_work(first, last, without)
            before = stops(folder)
            with contextlib.suppress(subprocess.CalledProcessError):  # Slurm has no such task any more
                act(folder, node)
            ended = eventually(lambda: stops(folder) > before or History(folder).status == "finished", 30)  # noqa: B023
            if ended and stops(folder) > before:
                return folder
        raise AssertionError(self.places())


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_study_survives_whatever_a_cluster_does_to_it(slurm_cluster: Cluster, tmp_path: Path) -> None:
    watch = Watch(tmp_path / "study")
    watch.slurm.check()
    watch.slurm.submit(watch.study, RUNS)
    # A power cut; the last run is cancelled while it waits.
    killed, node = watch.wait_for_work(0, 1)
    assert slurm_cluster.kill_node(node) >= 3, "the daemon, a step and the trainer"
    watch.slurm.cancel(watch.study, RUNS[-1:])
    # Before Slurm has missed the node, on the other one: a job that comes first.
    urgent = ("sbatch", "--partition=urgent", "--output=/dev/null", "--wrap=sleep 1")
    preempted = watch.stopped_by(
        lambda _, alive: slurm_cluster.run(*urgent, f"--nodelist={alive}"), first=1, last=6, without=node
    )
    # The time limit: what Slurm sends to the job script when it is near.
    limited = watch.stopped_by(
        lambda run, _: slurm_cluster.run("scancel", "--batch", "--signal=USR1", task_of(run)),
        first=1, last=6, without=node,
    )  # fmt: skip
    # The node is missed, and comes back.
    assert eventually(lambda: slurm_cluster.state(node).startswith("down"), 90)
    slurm_cluster.start_node(node)
    assert eventually(lambda: not slurm_cluster.state(node).startswith("down"), 60)
    watch.slurm.requeue(watch.study, RUNS)
    assert eventually(lambda: all(place.given_up for place in watch.places().values()), 300), watch.places()
    assert watch.most == 2
    assert [History(folder).status for folder in watch.folders] == ["finished"] * 8
    assert all(starts(folder) >= 2 for folder in (killed, preempted, limited))
    assert [course(folder) for folder in watch.folders] == [uninterrupted(seed) for seed in range(8)]
