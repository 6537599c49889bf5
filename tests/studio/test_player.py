"""The player and the timeline on a real viser server, worked by handles and by a browser's raw messages."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import viser
from conftest import NAME, Page, append, eventually, make_run, progress
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from morph_core.catalogue import make_task
from morph_core.protocol import Evaluation, InjectDesign
from morph_core.run_folder import RunFolder, write_episode
from studio.viewer.take import FRAMES_PER_SECOND as FRAMES
from studio.viewer.take import Shot, make_take


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_run(tmp_path / "runs", NAME, ended="finished")


@pytest.fixture
def wire(page: Page) -> Iterator[Callable[[viser.GuiInputHandle, object], None]]:
    """Return a function that sets a value as a browser does: viser checks nothing of it."""
    address = f"ws://127.0.0.1:{page.server.get_port()}"
    camera = {
        "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, 5], "fov": 1.0, "near": 0.01,
        "far": 100.0, "image_height": 600, "image_width": 800, "look_at": [0, 0, 0], "up_direction": [0, 0, 1],
    }  # fmt: skip
    with connect(address, subprotocols=["viser-v1.1.1"], max_size=None) as socket:  # pyright: ignore[reportArgumentType]
        _send(socket, camera)
        assert eventually(lambda: page.server.get_clients())
        yield lambda handle, value: _send(
            socket, {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}
        )


def _send(socket: Connection, message: dict[str, object]) -> None:
    socket.send(msgspec.msgpack.encode(message))


@pytest.fixture
def episode(folder: RunFolder) -> RunFolder:
    """A run whose newest episode touches a wall in its second step and the goal in its last one."""
    task = make_task("reacher")
    qpos = np.tile(np.array(task.reset(task.hw_phy(np.full(5, 2.0)), 1, np.random.default_rng(0))[0, :5]), (5, 1))
    contact = np.full((4, 3), np.nan)
    contact[1] = (2.4, 4.7, 0.0)
    name = write_episode(
        folder, 4,
        {"qpos": qpos, "phi": np.full(5, 2.0), "contact": contact, "success": np.array([False, False, False, True])},
    )  # fmt: skip
    numbers = dict.fromkeys(("sampled_return", "deterministic_success", "deterministic_return"), 0.0)
    append(
        folder,
        progress(4),
        Evaluation(iteration=4, env_steps=400, phi=[2.0] * 5, sampled_success=1.0, episode=name, **numbers),
    )
    return folder


def test_a_wall_lights_up_where_it_is_hit_and_the_goal_when_it_is_touched(episode: RunFolder) -> None:
    take = make_take(Shot("reacher", (), (2.0,) * 5, episode=(episode, 4)))
    names = take.scenery.names
    lit = [
        {names[i] for i in np.flatnonzero((take.scenery_colours(f) != take.scenery.colours).any(1))}
        for f in range(take.frames)
    ]
    begin = 2 * FRAMES // 10  # the second control step of 0.1 s ends
    assert take.frames == 4 * FRAMES // 10 + 1
    assert lit[0] == lit[begin - 1] == set()
    assert lit[begin] == {"wall_upper_1"}
    assert lit[-1] == {"goal", "wall_upper_1"}
    np.testing.assert_allclose(take.contact[begin], [[2.4, 4.7, 0.0]])
    assert np.isnan(take.contact[begin - 1]).all()


def test_follow_shows_the_latest_episode_and_a_choice_stays(page: Page, folder: RunFolder, episode: RunFolder) -> None:
    del folder
    page.show(episode)
    page.take(lambda take: take.shot.episode == (episode, 4))
    page.viewer.timeline._jump("first")
    page.take(lambda take: take.shot.episode == (episode, 3))
    assert not page.viewer.timeline.follow.value
    page.show(episode)
    assert page.viewer.timeline.shown_iteration == 3
    page.viewer.timeline.toggle_follow()
    page.take(lambda take: take.shot.episode == (episode, 4))


def test_an_iteration_of_which_no_episode_was_recorded_has_one_run(
    page: Page, episode: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, evaluate = threading.Event(), page.answers.evaluate
    monkeypatch.setattr(RunFolder, "checkpoint_up_to", lambda _, iteration: iteration)
    monkeypatch.setattr(page.answers, "evaluate", lambda *args: go_on.wait(60) and evaluate(*args))
    page.show(episode)
    page.viewer.turn_to(1)
    page.viewer.looks.trail.value = True
    assert page.take(lambda take: take.shot.phi == (2.9,) * 5).frames == 1
    what = page.viewer.timeline.what
    assert "in its start posture: no episode was recorded, so one is being run" in what.content
    go_on.set()
    take = page.take(lambda take: take.shot.played is not None)
    assert (take.shot.phi, take.frames > 1) == ((2.9,) * 5, True)
    assert eventually(lambda: "iteration 1, playing an episode that was run just now: none was" in what.content)
    (wish,) = page.answers.asked
    assert (wish.design, wish.phi, wish.episodes) == ("1", [2.9] * 5, 1)
    page.viewer.turn_to(3)
    page.viewer.turn_to(1)  # it is kept
    assert eventually(lambda: page.viewer.player.take and page.viewer.player.take.shot.played)
    assert len(page.answers.asked) == 1


def test_where_no_episode_can_be_run_the_body_stands_and_the_reason_is_said(page: Page, episode: RunFolder) -> None:
    page.show(episode)
    page.viewer.turn_to(1)
    what = page.viewer.timeline.what
    assert eventually(lambda: "none can be run" in what.content)
    assert "has no checkpoint up to iteration 1: no policy to evaluate; there is none at all" in what.content
    assert page.take(lambda take: take.shot.phi == (2.9,) * 5).frames == 1
    assert page.answers.asked == []


def test_no_episode_is_run_while_somebody_passes_by_follows_or_plays_the_evolution(
    page: Page, episode: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RunFolder, "checkpoint_up_to", lambda _, iteration: iteration)
    append(episode, progress(5))
    page.show(episode)
    for iteration in (1, 2, 1, 2):
        page.viewer.turn_to(iteration)
    page.viewer.timeline.toggle_follow()
    page.viewer.timeline.evolution.set_pace(1)
    page.viewer.timeline.toggle_evolution()
    time.sleep(0.6)
    assert page.viewer.timeline.evolution.playing
    assert page.answers.asked == []


def test_continue_from_this_design_injects_it(page: Page, episode: RunFolder) -> None:
    page.show(episode, "running")
    page.viewer.timeline._jump("first")
    page.show(episode, "running")
    assert page.viewer.timeline.inject.visible
    page.viewer.wishes.inject(page.viewer.timeline._chosen_phi, None)
    assert page.commands == [(NAME, InjectDesign([2.7] * 5))]


def test_playback_pauses_seeks_and_loops(
    page: Page, episode: RunFolder, wire: Callable[[viser.GuiInputHandle, object], None]
) -> None:
    page.show(episode)
    page.take(lambda take: take.shot.episode is not None)
    playback, player = page.viewer.playback, page.viewer.player
    assert eventually(lambda: playback.time.value > 0)  # it plays while somebody watches
    wire(playback.time, 0.213)  # no time that is reported: those have two decimals, and viser passes on changes only
    assert eventually(lambda: not player.playing)
    assert eventually(lambda: player._robot._instant == round(0.213 * FRAMES))
    assert playback.play.label == "Play"
    assert eventually(lambda: player._contact.node_names == ["/contact/sphere"])


def test_values_from_the_wire_beyond_their_slider_are_refused(
    page: Page, episode: RunFolder, wire: Callable[[viser.GuiInputHandle, object], None]
) -> None:
    page.show(episode)
    page.take(lambda take: take.shot.episode is not None)
    timeline, playback = page.viewer.timeline, page.viewer.playback
    wire(playback.speed, 99.0)
    assert eventually(lambda: "speed must lie inside [0.1, 4]" in page.viewer.notice.content)
    assert playback.speed.value == 1.0
    wire(timeline.iteration, 4000)
    assert eventually(lambda: "there is no iteration 4000; choose 0 to 4" in page.viewer.notice.content)
    assert timeline.shown_iteration == 4
    wire(playback.time, math.nan)
    assert eventually(lambda: "time must lie inside" in page.viewer.notice.content)
    assert eventually(lambda: not math.isnan(playback.time.value)), "what was refused does not stay on screen"
    assert page.viewer.player.take is not None
    assert page.commands == []
