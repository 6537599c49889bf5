"""Branches: what a run takes along of its parent, that it goes on as the parent did, and replays of a run's log."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from morph_core.beginning import begin
from morph_core.catalogue import make_task
from morph_core.config import recorded
from morph_core.history import History
from morph_core.method import Method
from morph_core.origin import Origin, origin_at
from morph_core.protocol import InjectDesign, Lock, SetAlpha, StateChanged
from morph_core.replay import Comparison, Difference, compare
from morph_core.run_folder import RunFolder, RunFolderError, create_run
from morph_core.state import State
from morph_core.train import Trainer
from tests.core.conftest import SMALL, make_run, rewrite, small_method

pytestmark = pytest.mark.usefixtures("short_episodes")

TASK = make_task("reacher")
METHODS = ("morph", "cmaes_rl", "direct", "no_hw_opt", "transform2act", "value_gradient")


def trained(runs: Path, method: Method = SMALL, iterations: int = 6) -> History:
    """Train the run `parent` in this process, with a checkpoint after every second iteration."""
    folder = make_run(runs, "parent", method, iterations=iterations)
    Trainer(folder).run()
    return History(folder)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a trained run, to be copied."""
    return trained(tmp_path_factory.mktemp("whole")).folder.path


@pytest.fixture
def parent(whole: Path, tmp_path: Path) -> History:
    """A trained run that a test may damage."""
    return History(RunFolder(shutil.copytree(whole, tmp_path / whole.name)))


def branch(
    parent: History, iteration: int | None = None, method: Method | None = None, seed: int = 0, name: str = "child",
    changes: Mapping[str, Mapping[str, float]] | None = None, last: int = 6,
) -> RunFolder:  # fmt: skip
    """Write the folder of a branch as the studio does; `changes` are fields of design parameters by their name."""
    origin = origin_at(parent, iteration)
    chosen = method or SMALL
    goes_on = chosen.name == parent.record.method
    held = zip(origin.in_force.space.parameters, origin.in_force.phi.tolist(), strict=True)
    record = msgspec.structs.replace(
        parent.record, id=name, method=chosen.name, config=recorded(chosen), seed=seed, iterations=last,
        parameters=[
            msgspec.structs.replace(p, **{"initial": value, **(changes or {}).get(p.name, {})}) for p, value in held
        ],
        parent=origin.parent, begins_at=origin.begins_at if goes_on else 0,
    )  # fmt: skip
    return create_run(parent.folder.path.parent, record, origin.files)


def beginning(folder: RunFolder, method: Method = SMALL) -> tuple[State, str]:
    begun = begin(folder, folder.record(), TASK, method)
    return begun.state, begun.words


def weights(state: State, name: str) -> list[torch.Tensor]:
    return list(state.modules[name].state_dict().values())


def equal(ours: list[torch.Tensor], theirs: list[torch.Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


@pytest.mark.parametrize("name", METHODS)
def test_a_branch_with_nothing_changed_goes_on_exactly_as_its_parent_did(tmp_path: Path, name: str) -> None:
    method = small_method(name)
    parent = trained(tmp_path, method, iterations=4)
    folder = branch(parent, 2, method, last=4)
    shutil.rmtree(parent.folder.path)  # it takes along all that it needs
    Trainer(folder).run()
    child = History(folder)
    assert [p.iteration for p in child.progress] == [3, 4]
    for ours, theirs in zip(child.progress, parent.progress[2:], strict=True):
        same = {"seq": 0, "time": 0.0, "cpu_seconds": 0.0}
        assert msgspec.structs.replace(ours, **same) == msgspec.structs.replace(theirs, **same)
    assert [e.sampled_return for e in child.evaluations] == [e.sampled_return for e in parent.evaluations[1:]]


@pytest.mark.parametrize("settings", [{"exploration": "gaussian"}, {"search": "drift"}, {"search": "cma_debiased"}])
def test_so_does_one_with_whatever_else_a_checkpoint_holds(tmp_path: Path, settings: dict[str, Any]) -> None:
    method = small_method("morph", {**settings, "design_interval": 2})
    parent = trained(tmp_path, method, iterations=4)
    folder = branch(parent, 2, method, last=4)
    Trainer(folder).run()
    assert [p.phi for p in History(folder).progress] == [p.phi for p in parent.progress[2:]]


def test_a_steered_parent_hands_on_what_was_in_force(tmp_path: Path) -> None:
    folder = make_run(tmp_path, "parent", iterations=2)
    folder.send(SetAlpha(3.0), sender="a test")
    folder.send(Lock("link_2", 1.25))
    Trainer(folder).run()
    origin = origin_at(History(folder))
    assert (origin.in_force.alpha, origin.in_force.phi[1]) == (3.0, 1.25)
    assert origin.in_force.space.parameters[1].locked_at == 1.25
    assert History(folder).acknowledged[0].sender == "a test"


def test_the_nearest_checkpoint_before_is_taken_and_said(parent: History) -> None:
    origin = origin_at(parent, 5)
    assert (origin.checkpoint, origin.begins_at, origin.env_steps) == (4, 4, parent.progress[3].env_steps)
    assert origin.words == "at iteration 4 of parent, the nearest checkpoint up to iteration 5"
    state, words = beginning(branch(parent, 5))
    assert state.iteration == 4
    assert "its nearest checkpoint up to iteration 5" in words
    early = origin_at(parent, 1)
    assert (early.checkpoint, early.begins_at, early.in_force.phi.tolist()) == (None, 0, parent.initial_phi.tolist())
    assert "no checkpoint was saved up to iteration 1" in early.words
    assert origin_at(parent, 0).words == "at the beginning of parent"


def test_a_branch_of_the_beginning_is_the_same_run_again(tmp_path: Path) -> None:
    parent = trained(tmp_path, iterations=2)
    folder = branch(parent, 1, last=2)
    Trainer(folder).run()
    assert [p.phi for p in History(folder).progress] == [p.phi for p in parent.progress]


def test_a_branch_saves_what_it_took_along_before_its_first_iteration(parent: History) -> None:
    folder = branch(parent, 4, last=4)
    Trainer(folder).run()
    child = History(folder)
    assert folder.checkpoint_iterations() == [4]
    assert (child.iteration, child.progress, child.design("0")[0], child.design("4")[0]) == (4, [], 4, 4)
    with pytest.raises(RunFolderError, match="has no iteration 3; choose best, latest or 4 to 4"):
        child.design("3")
    assert origin_at(child).parent.checkpoint == 4
    with pytest.raises(RunFolderError, match="child has no iteration 2; it is at iteration 4"):
        origin_at(child, 2)


def test_another_seed_goes_on_with_other_random_numbers(parent: History) -> None:
    same, other = beginning(branch(parent, 2))[0], beginning(branch(parent, 2, seed=1, name="other"))[0]
    assert equal(weights(same, "policy"), weights(other, "policy"))
    assert same.rng.bit_generator.state != other.rng.bit_generator.state
    assert other.rng.bit_generator.state == np.random.default_rng(1).bit_generator.state


def test_policy_and_critic_of_another_size_start_afresh_with_their_schedule(parent: History) -> None:
    wider = small_method("morph", {"hidden": 24})
    state, words = beginning(branch(parent, 4, wider), wider)
    assert (state.iteration, state.control_start, state.last_reached, state.fitted) == (4, 4, 4, False)
    assert "policy and critic start afresh" in words
    assert "the proxy is fitted anew" in words
    next(wider.iterations(TASK, state))
    assert state.fitted


def test_another_search_takes_the_policy_and_fits_the_proxy_anew(parent: History) -> None:
    drift = small_method("morph", {"search": "drift"})
    state, words = beginning(branch(parent, 4, drift), drift)
    before = beginning(branch(parent, 4, name="same"))[0]
    assert equal(weights(state, "policy"), weights(before, "policy"))
    assert (state.fitted, state.control_start) == (False, before.control_start)
    assert "the proxy is fitted anew" in words
    next(drift.iterations(TASK, state))


@pytest.mark.parametrize(
    ("change", "fitted", "frozen"),
    [({}, True, True), ({"link_1": {"hi": 4.5}}, True, False), ({"link_1": {"initial": 2.5}}, False, False)],
)
def test_another_design_thaws_phi_and_the_proxy_is_fitted_anew_where_phi_moved(
    tmp_path: Path, change: dict[str, Any], fitted: bool, frozen: bool
) -> None:
    method = small_method("morph", {"freeze_success": 1e-9})
    parent = trained(tmp_path, method, iterations=2)
    rewrite(parent.folder.checkpoint(2), frozen=True, fitted=True)
    state, _ = beginning(branch(parent, 2, method, changes=change), method)
    assert (state.fitted, state.frozen) == (fitted, frozen)


@pytest.mark.parametrize(("name", "fits"), [("direct", True), ("value_gradient", False)])
def test_another_method_counts_from_0_and_takes_the_weights_that_fit(parent: History, name: str, fits: bool) -> None:
    method = small_method(name)
    state, words = beginning(branch(parent, 4, method), method)
    before = beginning(branch(parent, 4, name="same"))[0]
    assert (state.iteration, state.env_steps, state.proxy) == (0, 0, None)
    assert state.phi.tolist() == before.phi.tolist() == parent.progress[3].phi
    assert ("weights of the policy" in words) is fits
    if fits:
        assert equal(weights(state, "policy"), weights(before, "policy"))
        assert equal(weights(state, "critic"), weights(before, "critic"))
    assert state.rng.bit_generator.state == np.random.default_rng(0).bit_generator.state
    next(method.iterations(TASK, state))


@pytest.mark.parametrize("file", ["state.json", "weights.safetensors"])
@pytest.mark.parametrize("damage", ["cut", "gone", "foreign"])
def test_a_damaged_checkpoint_is_refused_and_the_one_before_named(parent: History, file: str, damage: str) -> None:
    path = parent.folder.checkpoint(4) / file
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-7] if damage == "cut" else b"{}")
    with pytest.raises(RunFolderError, match=r"checkpoint 4 of parent can't be read: .*; the one before is .* 2$"):
        origin_at(parent, 5)
    assert origin_at(parent, 3).checkpoint == 2


def test_a_weight_that_is_no_number_is_refused(tmp_path: Path) -> None:
    from safetensors.numpy import load_file, save_file

    parent = trained(tmp_path, iterations=2)
    path = parent.folder.checkpoint(2) / "weights.safetensors"
    tensors = load_file(path)
    tensors["policy/log_std"][0] = np.nan
    save_file(tensors, path)
    rewrite(path.parent)
    with pytest.raises(RunFolderError, match="a weight is infinite or NaN"):
        origin_at(parent)


@pytest.mark.parametrize("iteration", [-1, 7, 10**9])
def test_an_iteration_that_is_not_there_is_refused_with_the_choice(parent: History, iteration: int) -> None:
    with pytest.raises(RunFolderError, match=f"parent has no iteration {iteration}; choose 0 to 6"):
        origin_at(parent, iteration)


def test_a_branch_that_has_saved_nothing_names_its_parent(parent: History) -> None:
    child = History(branch(parent, 4))
    with pytest.raises(RunFolderError, match="child has saved nothing yet: branch from its parent, parent"):
        origin_at(child)


def test_a_branch_whose_origin_is_lost_says_so(parent: History) -> None:
    folder = branch(parent, 4)
    shutil.rmtree(folder.path / "origin")
    with pytest.raises(RunFolderError, match="parent"):
        begin(folder, folder.record(), TASK, SMALL)


def test_a_run_of_format_1_can_be_branched_from(tmp_path: Path) -> None:
    shutil.copytree(Path(__file__).parents[1] / "data" / "format_1" / "reacher-morph", tmp_path / "old")
    old = History(RunFolder(tmp_path / "old"))
    origin: Origin = origin_at(old)
    assert (origin.checkpoint, origin.record.format) == (4, 1)
    assert origin.in_force.phi.tolist() == old.phi.tolist()


# --- replay -----------------------------------------------------------------------------------------------------------


def outcome(history: History, last: int | None = None) -> tuple[Comparison, list[int]]:
    *steps, found = compare(history, history.iteration if last is None else last)
    assert isinstance(found, Comparison)
    return found, [step["iteration"] for step in steps if isinstance(step, dict)]


@pytest.fixture(scope="module")
def steered_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run that was steered at its beginning and after its second iteration, stopped there and resumed."""
    folder = make_run(tmp_path_factory.mktemp("steered"), "steered", iterations=2)
    folder.send(SetAlpha(3.0))
    Trainer(folder).run()
    folder.send(InjectDesign([2.0] * 5))
    folder.send(Lock("link_5"))
    Trainer(folder, further=3).run()
    return folder


@pytest.fixture
def steered(steered_run: RunFolder) -> History:
    """The history of that run, of which a test may change what is in memory."""
    return History(steered_run)


def test_a_replay_obeys_the_log_and_finds_the_same_phi(steered: History) -> None:
    before = {path: path.stat().st_mtime_ns for path in steered.folder.path.rglob("*")}
    found, steps = outcome(steered)
    assert (found.difference, found.compared, steps) == (None, 5, [1, 2, 3, 4, 5])
    assert found.recorded_on == [found.replayed_on]
    assert {path: path.stat().st_mtime_ns for path in steered.folder.path.rglob("*")} == before
    assert outcome(steered, 2)[1] == [1, 2]


@pytest.mark.parametrize("iteration", [1, 4])
def test_the_first_difference_is_reported_to_the_last_bit(steered: History, iteration: int) -> None:
    right = steered.progress[iteration - 1]
    wrong = [np.nextafter(right.phi[0], 9.0), *right.phi[1:]]
    steered.progress[iteration - 1] = msgspec.structs.replace(right, phi=wrong)
    found, steps = outcome(steered)
    assert found.difference == Difference(iteration, wrong, right.phi)
    assert steps == list(range(1, iteration))


def test_a_replay_without_a_command_of_the_log_differs_from_there(steered: History) -> None:
    steered._changes = [e for e in steered._changes if getattr(e, "command", None) != InjectDesign([2.0] * 5)]
    found, _ = outcome(steered)
    assert found.difference
    assert found.difference.iteration == 3


def test_a_branch_is_replayed_from_what_it_took_along(parent: History) -> None:
    folder = branch(parent, 2)
    Trainer(folder).run()
    found, steps = outcome(History(folder))
    assert (found.difference, steps) == (None, [3, 4, 5, 6])


def test_what_a_resume_voided_is_not_replayed(parent: History) -> None:
    shutil.rmtree(parent.folder.checkpoint(6))
    parent.folder.send(SetAlpha(5.0))
    Trainer(parent.folder, until=8).run()
    found, steps = outcome(History(parent.folder))
    assert (found.difference, steps) == (None, [1, 2, 3, 4, 5, 6, 7, 8])


def test_a_run_without_an_iteration_has_nothing_to_compare(tmp_path: Path) -> None:
    found, steps = outcome(History(make_run(tmp_path)))
    assert (found.difference, found.compared, steps) == (None, 0, [])


def test_processors_are_named_each_once(steered: History) -> None:
    start = next(e for e in steered.events if isinstance(e, StateChanged) and e.status == "starting")
    steered.events.append(msgspec.structs.replace(start, processor="another one"))
    found, _ = outcome(steered, 1)
    assert [p.name for p in found.recorded_on] == [start.processor, "another one"]
