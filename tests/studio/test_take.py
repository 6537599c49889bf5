"""What is to be seen of a recorded episode: robots with objects, milestones, contacts and explored designs."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import make_hand_run
from hypothesis import given
from hypothesis import strategies as st

from morph_core.catalogue import TASKS, make_task
from morph_core.run_folder import RunFolder, write_episode
from studio.cancellation import Cancellation, CancelledError
from studio.viewer.ghosts import MOST_GHOSTS, Beside, Crowd, make_crowd
from studio.viewer.legend import legend_of
from studio.viewer.scene import is_flat
from studio.viewer.take import GOAL_LIT, LIT_BY, Shot, Take, _from_their_end, _moving_contacts, make_take

HANDS = sorted(name for name in TASKS if name != "reacher")
STEPS, FACTOR = 4, 6
"""Control steps of the episode below, and frames for each."""


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_hand_run(tmp_path / "runs", "pen_press")


def episode_of(task: str, **arrays: np.ndarray) -> dict[str, np.ndarray]:
    """Return an episode in which nothing moves and nothing is touched, but for `arrays`."""
    made = make_task(task)
    phi = made.design_space.initial
    s = made.reset(made.hw_phy(phi), 1, np.random.default_rng(0))
    return {
        "qpos": np.repeat(made.qpos(s), STEPS + 1, 0),
        "phi": phi,
        "success": np.zeros(STEPS, bool),
        "contact": np.full((STEPS, made.fingers, 3), np.nan),  # pyright: ignore[reportAttributeAccessIssue]
        "milestones/lifted": np.zeros(STEPS, bool),
        "milestones/pressed": np.zeros(STEPS, bool),
    } | arrays


def take_of(folder: RunFolder, episode: dict[str, np.ndarray], **wanted: object) -> Take:
    write_episode(folder, 3, episode)
    phi = tuple(make_task("pen_press").design_space.initial.tolist())
    return make_take(Shot("pen_press", (), phi, episode=(folder, 3), **wanted))  # pyright: ignore[reportArgumentType]


def at(*true: int) -> np.ndarray:
    flags = np.zeros(STEPS, bool)
    flags[list(true)] = True
    return flags


@pytest.mark.parametrize("task", HANDS)
def test_hand_object_and_what_never_moves_are_told_apart(task: str) -> None:
    made = make_task(task)
    take = make_take(Shot(task, (), tuple(made.design_space.initial.tolist())))
    fingers = {f"finger_{i}_{part}" for i in range(1, TASKS[task].fingers + 1) for part in ("proximal", "distal")}
    assert set(take.robot.names) == {"palm"} | fingers
    assert set(take.scenery.names) == {"table", "goal"}
    assert "button" in take.objects.names
    assert all(name == "button" or name.startswith("object") for name in take.objects.names)
    low, high = take.box
    assert not is_flat(low, high)
    assert (high - low).max() < 1.2  # m: the hand, not the table, fills the view
    assert take.floor[0][2] == pytest.approx(0, abs=1e-6)  # lengths are written on the table


@pytest.mark.parametrize("task", sorted(TASKS))
def test_the_robot_shows_its_printed_parts_inside_its_collision_shapes(task: str) -> None:
    shot = Shot(task, (), tuple(make_task(task).design_space.initial.tolist()))
    simulated, printed = make_take(shot), make_take(dataclasses.replace(shot, printed=True))
    assert set(printed.robot.names) == {f"{name}_visual" for name in simulated.robot.names}
    assert all(kind == "mesh" for kind in printed.robot.kinds)
    low, high = simulated.robot.extent()
    for i, mesh in enumerate(printed.robot.meshes):
        assert mesh is not None
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, printed.robot.wxyz[0, i].astype(float))
        placed = printed.robot.positions[0, i] + mesh.vertices @ turn.reshape(3, 3).T
        assert (placed > low - 1e-4).all()  # m
        assert (placed < high + 1e-4).all()
    for one, other in ((simulated.objects, printed.objects), (simulated.scenery, printed.scenery)):
        assert one.names == other.names


def test_a_hand_that_cannot_be_assembled_is_shown_as_it_is_simulated() -> None:
    phi = make_task("pen_press").design_space.initial
    phi[0] = np.pi / 2  # finger 1 in finger 2
    take = make_take(Shot("pen_press", (), tuple(phi.tolist()), printed=True))
    assert "mesh" not in take.robot.kinds


def test_the_button_lights_up_while_it_is_pressed_and_the_goal_on_success(folder: RunFolder) -> None:
    pressed, success = at(1, 2), at(2)
    take = take_of(folder, episode_of("pen_press", success=success, **{"milestones/pressed": pressed}))
    assert take.frames == STEPS * FACTOR + 1
    button, goal = take.objects.names.index("button"), take.scenery.names.index("goal")
    lit = [tuple(take.object_colours(f)[button]) == LIT_BY["button"][1] for f in range(take.frames)]
    assert np.flatnonzero(lit).tolist() == list(range(2 * FACTOR, 4 * FACTOR))
    lit = [tuple(take.scenery_colours(f)[goal]) == GOAL_LIT for f in range(take.frames)]
    assert np.flatnonzero(lit).tolist() == list(range(3 * FACTOR, 4 * FACTOR))
    others = np.delete(np.arange(len(take.objects)), button)
    np.testing.assert_array_equal(take.object_colours(2 * FACTOR + 1)[others], take.objects.colours[others])


def test_every_contact_of_a_step_is_marked_where_it_is(folder: RunFolder) -> None:
    contact = np.full((STEPS, 4, 3), np.nan)
    contact[1, 0], contact[1, 2], contact[2, 2] = (0.1, 0, 0.02), (0, 0.2, 0.04), (0, 0.2, 0.10)
    take = take_of(folder, episode_of("pen_press", contact=contact))
    assert np.isnan(take.contact[: 2 * FACTOR]).all()
    np.testing.assert_allclose(take.contact[2 * FACTOR], contact[1])
    np.testing.assert_allclose(take.contact[2 * FACTOR + FACTOR // 3, 2], (0, 0.2, 0.06))  # on its way
    np.testing.assert_allclose(take.contact[3 * FACTOR, 2], (0, 0.2, 0.10))
    np.testing.assert_allclose(take.contact[4 * FACTOR, 0], (0.1, 0, 0.02))  # held for a moment
    assert not take.touched.any()


def crowd_of(folder: RunFolder, episode: dict[str, np.ndarray], **wanted: object) -> Crowd:
    write_episode(folder, 3, episode)
    beside = Beside(tried_in=(folder, 3), **wanted)  # pyright: ignore[reportArgumentType]
    return make_crowd("pen_press", "{}", beside, Cancellation())


@pytest.mark.parametrize(("name", "array"), [("explored", "population"), ("generation", "generation")])
def test_designs_that_were_tried_stand_thin_and_only_if_they_are_wanted(
    folder: RunFolder, name: str, array: str
) -> None:
    initial = make_task("pen_press").design_space.initial
    tried = initial + np.array([[0.0] * 8, [0.1] * 8, [np.nan] * 8])
    episode = episode_of("pen_press", **{array: tried})
    assert crowd_of(folder, episode) == Crowd()
    assert crowd_of(folder, episode_of("pen_press"), **{name: True}) == Crowd()
    robot = take_of(folder, episode).robot
    shown = getattr(crowd_of(folder, episode, **{name: True}), name)
    assert len(shown) == 2 * len(robot)  # the damaged one is left out
    link = robot.names.index("finger_1_distal")
    assert shown.sizes[link, 0] < 0.5 * robot.sizes[link, 0]
    assert shown.sizes[link, 2] == pytest.approx(robot.sizes[link, 2])


def test_no_more_than_sixty_four_designs_stand_beside_one_and_none_once_nobody_waits(folder: RunFolder) -> None:
    initial = make_task("pen_press").design_space.initial
    episode = episode_of("pen_press", population=initial + 1e-3 * np.arange(70)[:, None])
    shown = crowd_of(folder, episode, explored=True).explored
    assert shown is not None
    assert len(shown) == MOST_GHOSTS * len(take_of(folder, episode).robot)
    cancelled = Cancellation()
    cancelled.cancel()
    with pytest.raises(CancelledError):
        make_crowd("pen_press", "{}", Beside(tried_in=(folder, 3), explored=True), cancelled)


def test_ghosts_are_of_the_robot_alone(folder: RunFolder) -> None:
    initial = tuple(make_task("pen_press").design_space.initial.tolist())
    take = take_of(folder, episode_of("pen_press"), ghost=initial)
    crowd = crowd_of(folder, episode_of("pen_press"), trail=(initial, initial))
    assert take.ghost is not None
    assert crowd.trail is not None
    assert set(take.ghost.names) == set(crowd.trail.names) == set(take.robot.names)


def test_a_carried_object_turns_the_short_way_and_at_an_even_pace(folder: RunFolder) -> None:
    episode = episode_of("pen_press")
    qpos = episode["qpos"].copy()
    angles = np.linspace(0, np.pi * 0.9, STEPS + 1)
    qpos[:, 12:16] = np.stack([np.cos(angles / 2), *[np.zeros(STEPS + 1)] * 2, np.sin(angles / 2)], 1)
    qpos[2, 12:16] *= -1  # the same orientation
    take = take_of(folder, episode | {"qpos": qpos})
    part = take.objects.names.index("object")
    turned = 2 * np.abs(np.sum(take.objects.wxyz[1:, part] * take.objects.wxyz[:-1, part], 1)).clip(0, 1)
    np.testing.assert_allclose(2 * np.arccos(turned / 2), np.pi * 0.9 / (take.frames - 1), atol=2e-3)


@pytest.mark.parametrize(
    "damaged",
    [
        {"milestones/pressed": np.zeros(STEPS + 2, bool)},
        {"contact": np.zeros((STEPS - 1, 4, 3))},
        {"success": np.zeros(1, bool)},
        {"qpos": np.full((STEPS + 1, 17), np.nan)},
    ],
)
def test_an_episode_whose_arrays_do_not_fit_is_refused(folder: RunFolder, damaged: dict[str, np.ndarray]) -> None:
    with pytest.raises(ValueError, match="recorded episode"):
        take_of(folder, episode_of("pen_press", **damaged))


@given(st.lists(st.booleans(), max_size=20), st.integers(1, 5))
def test_what_a_step_reaches_is_seen_from_its_end_until_the_next_ones(reached: list[bool], factor: int) -> None:
    seen = _from_their_end(np.array(reached, bool), factor, len(reached) * factor + 1)
    for frame, lit in enumerate(seen):
        step = frame // factor - 1
        assert lit == (step >= 0 and reached[step])


@given(st.lists(st.booleans(), min_size=1, max_size=12), st.integers(1, 4))
def test_markers_never_leave_the_line_between_contacts(touches: list[bool], factor: int) -> None:
    contact = np.where(np.array(touches)[:, None, None], np.arange(len(touches))[:, None, None] * np.ones(3), np.nan)
    points = _moving_contacts(contact, factor, len(touches) * factor + 1)
    assert np.isnan(points[:factor]).all()
    for t in np.flatnonzero(touches):
        np.testing.assert_allclose(points[(t + 1) * factor], contact[t])
    seen = points[np.isfinite(points).all(2)]
    assert (np.diff(seen[:, 0]) >= 0).all()
    assert set(np.flatnonzero(np.isfinite(points[::factor, 0, 0])) - 1) >= set(np.flatnonzero(touches))


def test_the_legend_names_the_colours_that_are_in_the_scene(folder: RunFolder) -> None:
    quiet = legend_of(take_of(folder, episode_of("pen_press")))
    assert "goal" in quiet
    assert "button" in quiet
    assert not any(word in quiet for word in ("reached", "pressed", "contact", "design"))
    contact = np.full((STEPS, 4, 3), np.nan)
    contact[1, 2] = 0.1
    episode = episode_of("pen_press", success=at(2), contact=contact, **{"milestones/pressed": at(2)})
    busy = legend_of(take_of(folder, episode, ghost=tuple(episode["phi"].tolist())))
    assert all(word in busy for word in ("reached", "pressed", "contact", "initial design"))
    assert f"rgb{LIT_BY['button'][1]}" in busy
