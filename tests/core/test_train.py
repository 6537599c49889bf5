"""The trainer as a real process: commands, kill and resume, a second trainer, a full disk."""

import json
import os
import resource
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from morph_core import protocol
from morph_core.catalogue import make_method, make_task
from morph_core.checkpoint import load_newest
from morph_core.history import History
from morph_core.protocol import Acknowledged, AnyCommand, AnyEvent, StateChanged
from morph_core.run_folder import EventLog, RunFolder, read_episode
from morph_core.searches.cma import Cma
from morph_core.state import start
from morph_core.train import SHOWN_DESIGNS, Trainer, _keep_beating, apply_edit, train
from tests.core.conftest import SMALL, make_run, small_method
from tests.forked import Forked, trainer


def trained(folder: RunFolder, *words: str) -> History:
    process = trainer(folder, *words)
    assert process.wait() == 0, process.said("errors")
    return History(folder)


def beats_of(folder: RunFolder) -> int | None:
    """Return which process wrote the heartbeat; None as long as there is none."""
    beat = folder.heartbeat()
    return beat.pid if beat else None


def wait_for(history: History, claim: Callable[[], bool], seconds: float = 60) -> None:
    limit = time.monotonic() + seconds
    while not claim():
        assert time.monotonic() < limit, f"waited {seconds} s; {history.status} {history.message}"
        time.sleep(0.02)
        history.poll()


def test_a_run_ends_finished_with_evaluations_rollouts_and_checkpoints(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    history = trained(folder)
    assert history.status == "finished"
    assert [p.iteration for p in history.progress] == [1, 2, 3, 4, 5, 6]
    assert [e.iteration for e in history.evaluations] == [2, 4, 6]
    assert folder.checkpoint_iterations() == [2, 4, 6]
    episode = read_episode(folder, 6)
    steps = len(episode["action"])
    assert episode["qpos"].shape == (steps + 1, 5)
    assert episode["contact"].shape == (steps, 1, 3)
    for evaluation in history.evaluations:
        assert [r.which for r in evaluation.recorded][:3] == ["median", "best", "worst"]
        for r in evaluation.recorded:
            rewards = read_episode(folder, evaluation.iteration, r.which)["reward"]
            assert rewards.sum() == pytest.approx(r.episode_return)
        assert sum(evaluation.reward_terms.values()) == pytest.approx(evaluation.sampled_return)
        assert evaluation.return_interval is not None
        low, high = evaluation.return_interval
        assert low <= evaluation.sampled_return <= high
    assert episode["population"].shape == (min(SMALL.trajectories, SHOWN_DESIGNS), 5)
    assert not [name for name in episode if name.startswith("milestones/")]
    assert [e.milestones for e in history.evaluations] == [{}] * 3
    fitted = SMALL.proxy.prefit * SMALL.proxy.prefit_pairs
    search = SMALL.search
    assert isinstance(search, Cma)
    assert episode["generation"].shape == (search.population, 5)  # what the last generation of CMA-ES tried
    assert np.ptp(episode["generation"], axis=0).min() > 0
    searched = search.pairs * (search.population * search.generations + 2)  # start and find, again
    assert [p.relabelled_steps for p in history.progress] == [fitted + p.env_steps for p in history.progress]
    assert [p.search_steps for p in history.progress] == [p.iteration * searched for p in history.progress]
    assert np.allclose(sum(episode[k] for k in episode if k.startswith("reward_terms/")), episode["reward"])
    assert episode["phi"].tolist() == history.phi.tolist()
    assert [e.seq for e in history.events] == list(range(1, len(history.events) + 1))


def test_a_budget_ends_a_run_after_the_iteration_that_reaches_it(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=1000, env_steps=1300, final_episodes=10)
    Trainer(folder).run()
    history = History(folder)
    *before, last = history.progress
    assert before[-1].env_steps < 1300 <= last.env_steps
    assert history.status == "finished"
    assert history.message == f"the budget of 1,300 environment steps is spent after iteration {last.iteration}"
    assert history.planned_iterations == last.iteration
    regular, final = history.evaluations[-2:]
    assert (regular.iteration, regular.episodes, regular.final) == (last.iteration, 4, False)
    assert (final.iteration, final.episodes, final.final, final.episode) == (last.iteration, 10, True, None)
    assert folder.checkpoint_iterations()[-1] == last.iteration
    assert [e.final for e in history.evaluations].count(True) == 1


def test_a_run_without_a_budget_has_no_evaluation_at_its_end(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=2)
    Trainer(folder).run()
    assert [(e.iteration, e.final) for e in History(folder).evaluations] == [(2, False)]


def test_what_the_end_of_a_run_misses_is_done_when_it_is_taken_up_again_and_nothing_twice(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=1000, env_steps=900, final_episodes=6)
    Trainer(folder).run()
    (whole,) = [e for e in History(folder).evaluations if e.final]
    lines = folder.events.read_bytes().splitlines(keepends=True)
    folder.events.write_bytes(b"".join(lines[:-2]))  # killed before the evaluation at the end
    for _ in range(2):
        Trainer(folder).run()
        history = History(folder)
        (again,) = [e for e in history.evaluations if e.final]
        assert history.status == "finished"
        assert (again.iteration, again.sampled_return, again.deterministic_return) == (
            whole.iteration, whole.sampled_return, whole.deterministic_return
        )  # fmt: skip


def test_further_iterations_go_beyond_the_budget(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=1000, env_steps=900, final_episodes=6)
    Trainer(folder).run()
    done = History(folder).iteration
    Trainer(folder, further=2).run()
    history = History(folder)
    assert history.iteration == done + 2
    assert [e.iteration for e in history.evaluations if e.final] == [done, done + 2]


def test_the_end_that_a_budget_sets_is_foreseen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = make_run(tmp_path, iterations=1000, env_steps=4000)
    beats: list[protocol.Heartbeat] = []
    monkeypatch.setattr("morph_core.train.HeartbeatFile.write", lambda _, beat: beats.append(beat))
    Trainer(folder).run()
    ended = History(folder).iteration
    loaded = [beat for beat in beats if beat.stage != "loading"]
    assert all(abs(beat.iterations - ended) <= 2 for beat in loaded)
    assert loaded[-1].iterations == loaded[-1].iteration == ended
    etas = [beat.eta_seconds for beat in loaded if beat.eta_seconds is not None]
    assert etas[0] > 0
    assert etas[-1] == 0


def test_how_often_a_run_is_evaluated_does_not_change_what_is_learnt(tmp_path: Path) -> None:
    often, seldom = (
        trained(
            make_run(
                tmp_path, f"every-{interval}", small_method("morph", {"evaluation.interval": interval}), iterations=3
            )
        )
        for interval in (1, 3)
    )
    assert (len(often.evaluations), len(seldom.evaluations)) == (3, 1)
    assert [p.phi for p in often.progress] == [p.phi for p in seldom.progress]


def test_commands_are_acknowledged_with_their_iteration_and_kept_over_a_kill(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=10**6)
    folder.send(protocol.Pause())
    process = trainer(folder)
    history = History(folder)
    wait_for(history, lambda: history.status == "paused")
    sent: list[tuple[AnyCommand, bool]] = [
        (protocol.SetAlpha(3.5), True), (protocol.SetAlpha(-1.0), False), (protocol.SetProjection("one_sided"), True),
        (protocol.SetBound("link_1", 1.0, 2.0), True), (protocol.SetBound("link_1", 4.0, 2.0), False),
        (protocol.SetBound("link_9", 1.0, 2.0), False), (protocol.Lock("link_2", 1.25), True),
        (protocol.Lock("link_3", 99.0), False), (protocol.InjectDesign([0.5] * 5), False),
        (protocol.InjectDesign([1.5] * 5), False),  # against the lock of link_2
        (protocol.InjectDesign([1.5, 1.25, 1.0, 1.0, 1.0]), True), (protocol.StepIteration(), True),
    ]  # fmt: skip
    ids = [folder.send(command) for command, _ in sent]
    wait_for(history, lambda: len(history.acknowledged) == len(sent) + 1)
    wait_for(history, lambda: history.iteration == 1 and history.status == "paused")
    answers = history.acknowledged[1:]
    assert [(a.id, a.command, a.accepted) for a in answers] == [
        (i, command, accepted) for i, (command, accepted) in zip(ids, sent, strict=True)
    ]
    assert all(a.iteration == 0 and a.message for a in answers)
    assert answers[9].message == "link_2 is locked at 1.25 m, not 1.5: unlock it first"
    assert history.design_space.parameters[1].locked_at == 1.25
    first = history.progress[0]
    assert (first.alpha, first.projection, first.phi[1]) == (3.5, "one_sided", 1.25)
    assert 1.0 <= first.phi[0] <= 2.0
    process.send_signal(signal.SIGKILL)
    process.wait()

    process = trainer(folder)
    wait_for(history, lambda: beats_of(folder) == process.pid and history.status == "paused")
    assert history.iteration == 1
    folder.send(protocol.Resume())
    wait_for(history, lambda: history.iteration >= 3)
    folder.send(protocol.Stop())
    assert process.wait(30) == 0
    history.poll()
    assert history.status == "stopped"
    assert (history.progress[-1].alpha, history.progress[-1].projection) == (3.5, "one_sided")
    assert history.phi[1] == 1.25
    assert History(folder).design_space.parameters[0].hi == 2.0


@pytest.mark.slow
def test_a_paused_run_that_a_cluster_ends_comes_back_paused_until_a_user_lets_it_go_on(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=4)
    folder.send(protocol.StepIteration())
    history = History(folder)
    for _ in range(2):
        process = trainer(folder)
        wait_for(history, lambda: beats_of(folder) == process.pid and history.status == "paused")  # noqa: B023
        process.send_signal(signal.SIGTERM)  # preempted, or the time limit: nobody has said Stop
        assert process.wait(30) == 0
        history.poll()
        assert (history.status, history.iteration) == ("stopped", 1)
    folder.send(protocol.Resume())
    assert trained(folder).status == "finished"


@pytest.mark.parametrize(
    ("commands", "paused"),
    [
        ([], False), ([protocol.Pause()], True), ([protocol.StepIteration()], True),
        ([protocol.Pause(), protocol.SetAlpha(2.0), protocol.Checkpoint()], True),
        ([protocol.Pause(), protocol.Resume()], False), ([protocol.Resume(), protocol.Pause()], True),
        ([protocol.Pause(), protocol.Stop()], False),
    ],
)  # fmt: skip
def test_a_pause_holds_until_the_run_is_resumed_or_stopped(
    tmp_path: Path, commands: list[AnyCommand], paused: bool
) -> None:
    folder = make_run(tmp_path)
    log = EventLog(folder)
    for number, command in enumerate(commands):
        log.append(Acknowledged(id=number, iteration=0, accepted=True, command=command, message=""))
    log.close()
    assert History(folder).paused_by_user == paused


def test_a_steered_run_can_be_replayed_from_its_log(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=10**6)
    process = trainer(folder)
    history = History(folder)
    edits = (protocol.SetAlpha(4.0), protocol.Lock("link_5"), protocol.SetBound("link_1", 0.5, 2.0), protocol.Stop())
    for number, edit in enumerate(edits, 1):
        folder.send(edit)
        wait_for(history, lambda number=number: len(history.acknowledged) == number)
    assert process.wait(30) == 0
    history.poll()

    task = make_task("reacher")
    state = start(task, SMALL, history.record.seed)
    replayed, method = [], SMALL.iterations(task, state)
    for recorded in history.progress:
        for answer in history.acknowledged:
            if answer.iteration == recorded.iteration - 1 and not isinstance(answer.command, protocol.Stop):
                apply_edit(answer.command, state, task)
        replayed.append(next(method).phi)
    assert replayed == [p.phi for p in history.progress]
    assert replayed[-1][0] <= 2.0


def test_a_signal_stops_cleanly_and_leaves_a_resumable_run(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=10**6)
    process = trainer(folder)
    history = History(folder)
    wait_for(history, lambda: history.iteration >= 1)
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 0
    history.poll()
    assert history.status == "stopped"
    assert folder.checkpoint_iterations()[-1] == history.iteration


def test_the_warnings_of_a_cluster_do_not_end_a_trainer(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=10**6)
    process = trainer(folder)
    history = History(folder)
    wait_for(history, lambda: history.iteration >= 1)
    for number in (signal.SIGUSR1, signal.SIGUSR2):
        process.send_signal(number)
    reached = history.iteration
    wait_for(history, lambda: history.iteration >= reached + 2)
    assert history.status == "running"
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 0


def test_the_processor_is_recorded_at_each_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, capability = make_run(tmp_path, iterations=2), torch.backends.cpu.get_cpu_capability()
    Trainer(folder).run()
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "DEFAULT")
    Trainer(folder, further=1).run()
    history = History(folder)
    first, second = (e for e in history.events if isinstance(e, StateChanged) and e.status == "starting")
    assert first.processor == second.processor != ""
    assert (first.instruction_set, second.instruction_set) == (capability, "DEFAULT")
    if capability != "DEFAULT":
        assert "went on from iteration 2 on" in history.other_processor


@pytest.mark.slow
def test_until_is_the_last_iteration_however_often_a_trainer_is_started(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=2)
    for _ in range(2):
        assert trained(folder, "--until", "5").iteration == 5
    wrong = trainer(folder, "--until", "0")
    assert wrong.wait() == 2
    assert "--until must be a whole number from 1 to 1000000000" in wrong.said("errors")


def test_what_a_trainer_says_reaches_the_disk_while_it_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer, ended, synced = Trainer(make_run(tmp_path)), threading.Event(), []
    monkeypatch.setattr("morph_core.train.HEARTBEAT_SECONDS", 0.01)
    monkeypatch.setattr(os, "fsync", lambda number: synced.append(number) or (len(synced) > 5 and ended.set()))
    _keep_beating(trainer, ended)
    assert len(set(synced)) == 2, "the events and the heartbeat"


def test_a_second_trainer_on_one_folder_is_refused(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=10**6)
    first = trainer(folder)
    history = History(folder)
    wait_for(history, lambda: history.iteration >= 1)
    second = trainer(folder)
    assert second.wait() == 2
    assert "held by another trainer" in second.said("errors")
    nowhere = trainer(RunFolder(tmp_path))
    assert nowhere.wait() == 1, "2 is for a run that will be free once its trainer has ended"
    first.send_signal(signal.SIGTERM)
    assert first.wait(30) == 0


def test_a_failure_is_said_with_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = make_run(tmp_path, iterations=1)
    monkeypatch.setattr("morph_core.train.damage_of", lambda _: "a weight became NaN")
    monkeypatch.setattr("signal.signal", lambda *_: None)
    assert train(folder) == 1
    history = History(folder)
    assert history.status == "failed"
    assert history.message == "a weight became NaN, in iteration 1"
    assert history.iteration == 0


@pytest.mark.slow
def test_a_disk_that_is_full_pauses_the_run_and_loses_nothing(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=10**6)
    process = trainer(folder)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (30_000, resource.RLIM_INFINITY))
    history = History(folder)
    wait_for(history, lambda: history.status == "paused")
    assert "disk does not take" in history.message
    told = folder.events.read_bytes()
    assert told.endswith(b"\n")
    time.sleep(1.2)
    assert folder.events.read_bytes() == told
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    reached = history.iteration
    wait_for(history, lambda: history.iteration > reached + 2)
    assert folder.events.read_bytes().startswith(told)
    assert [e.seq for e in history.events] == list(range(1, len(history.events) + 1))
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 0


def test_a_trainer_in_reserve_starts_at_a_word_and_goes_when_nobody_needs_it(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    for heard, iteration in (("", 0), (json.dumps({"run": str(folder.path), "further": None}) + "\n", 6)):
        assert Forked("morph_core.train", "--standby", heard=heard).wait() == 0
        assert History(folder).iteration == iteration


@pytest.mark.slow
def test_further_goes_beyond_a_finished_run(tmp_path: Path) -> None:
    folder = make_run(tmp_path, iterations=2)
    trained(folder)
    assert trained(folder, "--further", "3").iteration == 5
    assert trained(make_run(tmp_path, "whole", iterations=5)).phi.tolist() == History(folder).phi.tolist()


@pytest.mark.parametrize("method", ["morph", "cmaes_rl", "direct", "no_hw_opt", "transform2act", "value_gradient"])
@pytest.mark.slow
def test_killed_and_resumed_is_bitwise_the_run_that_was_not(tmp_path: Path, method: str) -> None:
    whole = trained(make_run(tmp_path, "whole", small_method(method), seed=3, iterations=12))
    folder = make_run(tmp_path, "killed", small_method(method), seed=3, iterations=12)
    history = History(folder)
    for reached in (1, 3, 6, 9):
        process = trainer(folder)
        wait_for(history, lambda reached=reached: history.iteration >= reached)
        process.send_signal(signal.SIGKILL)
        process.wait()
    trained(folder)
    history.poll()
    assert [p.iteration for p in history.progress] == list(range(1, 13))
    assert [p.phi for p in history.progress] == [p.phi for p in whole.progress]
    assert [p.episode_return for p in history.progress] == [p.episode_return for p in whole.progress]
    assert [e.sampled_return for e in history.evaluations] == [e.sampled_return for e in whole.evaluations]
    starts = [e for e in history.events if isinstance(e, StateChanged) and e.status == "starting"]
    assert len(starts) == 5


def test_edits_refuse_what_is_not_allowed_and_leave_the_state_alone() -> None:
    task = make_task("reacher")
    state = start(task, SMALL, 0)
    for command in (
        protocol.SetAlpha(float("nan")), protocol.SetBound("link_1", float("inf"), 2.0), protocol.Lock("link", 1.0),
        protocol.InjectDesign([float("nan")] * 5), protocol.InjectDesign([1.0]), protocol.InjectDesign([9.0] * 5),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"must|needed|unknown"):
            apply_edit(command, state, task)
    assert state.alpha == 1.0
    assert state.design_space == task.design_space
    assert state.phi.tolist() == [3.0] * 5


def test_the_proxy_is_fitted_afresh_only_when_phi_was_moved() -> None:
    task = make_task("reacher")
    state = start(task, SMALL, 0)
    state.fitted = True
    apply_edit(protocol.SetBound("link_1", 1.0, 4.0), state, task)
    apply_edit(protocol.Lock("link_1"), state, task)
    assert state.fitted
    apply_edit(protocol.Unlock("link_1"), state, task)
    apply_edit(protocol.SetBound("link_1", 1.0, 2.0), state, task)
    assert state.phi[0] == 2.0
    assert not state.fitted


def test_an_edit_of_the_design_lets_a_frozen_search_go_on() -> None:
    task = make_task("reacher")
    for command in (protocol.SetBound("link_1", 1.0, 4.0), protocol.Lock("link_1"), protocol.Unlock("link_2"),
                    protocol.InjectDesign([2.0] * 5)):  # fmt: skip
        state = start(task, SMALL, 0)
        state.frozen = True
        apply_edit(protocol.SetAlpha(2.0), state, task)
        assert state.frozen
        apply_edit(command, state, task)
        assert not state.frozen


@pytest.mark.parametrize(
    ("command", "saved"),
    [
        (protocol.SetAlpha(4.0), True), (protocol.SetProjection("one_sided"), True), (protocol.Lock("link_1"), True),
        (protocol.SetBound("link_1", 0.5, 2.0), True), (protocol.InjectDesign([1.0] * 5), True),
        (protocol.Checkpoint(), True), (protocol.Pause(), False), (protocol.SetAlpha(-1.0), False),
    ],
)  # fmt: skip
def test_what_is_acknowledged_is_in_a_checkpoint_before_the_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: AnyCommand, saved: bool
) -> None:
    folder, task = make_run(tmp_path), make_task("reacher")
    trainer, state = Trainer(folder), start(task, SMALL, 0)
    found = []

    def look(_: EventLog, event: AnyEvent) -> AnyEvent:
        if isinstance(event, protocol.Acknowledged):
            found.append(load_newest(folder, task, SMALL)[0])
        return event

    monkeypatch.setattr(EventLog, "append", look)
    trainer._answer(protocol.Order(1, command), state)
    [checkpoint] = found
    assert (checkpoint is not None) is saved
    if checkpoint is not None:
        loaded, _ = checkpoint
        assert (loaded.alpha, loaded.projection) == (state.alpha, state.projection)
        assert (loaded.design_space, loaded.phi.tolist()) == (state.design_space, state.phi.tolist())


def test_a_hand_is_never_moved_to_where_its_fingers_stand_in_each_other() -> None:
    task = make_task("pen_press")
    state = start(task, make_method("morph", task), 0)
    inside = state.phi.copy()
    inside[0] = np.pi / 2 - 0.1
    for command in (
        protocol.InjectDesign(inside.tolist()),
        protocol.Lock("placement_1", inside[0]),
        protocol.SetBound("placement_1", inside[0], 3.0),
    ):
        with pytest.raises(ValueError, match="fingers 1 and 2 stand 6 mm apart on the palm, 30 mm are needed"):
            apply_edit(command, state, task)
    assert state.design_space == task.design_space
    assert state.phi.tolist() == task.design_space.initial.tolist()
