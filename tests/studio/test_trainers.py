"""The trainer in reserve: used once, replaced if dead, gone with the server."""

import math
import time
from pathlib import Path

import pytest

from morph_core.history import History
from studio.new_run import StartRun, prepare_run
from studio.trainers import Reserve, spawn_trainer

TINY = {
    "trajectories": 4,
    "ppo": {"epochs": 1, "minibatches": 1},
    "proxy.prefit": 5,
    "search.generations": 2,
    "hidden": 8,
}


def finished(history: History) -> bool:
    history.poll()
    return history.status == "finished"


@pytest.mark.slow
@pytest.mark.parametrize("dead", [False, True])
def test_a_run_is_trained_by_the_reserve_or_without_it(tmp_path: Path, dead: bool) -> None:
    folder = prepare_run(tmp_path, StartRun(task="reacher", iterations=2, settings=TINY))
    reserve = Reserve()
    reserve.load()
    ready = reserve._ready
    assert ready is not None
    if dead:
        ready.kill()
        ready.wait()
    trainer = reserve.spawn(folder)
    assert (trainer.pid == ready.pid) is not dead
    reserve.close()
    assert trainer.wait(120) == 0
    assert finished(History(folder))
    assert (folder.path / "trainer.log").exists()


def test_the_reserve_goes_with_the_server(tmp_path: Path) -> None:
    reserve = Reserve()
    reserve.load()
    ready = reserve._ready
    assert ready is not None
    reserve.load()
    assert reserve._ready is ready
    began = time.monotonic()
    reserve.close()
    assert ready.poll() is not None
    assert time.monotonic() - began < 10
    reserve.load()
    assert reserve._ready is ready
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(("task", "iterations"), [("reacher", 40), ("mouse_click", 12)])
def test_after_a_tenth_of_a_real_run_it_is_known_how_long_the_rest_takes(
    tmp_path: Path, task: str, iterations: int
) -> None:
    """Within a factor of three: other work of the machine comes and goes, and a first tenth may lack an evaluation, of
    which a hand's takes as long as two iterations. How good the estimate is was measured on recorded runs."""
    folder, told = prepare_run(tmp_path, StartRun(task=task, iterations=iterations)), None
    trainer = spawn_trainer(folder)
    while trainer.poll() is None:
        beat = folder.heartbeat()
        if told is None and beat and beat.iteration > math.ceil(iterations / 10):
            told = time.monotonic(), beat.eta_seconds, beat.iteration
        time.sleep(0.02)
    assert finished(History(folder))
    assert told is not None
    began, seconds, iteration = told
    assert iteration <= iterations / 4
    took = time.monotonic() - began
    assert took / 3 < seconds < 3 * took
