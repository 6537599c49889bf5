"""The episodes of an evaluation that are recorded: which ones, how they come back, and files of earlier versions."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from morph_core.episodes import chosen_episodes, evaluate, outcomes, record_episode, record_episodes
from morph_core.rollout import Rollout
from morph_core.run_folder import RunFolder, RunFolderError, read_episode, write_episode
from tests.core.scales import Scales, started

PHI = np.array([1.0, 2.0])
EPISODES_AND_OUTCOMES = st.lists(st.tuples(st.floats(-1e6, 1e6), st.booleans()), min_size=1, max_size=12)


def played(episodes: int = 8, succeeding: float = 0.5) -> tuple[Scales, Rollout]:
    task = Scales(ends=2, succeeding=succeeding, near=0.25)
    return task, evaluate(task, started().control.policy, PHI, episodes, np.random.default_rng(0), True)[1]


@given(EPISODES_AND_OUTCOMES)
def test_the_episodes_are_chosen_by_return(found: list[tuple[float, bool]]) -> None:
    returns, successes = np.array([r for r, _ in found]), np.array([s for _, s in found])
    rollout: Any = SimpleNamespace(returns=returns, successes=successes)
    chosen = chosen_episodes(rollout)
    assert returns[chosen["best"]] == returns.max()
    assert returns[chosen["worst"]] == returns.min()
    below = (returns < returns[chosen["median"]]).sum()
    above = (returns > returns[chosen["median"]]).sum()
    assert below <= (len(found) - 1) // 2
    assert above <= len(found) // 2
    assert ("failed" in chosen) == (not successes.all())
    if "failed" in chosen:
        others = returns[~successes]
        assert not successes[chosen["failed"]]
        assert (others < returns[chosen["failed"]]).sum() <= (len(others) - 1) // 2
    assert [(r.which, r.episode_return, r.success) for r in outcomes(rollout)] == [
        (which, returns[i], successes[i]) for which, i in chosen.items()
    ]


def test_every_recorded_episode_comes_back_as_it_was(tmp_path: Path) -> None:
    task, rollout = played()
    folder = RunFolder(tmp_path)
    write_episode(folder, 4, record_episodes(task, rollout, PHI) | {"population": np.ones((2, 2))})
    chosen = chosen_episodes(rollout)
    assert len({chosen["best"], chosen["worst"]}) == 2
    for which, episode in chosen.items():
        expected = record_episode(task, rollout, PHI, episode)
        found = read_episode(folder, 4, which)
        assert sorted(found) == sorted([*expected, "population"])
        for name, array in expected.items():
            np.testing.assert_array_equal(found[name], array)
    assert read_episode(folder, 4)["qpos"].tolist() == read_episode(folder, 4, "median")["qpos"].tolist()


def test_an_episode_chosen_twice_is_written_once() -> None:
    task, rollout = played(episodes=1)
    assert not [name for name in record_episodes(task, rollout, PHI) if name[0].isdecimal()]


def test_what_was_not_recorded_is_refused_with_the_choices(tmp_path: Path) -> None:
    task, rollout = played(succeeding=1.0)
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()
    write_episode(folder, 4, record_episodes(task, rollout, PHI))
    with pytest.raises(RunFolderError, match="iteration 4 of run has no failed episode; choose from: median, best, w"):
        read_episode(folder, 4, "failed")
    write_episode(folder, 5, record_episode(task, rollout, PHI))
    assert read_episode(folder, 5)["phi"].tolist() == [1.0, 2.0]
    with pytest.raises(RunFolderError, match="iteration 5 of run has no best episode; a single one was recorded"):
        read_episode(folder, 5, "best")
    write_episode(folder, 6, {"qpos": np.zeros((2, 3)), "recorded": np.array(["x"])})
    with pytest.raises(RunFolderError, match="can't be read"):
        read_episode(folder, 6)


def test_where_every_simulation_diverged_there_is_nothing_to_watch() -> None:
    class Exploding(Scales):
        def hw_phy(self, phi: np.ndarray) -> Any:
            return lambda s, _: np.full((len(s), 2), np.nan)

    _, rollout = evaluate(Exploding(), started().control.policy, PHI, 4, np.random.default_rng(0), True)
    assert (chosen_episodes(rollout), outcomes(rollout)) == ({}, [])
    arrays = record_episodes(Exploding(), rollout, PHI)
    assert sorted(arrays) == ["phi", "recorded"]
    assert arrays["recorded"].tolist() == [-1] * 4
