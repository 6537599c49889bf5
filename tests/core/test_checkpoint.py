"""Checkpoints: whole or not at all, and never a surprise on load."""

import itertools
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from morph_core.catalogue import make_task
from morph_core.checkpoint import damage_of, load_checkpoint, load_newest, recover_checkpoints, save_checkpoint
from morph_core.run_folder import HeartbeatFile, RunFolder, RunFolderError
from morph_core.state import State, start
from tests.core.conftest import SMALL, make_run, rewrite, small_method

pytestmark = pytest.mark.usefixtures("short_episodes")

TASK = make_task("reacher")


@pytest.fixture
def saved(tmp_path: Path) -> tuple[RunFolder, State]:
    """A run folder with the checkpoint of one iteration, and its state."""
    folder, state = make_run(tmp_path), start(TASK, SMALL, 0)
    next(SMALL.iterations(TASK, state))
    save_checkpoint(folder, state, 1.5)
    return folder, state


def test_a_checkpoint_brings_back_everything(saved: tuple[RunFolder, State]) -> None:
    folder, state = saved
    loaded, cpu_seconds = load_checkpoint(folder, 1, TASK, SMALL)
    assert cpu_seconds == 1.5
    assert (loaded.iteration, loaded.env_steps, loaded.alpha, loaded.fitted) == (1, state.env_steps, 1.0, True)
    assert loaded.phi.tolist() == state.phi.tolist()
    assert loaded.rng.bit_generator.state == state.rng.bit_generator.state
    again, expected = (next(SMALL.iterations(TASK, s)) for s in (loaded, state))
    assert again == expected


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_a_run_with_a_reference_goes_on_bit_for_bit(tmp_path: Path, iterations: int) -> None:
    method = small_method("morph", {"search": "drift", "design_interval": 2, "search.designs": 8})
    folder, state = make_run(tmp_path, method=method), start(TASK, method, 0)
    for _ in itertools.islice(method.iterations(TASK, state), iterations):  # 2: right after a search
        pass
    state.diverged = 7
    save_checkpoint(folder, state, 1.5)
    loaded, _ = load_checkpoint(folder, iterations, TASK, method)
    assert (loaded.relabelled_steps, loaded.diverged) == (state.relabelled_steps, 7)
    again, expected = (list(itertools.islice(method.iterations(TASK, s), 3)) for s in (loaded, state))
    assert again == expected
    assert set(state.modules) == {"policy", "critic", "proxy", "reference"}
    for name, module in state.modules.items():
        assert all(torch.equal(loaded.modules[name].state_dict()[k], v) for k, v in module.state_dict().items())


@pytest.mark.parametrize("exploration", ["gaussian", "gaussian_iid"])
def test_a_run_in_the_proxys_world_goes_on_bit_for_bit(tmp_path: Path, exploration: str) -> None:
    method = small_method("morph", {"exploration": exploration})
    folder, state = make_run(tmp_path, method=method), start(TASK, method, 0)
    for _ in itertools.islice(method.iterations(TASK, state), 2):
        pass
    save_checkpoint(folder, state, 1.5)
    loaded, _ = load_checkpoint(folder, 2, TASK, method)
    again, expected = (list(itertools.islice(method.iterations(TASK, s), 3)) for s in (loaded, state))
    assert again == expected


def test_a_checkpoint_without_the_reference_that_the_search_needs_is_refused(
    saved: tuple[RunFolder, State],
) -> None:
    folder, _ = saved
    with pytest.raises(RunFolderError, match="can't be read"):
        load_checkpoint(folder, 1, TASK, small_method("morph", {"search": "drift"}))


def test_saving_the_same_iteration_again_replaces_it(saved: tuple[RunFolder, State]) -> None:
    folder, state = saved
    state.alpha = 9.0
    save_checkpoint(folder, state, 2.0)
    assert load_checkpoint(folder, 1, TASK, SMALL)[0].alpha == 9.0
    assert [p.name for p in folder.checkpoints.iterdir()] == ["000001"]


def test_what_a_dying_trainer_left_is_tidied_up(saved: tuple[RunFolder, State]) -> None:
    folder, _ = saved
    folder.checkpoint(1).rename(folder.checkpoints / ".000001.old")
    (folder.checkpoints / ".000002.draft").mkdir()
    assert folder.checkpoint_iterations() == []
    recover_checkpoints(folder)
    assert [p.name for p in folder.checkpoints.iterdir()] == ["000001"]


@pytest.mark.parametrize("damage", ["state.json", "weights.safetensors", "header", "json", "shape"])
def test_a_damaged_checkpoint_is_an_error_and_an_older_one_stands_in(
    saved: tuple[RunFolder, State], damage: str
) -> None:
    folder, state = saved
    next(SMALL.iterations(TASK, state))
    save_checkpoint(folder, state, 2.0)
    path = folder.checkpoint(2)
    match damage:
        case "header":
            (path / "weights.safetensors").write_bytes(b"\xff" * 64)
        case "json":
            (path / "state.json").write_text('{"iteration": 2')
        case "shape":
            rewrite(path, phi=[1.0] * 6)
        case name:
            (path / name).unlink()
    with pytest.raises(RunFolderError, match="checkpoint 2 of run can't be read"):
        load_checkpoint(folder, 2, TASK, SMALL)
    newest, damaged = load_newest(folder, TASK, SMALL)
    assert newest is not None
    assert newest[0].iteration == 1
    assert [words.startswith("checkpoint 2 of run can't be read: ") for words in damaged] == [True]


@pytest.mark.parametrize(("umask", "mode"), [(0o002, 0o664), (0o022, 0o644), (0o077, 0o600)])
def test_a_group_can_go_on_with_a_run_if_its_umask_says_so(tmp_path: Path, umask: int, mode: int) -> None:
    before = os.umask(umask)
    try:
        folder = make_run(tmp_path)
        save_checkpoint(folder, start(TASK, SMALL, 0), 1.5)
        HeartbeatFile(folder).close()
    finally:
        os.umask(before)
    written = [*folder.checkpoint(0).iterdir(), folder.path / "heartbeat.json"]
    assert {path.stat().st_mode & 0o777 for path in written} == {mode}
    assert len(written) == 3


def test_a_run_without_checkpoints_has_no_newest(tmp_path: Path) -> None:
    assert load_newest(make_run(tmp_path), TASK, SMALL) == (None, [])


def test_a_value_that_is_not_finite_is_noticed() -> None:
    state = start(TASK, SMALL, 0)
    assert not damage_of(state)
    with torch.no_grad():
        next(state.hw_nn.proxy.parameters())[0] = torch.nan
    assert damage_of(state)
    state = start(TASK, SMALL, 0)
    state.phi = np.full(5, np.inf)
    assert damage_of(state)
