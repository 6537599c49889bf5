"""The viewer on a real viser server, driven through `show`, by its handles, and by a browser's raw messages."""

import math
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import psutil
import pytest
import viser
from conftest import NAME, Page, design_of, eventually, make_hand_run, make_run
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from morph_core.catalogue import make_task
from morph_core.protocol import (
    Acknowledged,
    AnyEvent,
    DesignSpaceChanged,
    Evaluation,
    Heartbeat,
    InjectDesign,
    Lock,
    Pause,
    Progress,
    Resume,
    SetAlpha,
    SetBound,
    SetProjection,
    StateChanged,
    StepIteration,
    Stop,
    Unlock,
)
from morph_core.run_folder import EventLog, HeartbeatFile, RunFolder, write_episode
from studio.new_run import StartRun, prepare_run
from studio.viewer.take import Shot, make_take


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_run(tmp_path / "runs", NAME, ended="finished")


def test_the_viewer_turns_to_an_iteration_and_follows_no_longer(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    page.viewer.turn_to(2)
    take = page.take(lambda take: take.shot.phi[0] == pytest.approx(2.8))
    assert (take.shot.episode, page.viewer.timeline.follow.value) == (None, False)
    page.viewer.turn_to(999)
    assert page.viewer.timeline.shown_iteration == 3


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


def append(folder: RunFolder, *events: AnyEvent) -> None:
    log = EventLog(folder)
    for event in events:
        log.append(event)
    log.close()


def progress(iteration: int, **values: object) -> Progress:
    known = {"env_steps": 100, "phi": [2.0] * 5, "episode_return": -1.0, "success": 0.0, "policy_std": 0.5}
    return Progress(iteration=iteration, **(known | values))  # pyright: ignore[reportArgumentType]


# --- without a run ---


def test_a_page_without_runs_shows_the_initial_design_and_the_start_panel(page: Page) -> None:
    page.viewer.show({}, {}, None)
    assert page.viewer.start.folder.visible
    assert not page.viewer.tabs.visible
    assert "press Start" in page.viewer.traces.note.content
    assert not page.viewer.traces.charts
    take = page.take()
    assert set(take.robot.names) == {"base", *(f"link_{i}" for i in range(1, 6))}
    assert "goal" in take.scenery.names
    assert take.frames == 1


def test_start_asks_for_what_the_form_says_and_opens_the_run(page: Page) -> None:
    form = page.viewer.start
    form.options["reacher"]["tunnel"].value = "paper"
    form.seed.value, form.iterations.value, form.settings.alpha.value = 7, 50, 2.5
    form.settings.projection.value, form.settings.exploration.value = "one_sided", "gaussian"
    form.submit(None)
    assert page.started == [
        StartRun(
            task="reacher", preset="studio", method="morph", seed=7, iterations=50, task_options={"tunnel": "paper"},
            settings={"alpha": 2.5, "projection": "one_sided", "exploration": "gaussian"},
        )
    ]  # fmt: skip
    assert page.viewer.selected == NAME
    assert "starting" in page.viewer.run.state.content


def test_another_tunnel_is_seen_before_the_start(page: Page) -> None:
    page.take()
    page.viewer.start.options["reacher"]["tunnel"].value = "paper"
    assert len(page.take(lambda take: len(take.scenery) > 5).scenery) == 9


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("alpha", math.nan, "alpha must be finite"),
        ("alpha", -1.0, "alpha must not be negative"),
        ("seed", -1, "seed must be a whole number from 0"),
        ("iterations", 0, "iterations must be a whole number from 1"),
        ("iterations", 10**9, "iterations must be a whole number from 1 to 1000000"),
        ("projection", "sideways", "choose from: none, one_sided, as_printed"),
        ("exploration", "hope", "choose from: design, gaussian"),
        ("method", "magic", "choose from: morph"),
        ("task", "reach", "choose from:"),
    ],
)
def test_bad_start_values_start_nothing_and_say_what_is_allowed(
    page: Page, name: str, value: object, sentence: str
) -> None:
    form = page.viewer.start
    getattr(form if hasattr(form, name) else form.settings, name)._impl.value = value
    page.viewer.start.submit(None)
    assert not page.started
    assert page.viewer.selected is None
    assert sentence in page.viewer.start.notice.content.replace("&quot;", '"')


def test_a_refused_start_leaves_the_start_panel(page: Page) -> None:
    page.refusal = "two runs are running already"
    page.viewer.start.submit(None)
    assert "two runs are running already" in page.viewer.start.notice.content
    assert page.viewer.selected is None
    assert not page.viewer.start.start.disabled


# --- a run ---


def test_a_run_is_shown_with_its_numbers_charts_and_episode(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    assert "iteration <b>3</b> of 100" in page.viewer.run.state.content
    assert "50 %" in page.viewer.run.numbers.content
    take = page.take(lambda take: take.frames > 1)
    assert take.duration == pytest.approx(0.3)
    assert take.ghost is not None
    np.testing.assert_allclose(take.robot.sizes[1:, 2], 1.35)
    np.testing.assert_allclose(take.ghost.sizes[1:, 2], 1.5)


def test_charts_are_never_given_empty_arrays_and_wait_for_their_first_value(page: Page, tmp_path: Path) -> None:
    folder = make_run(tmp_path / "new", NAME, ended=None)
    page.show(folder)
    assert set(page.viewer.traces.charts) == {"Design φ"}
    for event in (
        StateChanged(status="starting", iteration=0),
        progress(1),
        progress(2, cosine=-0.5, cosine_negative=0.75, divergence=0.3),
        progress(3, cosine=0.5, cosine_negative=0.25, divergence=0.0, search_cost=0.1),
    ):
        append(folder, event)
        page.show(folder)
        for chart in page.viewer.traces.charts.values():
            assert len({len(column) for column in chart.data}) == 1
            assert len(chart.data[0]) >= 2
    assert "Success on Hw-Phy" not in page.viewer.traces.charts
    links = page.viewer.traces.charts["Design φ"]
    assert eventually(
        lambda: page.show(folder) and links.data[1].tolist() == [3, 2, 2, 2, 2, 2, 2]
    )  # charts rest between
    cosines = page.viewer.traces.charts["Agreement of g_task and g_hw"]
    marked = [[2, 3, 3, 3, 3], [-0.5, *[0.5] * 4], [0.75, *[0.25] * 4], [-1, -1, 2, -1, -1]]
    np.testing.assert_allclose(cosines.data, marked)
    assert "Agreement by design parameter" not in page.viewer.traces.charts  # not defined so far
    append(folder, progress(4, cosine_by_parameter=[-0.5, None, 0.5, 1.0, -1.0]), progress(5))
    assert eventually(lambda: page.show(folder) and "Agreement by design parameter" in page.viewer.traces.charts)
    shares = page.viewer.traces.charts["Agreement by design parameter"].data
    assert shares[1][0] == -0.5
    assert np.isnan(shares[2]).all()
    distances = page.viewer.traces.charts["Proxy against Hw-Phy: mean squared distance"].data
    assert np.isnan(distances[1][1])  # no zero on a logarithmic axis


def test_charts_go_when_a_run_without_their_values_is_opened(page: Page, folder: RunFolder, tmp_path: Path) -> None:
    page.show(folder)
    chart = page.viewer.traces.charts["Success on Hw-Phy"]
    assert chart.visible
    page.show(make_run(tmp_path / "other", "20260202-000000-reacher-morph-s1", ended=None))
    assert not chart.visible
    page.show(folder)
    page.viewer.select(None)
    assert not any(chart.visible for chart in page.viewer.traces.charts.values())


def test_a_failed_run_says_why_in_html_that_harms_nobody(page: Page, folder: RunFolder) -> None:
    page.show(folder, "failed", "loss is NaN <img src=x onerror=alert(1)>")
    failure = page.viewer.run.failure
    assert failure.visible
    assert "failed: loss is NaN &lt;img" in failure.content
    assert "<img" not in failure.content + page.viewer.run.state.content


def test_an_unreadable_run_says_why(page: Page) -> None:
    page.viewer.show({}, {"foreign": ("unreadable", "run.json can't be read")}, "foreign")
    assert "unreadable: run.json can&#x27;t be read" in page.viewer.run.failure.content
    assert not page.viewer.run.pause.visible


def test_a_rollout_that_is_damaged_is_reported_and_the_next_design_is_shown(page: Page, folder: RunFolder) -> None:
    folder.episode(3).write_bytes(b"no zip at all")
    page.show(folder)
    assert eventually(lambda: "can&#x27;t be shown" in page.viewer.notice.content)
    page.viewer.timeline.follow.value = False
    page.viewer.timeline.iteration.value = 2
    page.show(folder)
    np.testing.assert_allclose(page.take(lambda take: take.shot.phi[0] == 2.8).robot.sizes[1:, 2], 1.4)


# --- choosing ---


def test_what_the_studio_suggests_is_opened_once_and_a_choice_then_stays(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    assert page.viewer.selected == NAME
    page.viewer.open(None)
    page.show(folder)
    assert page.viewer.selected is None
    assert page.viewer.start.folder.visible
    page.viewer.open(NAME)
    assert page.viewer.selected == NAME


def test_an_unknown_run_is_said_to_be_unknown(page: Page, folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    page.show(folder)
    monkeypatch.setattr("studio.viewer.viewer._START_PATIENCE", -1.0)
    page.viewer.open("../../<etc>")
    assert "../../&lt;etc&gt; has not shown up" in page.viewer.run.failure.content
    assert not page.viewer.run.pause.visible


# --- steering ---


def test_buttons_follow_the_status(page: Page, folder: RunFolder) -> None:
    run = page.viewer.run
    for status, pause, resume, more in (
        ("running", True, False, True),
        ("paused", False, True, True),
        ("pausing", True, True, True),
        ("finished", False, False, False),
        ("failed", False, True, False),
        ("lost", False, True, False),
        ("stopped", False, True, False),
        ("queued", False, False, True),  # Stop takes it out of the queue
    ):
        page.show(folder, status)  # pyright: ignore[reportArgumentType]
        assert (run.pause.visible, run.resume.visible, run.more.visible) == (pause, resume, more), status


def test_another_kind_of_processor_is_said_on_the_panel(page: Page, folder: RunFolder) -> None:
    log = EventLog(folder)
    for model in ("EPYC", "<Xeon>"):
        assert "begun on" not in page.viewer.run.state.content
        log.append(StateChanged(status="starting", iteration=3, processor=model, instruction_set="AVX2"))
        page.show(folder, "running")
    assert "begun on EPYC, AVX2, went on from iteration 3 on &lt;Xeon&gt;, AVX2" in page.viewer.run.state.content


def test_a_run_with_a_budget_shows_how_much_of_it_is_spent(page: Page, tmp_path: Path) -> None:
    folder = prepare_run(tmp_path, StartRun(task="reacher", iterations=9000, env_steps=800_000))
    page.show(folder, "queued")
    assert "iteration <b>0</b></div>" in page.viewer.run.state.content, "nobody knows yet of how many"
    me = psutil.Process()
    HeartbeatFile(folder).write(
        Heartbeat(platform.node(), me.pid, me.create_time(), time.time(), "running", "learning", 3, 12)
    )
    log = EventLog(folder)
    log.append(StateChanged(status="running", iteration=0))
    log.append(
        Progress(
            iteration=3, env_steps=200_000, phi=[1.0] * 5, episode_return=0, success=0, policy_std=1,
            relabelled_steps=1024, search_steps=2048,
        )
    )  # fmt: skip
    page.show(folder, "running")
    assert "iteration <b>3</b> of about 12" in page.viewer.run.state.content
    assert page.viewer.run.bar.value == 25.0
    for shown in ("200.0 k of 800.0 k", "steps for relabelling", "1.0 k", "steps for the search", "2.0 k"):
        assert shown in page.viewer.run.numbers.content
    page.show(folder, "finished")
    assert "about" not in page.viewer.run.state.content


def test_resume_orders_a_waiting_trainer_and_restarts_a_gone_one(page: Page, folder: RunFolder) -> None:
    page.show(folder, "paused")
    page.viewer.run.go_on(None)
    assert page.commands == [(NAME, Resume())]
    for status in ("stopped", "failed", "lost"):
        page.show(folder, status)  # pyright: ignore[reportArgumentType]
        page.viewer.run.go_on(None)
    assert page.resumed == [NAME] * 3
    assert len(page.commands) == 1


def test_step_stop_and_hotkeys_send_their_commands(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    page.viewer.run.ask("Step", None)
    page.viewer.run.ask("Stop", None)
    page.viewer.run.ask("<no such button>", None)
    page.viewer.run.toggle(None)
    assert [command for _, command in page.commands] == [StepIteration(), Stop(), Pause()]
    hotkeys = {command.hotkey for command in page.server.gui._command_handle_from_uuid.values()}
    assert {"P", "K", "L", "space"} <= hotkeys


def test_steering_sends_only_what_was_changed(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    steer = page.viewer.steer
    steer.form.submit()
    assert page.commands == []
    steer.alpha.value = 2.0
    steer.form.submit()
    steer.alpha.value = 1.0
    steer.projection.value = "one_sided"
    steer.form.submit()
    assert [c for _, c in page.commands] == [SetAlpha(2.0), SetProjection("one_sided")]


@pytest.mark.parametrize(
    ("name", "value"), [("alpha", math.nan), ("alpha", math.inf), ("alpha", -0.1), ("projection", "sideways")]
)
def test_bad_steering_values_send_nothing(page: Page, folder: RunFolder, name: str, value: object) -> None:
    page.show(folder, "running")
    getattr(page.viewer.steer, name)._impl.value = value
    page.viewer.steer.form.submit()
    assert page.commands == []
    assert name in page.viewer.notice.content


def test_alpha_that_was_accepted_is_in_force_before_the_next_iteration(page: Page, folder: RunFolder) -> None:
    page.show(folder, "paused")
    append(folder, Acknowledged(id=1, iteration=3, accepted=True, command=SetAlpha(4.0)))
    page.show(folder, "paused")
    assert page.viewer.steer.alpha.value == 4.0


def test_what_somebody_types_into_the_steering_form_stays_until_something_changes(
    page: Page, folder: RunFolder
) -> None:
    page.show(folder, "paused")
    page.viewer.steer.alpha.value = 7.0
    page.show(folder, "paused")
    assert page.viewer.steer.alpha.value == 7.0
    append(folder, Acknowledged(id=1, iteration=3, accepted=True, command=SetProjection("one_sided")))
    page.show(folder, "paused")
    assert (page.viewer.steer.alpha.value, page.viewer.steer.projection.value) == (1.0, "one_sided")


def test_the_design_form_sends_bounds_and_locks_together(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    rows = page.viewer.design.rows
    rows["link_2"].bounds.value = (0.5, 3.0)
    rows["link_3"].locked.value = True
    rows["link_3"].value.value = 1.5
    _submit_design(page)
    assert [c for _, c in page.commands] == [SetBound("link_2", 0.5, 3.0), Lock("link_3", 1.5)]


def test_a_lock_is_shown_and_undone(page: Page, folder: RunFolder) -> None:
    history = page.show(folder, "running")
    space = history.design_space.with_lock("link_3", 1.5)
    append(folder, DesignSpaceChanged(iteration=3, parameters=list(space.parameters)))
    page.show(folder, "running")
    row = page.viewer.design.rows["link_3"]
    assert row.locked.value
    assert row.value.value == 1.5
    assert "locked" in str(row.folder.label)
    row.locked.value = False
    _submit_design(page)
    assert page.commands == [(NAME, Unlock("link_3"))]


@pytest.mark.parametrize(
    ("bounds", "lock", "sentence"),
    [
        ((3.0, 2.0), None, "lower bound of link_1 must be below the upper one"),
        ((math.nan, 2.0), None, "bounds of link_1 must be finite"),
        ((0.5, math.inf), None, "bounds of link_1 must be finite"),
        ((0.0, 9.0), None, "must lie inside [0.05, 5] m"),
        (None, 9.0, "link_1 must lie inside"),
        (None, math.nan, "link_1 must be finite"),
    ],
)
def test_bad_design_values_send_nothing_not_even_the_good_ones(
    page: Page, folder: RunFolder, bounds: tuple[float, float] | None, lock: float | None, sentence: str
) -> None:
    page.show(folder, "running")
    rows = page.viewer.design.rows
    rows["link_2"].bounds.value = (0.5, 3.0)
    if bounds is not None:
        rows["link_1"].bounds._impl.value = bounds
    if lock is not None:
        rows["link_1"].locked.value = True
        rows["link_1"].value._impl.value = lock
    _submit_design(page)
    assert page.commands == []
    assert sentence in page.viewer.notice.content


def test_what_somebody_edits_survives_the_next_update(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    page.viewer.design.rows["link_2"].bounds.value = (0.5, 3.0)
    append(folder, progress(4))
    page.show(folder, "running")
    assert page.viewer.design.rows["link_2"].bounds.value == (0.5, 3.0)
    assert str(page.viewer.design.rows["link_2"].folder.label).startswith("link_2: 2.000 m")


def test_a_refused_command_is_told_and_changes_nothing(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    page.refusal = "the inbox is full"
    page.viewer.run.toggle(None)
    assert "the inbox is full" in page.viewer.notice.content
    assert "asked" not in page.viewer.run.log.content


def test_each_command_is_acknowledged_with_its_iteration(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    page.viewer.design.rows["link_2"].bounds.value = (0.5, 3.0)
    _submit_design(page)
    assert "bound of link_2 set to [0.5, 3] m: asked" in page.viewer.run.log.content
    append(
        folder,
        Acknowledged(id=1, iteration=42, accepted=True, command=SetBound("link_2", 0.5, 3.0)),
        Acknowledged(id=2, iteration=42, accepted=False, command=Lock("link_9"), message="unknown <b>link_9"),
    )
    page.show(folder, "running")
    log = page.viewer.run.log.content
    assert "bound of link_2 set to [0.5, 3] m, in force from iteration 43" in log
    assert "refused: unknown &lt;b&gt;link_9" in log
    assert "asked" not in log


def _submit_design(page: Page) -> None:
    form = page.viewer.design._form
    assert form is not None
    form.submit()


# --- playback ---


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
    assert take.frames == 13
    assert lit[0] == lit[5] == set()
    assert lit[6] == {"wall_upper_1"}
    assert lit[-1] == {"goal", "wall_upper_1"}
    np.testing.assert_allclose(take.contact[6], [[2.4, 4.7, 0.0]])
    assert np.isnan(take.contact[5]).all()


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


def test_an_iteration_without_an_episode_stands_and_says_so(page: Page, episode: RunFolder) -> None:
    page.show(episode)
    page.viewer.timeline.follow.value = False
    page.viewer.timeline.iteration.value = 1
    page.viewer.looks.trail.value = True
    page.show(episode)
    take = page.take(lambda take: take.shot.phi == (2.9,) * 5)
    assert take.frames == 1
    assert "no episode was recorded (the nearest one is of iteration 3)" in page.viewer.timeline.what.content


def test_continue_from_this_design_injects_it(page: Page, episode: RunFolder) -> None:
    page.show(episode, "running")
    page.viewer.timeline._jump("first")
    page.show(episode, "running")
    assert page.viewer.timeline.inject.visible
    page.viewer._inject(page.viewer.timeline._chosen_phi, None)
    assert page.commands == [(NAME, InjectDesign([2.7] * 5))]


def test_playback_pauses_seeks_and_loops(
    page: Page, episode: RunFolder, wire: Callable[[viser.GuiInputHandle, object], None]
) -> None:
    page.show(episode)
    page.take(lambda take: take.frames == 13)
    playback, player = page.viewer.playback, page.viewer.player
    assert eventually(lambda: playback.time.value > 0)  # it plays while somebody watches
    wire(playback.time, 0.19)  # not the 0.2 s of the first report: viser passes on changes only
    assert eventually(lambda: not player.playing)
    assert eventually(lambda: player._robot._instant == 6)
    assert playback.play.label == "Play"
    assert player._contact.node_names == ["/contact/sphere"]


def test_values_from_the_wire_beyond_their_slider_are_refused(
    page: Page, episode: RunFolder, wire: Callable[[viser.GuiInputHandle, object], None]
) -> None:
    page.show(episode)
    page.take(lambda take: take.frames == 13)
    timeline, playback = page.viewer.timeline, page.viewer.playback
    wire(playback.speed, 99.0)
    assert eventually(lambda: "speed must lie inside [0.1, 4]" in page.viewer.notice.content)
    assert playback.speed.value == 1.0
    wire(timeline.iteration, 4000)
    assert eventually(lambda: "there is no iteration 4000; choose 0 to 4" in page.viewer.notice.content)
    assert timeline.shown_iteration == 4
    wire(playback.time, math.nan)
    assert eventually(lambda: "time must lie inside" in page.viewer.notice.content)
    assert page.viewer.player.take is not None
    assert page.commands == []


# --- export ---


def test_the_chosen_design_is_exported_in_the_chosen_formats(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    export = page.viewer.export
    assert not export.download.visible
    for which in ("best", "latest"):
        export.design.value = which
        export.submit()
    export.design.value, export.iteration.value = "iteration", 2
    assert export.iteration.visible
    for name in ("mjcf", "3mf", "glb"):
        export.formats[name].value = False
    export.submit()
    everything = ["mjcf", "urdf", "stl", "3mf", "glb"]
    assert page.exported == [
        (NAME, "best", everything), (NAME, "latest", everything), (NAME, "2", ["urdf", "stl"]),
    ]  # fmt: skip
    assert not export.notice.visible


def test_a_servo_is_chosen_where_the_robot_takes_servos(page: Page, folder: RunFolder, tmp_path: Path) -> None:
    export, hand = page.viewer.export, make_hand_run(tmp_path / "hands", "pen_press")
    page.show(folder)
    assert not export.servo.visible
    page.show(hand)
    assert export.servo.visible
    export.submit()
    export.servo.value = "XM430-W350"
    assert not export.download.visible  # it was prepared without one
    export.submit()
    assert page.servos == ["XM430-W350"]


def test_a_printer_is_asked_for_only_by_who_prints_on_another(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    export = page.viewer.export
    for word in ("prusa_xl", " 300x300x400 ", "", "256x256x256"):
        export.printer.value = word
        export.submit()
    export.printer.value, export.formats["3mf"].value = "prusa_xl", False
    export.submit()
    assert page.printers == ["prusa_xl", "300x300x400", None, None, None]


def test_what_was_compared_is_shown_and_a_change_of_mind_takes_it_away(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    export = page.viewer.export
    export.submit()
    assert "1 comparisons agree" in export.result.content
    assert "mjcf" in export.result.content
    assert "0 kB" in export.download.label
    assert export.download.visible
    export.formats["stl"].value = False
    assert not export.download.visible
    assert not export.result.visible


def test_a_design_that_is_brought_along_is_injected(page: Page, folder: RunFolder) -> None:
    history = page.show(folder)
    design = design_of(history, [1.0, 2.0, 3.0, 2.0, 1.0])
    page.viewer._import(msgspec.json.encode(design), None)
    assert page.commands == [(NAME, InjectDesign([1.0, 2.0, 3.0, 2.0, 1.0]))]
    page.viewer._import(msgspec.json.encode(msgspec.structs.replace(design, task="pen_press")), None)
    assert "design for pen_press, not for reacher" in page.viewer.notice.content
    page.viewer._import(b"<mujoco/>", None)
    assert "no design.json" in page.viewer.notice.content
    assert len(page.commands) == 1


@pytest.mark.parametrize(("which", "iteration"), [("iteration", 99), ("iteration", -1), ("finest", 0)])
def test_a_design_that_is_not_there_is_not_exported(page: Page, folder: RunFolder, which: str, iteration: int) -> None:
    page.show(folder)
    page.viewer.export.design._impl.value = which
    page.viewer.export.iteration.value = iteration
    page.viewer.export.submit()
    assert page.exported == []
    assert "choose" in page.viewer.export.notice.content


def test_an_export_that_is_refused_says_why(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    page.refusal = "the files don't agree"
    page.viewer.export.submit()
    assert "the files don&#x27;t agree" in page.viewer.export.notice.content
    assert not page.viewer.export.check.disabled
    assert not page.viewer.export.download.visible
