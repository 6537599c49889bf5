"""One timeline for a whole run: marks, what was in force, the evolution played, thinned charts, looks and gallery."""

import itertools
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import NAME, Page, Served, eventually, make_hand_run, make_run
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_np

from morph_core.history import History
from morph_core.protocol import (
    Acknowledged,
    AnyEvent,
    DesignSpaceChanged,
    Evaluation,
    Lock,
    Pause,
    Progress,
    SetAlpha,
    SetBound,
    StateChanged,
)
from morph_core.run_folder import EventLog, RunFolder, write_episode
from studio.moments import in_force_words, marks_of, moment_of
from studio.shelf.marks import MOST_STARS, Marks, with_star
from studio.viewer.charts import decimate, marked
from studio.viewer.evolution import Evolution
from studio.viewer.figure import Figure
from studio.viewer.gallery import MOST_OTHERS, MOST_STARRED, pieces_of
from studio.viewer.looks import AGREEMENT, CHANGE
from studio.viewer.strip import key_of, pointer, strip
from studio.viewer.take import Shot, make_take
from studio.viewer.tint import FAR, HIGH, LOW, MIDDLE, Tint, agreement_tint, change_tint, shade

ROOM = 40
"""Largest number of points of the thinned curves below."""


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_run(tmp_path / "runs", ended=None)


def progress(iteration: int, **values: object) -> Progress:
    known = {"env_steps": 100, "phi": [3.0] * 5, "episode_return": -1.0, "success": 0.0, "policy_std": 0.5}
    return Progress(iteration=iteration, **(known | values))  # pyright: ignore[reportArgumentType]


def written(folder: RunFolder, *events: AnyEvent) -> History:
    log = EventLog(folder)
    for event in (StateChanged(status="starting", iteration=0), *events):
        log.append(event)
    log.close()
    return History(folder)


def evaluated(folder: RunFolder, iteration: int, success: float = 0.0, **values: object) -> Evaluation:
    name = write_episode(folder, iteration, {"qpos": np.zeros((4, 5)), "phi": np.full(5, 3.0)})
    return Evaluation(
        iteration=iteration, env_steps=100, phi=[3.0] * 5, sampled_success=success, sampled_return=0.0,
        deterministic_success=0.0, deterministic_return=0.0, episode=name, **values,  # pyright: ignore[reportArgumentType]
    )  # fmt: skip


def acknowledged(number: int, iteration: int, command: object, accepted: bool = True) -> Acknowledged:
    return Acknowledged(id=number, iteration=iteration, accepted=accepted, command=command)  # pyright: ignore


def steered(folder: RunFolder) -> History:
    """Return a run of six iterations with a command of each kind, one of them refused."""
    space = History(folder).design_space
    return written(
        folder,
        progress(1, alpha=1.0, projection="none"),
        acknowledged(1, 1, Pause()),
        progress(2, alpha=1.0, projection="none"),
        acknowledged(2, 2, SetAlpha(0.25)),
        acknowledged(3, 2, SetAlpha(-1.0), accepted=False),
        progress(3, alpha=0.25, projection="none", frozen=True),
        DesignSpaceChanged(iteration=3, parameters=list(space.with_bound("link_1", 1.0, 4.0).parameters)),
        acknowledged(4, 3, SetBound("link_1", 1.0, 4.0)),
        DesignSpaceChanged(
            iteration=3,
            parameters=list(space.with_bound("link_1", 1.0, 4.0).with_lock("link_2", 2.5).parameters),
        ),
        acknowledged(5, 3, Lock("link_2", 2.5)),
        evaluated(folder, 3, 0.25),
        progress(4, alpha=0.25, projection="none", frozen=True, control_start=4),
        progress(5, alpha=0.25, projection="none", control_start=4),
        evaluated(folder, 5, 0.75),
        progress(6, alpha=0.25, projection="none", control_start=4),
    )


# --- moments ---


def test_a_moment_says_what_was_in_force_and_no_later_command(folder: RunFolder) -> None:
    history = steered(folder)
    early, late = moment_of(history, "2"), moment_of(history, "latest")
    assert (early.iteration, early.alpha, early.projection) == (2, 1.0, "none")
    assert [entry.command for entry in early.commands] == [Pause()]
    assert early.parameters == history.record.parameters
    assert (early.evaluation, early.progress) == (None, history.progress[1])
    assert (late.iteration, late.alpha) == (6, 0.25)
    assert [entry.command for entry in late.commands] == [
        Pause(), SetAlpha(0.25), SetBound("link_1", 1.0, 4.0), Lock("link_2", 2.5),
    ]  # fmt: skip
    assert late.evaluation is not None
    assert late.evaluation.iteration == 5
    assert moment_of(history, "0").progress is None


def test_what_is_in_force_is_said_in_words(folder: RunFolder) -> None:
    history = steered(folder)
    assert in_force_words(history, 1) == ["α 1", "projection none", "bounds as at the start", "nothing locked"]
    assert in_force_words(history, 3)[0] == "α 0.25"
    assert in_force_words(history, 4)[2:] == [
        "bounds: link_1 [1, 4] m, the others as at the start", "locked: link_2 at 2.5 m",
    ]  # fmt: skip


def test_a_method_without_a_proxy_has_neither_alpha_nor_projection_in_force(tmp_path: Path) -> None:
    history = History(make_hand_run(tmp_path, "pen_press"))
    assert in_force_words(history, 1) == ["bounds as at the start", "nothing locked"]
    assert (moment_of(history, "1").alpha, moment_of(history, "1").projection) == (None, None)


def test_the_timeline_has_a_mark_for_all_that_happened(folder: RunFolder) -> None:
    history = steered(folder)
    found = [(mark.iteration, mark.kind) for mark in marks_of(history, (2, 99))]
    assert sorted(found) == [
        (1, "command"), (2, "command"), (2, "starred"), (3, "command"), (3, "command"), (3, "episode"), (3, "freeze"),
        (4, "restart"), (5, "best"), (5, "episode"), (5, "freeze"),
    ]  # fmt: skip
    told = {(mark.iteration, mark.kind): mark.words for mark in marks_of(history)}
    assert told[2, "command"] == "α set to 0.25, in force from iteration 3"
    assert told[5, "best"] == "iteration 5: best evaluation, success 75 %"


def test_only_resumes_whose_iterations_stand_are_marked(folder: RunFolder) -> None:
    history = written(
        folder,
        *(progress(i) for i in range(1, 7)),
        StateChanged(status="starting", iteration=6),
        progress(7),
        StateChanged(status="starting", iteration=4),  # which voids the one above
        progress(5),
    )
    assert [(mark.iteration, mark.kind) for mark in marks_of(history)] == [(4, "resume")]


def test_the_strip_draws_marks_to_scale_and_many_at_one_place_as_one(folder: RunFolder) -> None:
    marks = marks_of(steered(folder))
    drawn = strip(marks, 0, 6)
    assert 'x="50.00%"' in drawn
    assert drawn.count(">◆<") == 3  # two commands of iteration 3 are one mark
    assert "link_2 locked at 2.5 m" in drawn
    assert "and 1 more" not in drawn
    assert [sign in key_of(marks) for sign in "◆■▲★▶"] == [True, True, True, True, False]
    assert 'x="25.00%"' in pointer(25, 0, 100)
    assert len(strip([m for i in range(200) for m in marks], 0, 100_000)) < 20_000


def test_the_strip_is_harmless_html(folder: RunFolder) -> None:
    history = written(folder, progress(1), acknowledged(1, 1, Lock("<img src=x>", None)))
    assert "<img" not in strip(marks_of(history), 0, 1)


def test_the_api_gives_moments_and_refuses_what_is_none(served: Served) -> None:
    folder = make_run(served.runs.folder)
    answer = served.client.get(f"/api/runs/{folder.id}/moments/2").json()
    assert (answer["iteration"], answer["phi"], answer["alpha"]) == (2, [2.8] * 5, History(folder).in_force.alpha)
    assert answer["progress"]["iteration"] == 2
    refused = served.client.get(f"/api/runs/{folder.id}/moments/99")
    assert refused.status_code == 404
    assert "0 to 3" in refused.json()["detail"]


# --- stars ---


def test_designs_are_starred_by_the_api_and_only_those_that_are_there(served: Served) -> None:
    folder = make_run(served.runs.folder)
    address = f"/api/runs/{folder.id}/designs"
    served.client.put(f"{address}/latest/star")
    assert served.client.put(f"{address}/1/star").json()["starred_designs"] == [1, 3]
    assert served.client.put(f"{address}/7/star").status_code == 404
    assert served.client.delete(f"{address}/3/star").json()["starred_designs"] == [1]
    assert served.client.patch(f"/api/runs/{folder.id}/marks", json={"name": "mine"}).json()["starred_designs"] == [1]


def test_no_more_designs_are_starred_than_are_allowed() -> None:
    full = Marks(starred_designs=tuple(range(MOST_STARS)))
    assert with_star(full, 3, True) == full
    assert with_star(full, 3, False).starred_designs == (0, 1, 2, *range(4, MOST_STARS))
    with pytest.raises(ValueError, match=f"at most {MOST_STARS}"):
        with_star(full, MOST_STARS, True)


def test_the_button_stars_the_shown_design_and_takes_the_star_away(page: Page, folder: RunFolder) -> None:
    written(folder, progress(1), progress(2))
    page.show(folder)
    page.viewer.timeline.turn_to(1)
    page.viewer.timeline.toggle_star()
    assert page.album.stars == {NAME: {1}}
    assert page.viewer.timeline.star.label == "Take the star away"
    assert "★" in page.viewer.timeline.marks.content
    page.viewer.timeline.toggle_star()
    assert page.album.stars == {NAME: set()}
    page.album.refusal = "at most 100 designs of a run are starred, these are 101"
    page.viewer.timeline.toggle_star()
    assert "at most 100 designs" in page.viewer.notice.content


# --- scrubbing and the evolution ---


def test_scrubbing_sets_body_pointer_charts_and_what_is_in_force(page: Page, folder: RunFolder) -> None:
    written(folder, *(progress(i, phi=[3 - 0.1 * i] * 5, alpha=0.1 * i) for i in range(1, 5)))
    page.show(folder)
    page.viewer.timeline._place = 0
    page.viewer._turn_to(2)
    page.take(lambda take: take.shot.phi == (2.8,) * 5)
    assert "In force at iteration 2" in page.viewer.timeline.in_force.content
    assert "50.00%" in page.viewer.timeline.pointer.content
    chart = page.viewer.traces.charts["Design φ"]

    def at() -> list[float]:
        page.show(folder)
        return chart.data[0][chart.data[-1] > 1].tolist()

    assert eventually(lambda: at() == [2])


def test_marks_are_jumped_to_one_by_one(page: Page, folder: RunFolder) -> None:
    steered(folder)
    page.show(folder)
    timeline, seen = page.viewer.timeline, []
    timeline.turn_to(0)
    for _ in range(6):
        timeline._jump("next", marks=True)
        seen.append(timeline.shown_iteration)
    assert seen == [1, 2, 3, 4, 5, 5]
    timeline._jump("previous", marks=True)
    assert timeline.shown_iteration == 4
    timeline._jump("no such way", marks=True)
    assert timeline.shown_iteration == 4


def test_the_evolution_plays_from_the_start_again_and_again_until_somebody_scrubs(
    page: Page, folder: RunFolder
) -> None:
    written(folder, *(progress(i, phi=[3 - 0.01 * i] * 5) for i in range(1, 9)), evaluated(folder, 8))
    page.show(folder)
    timeline = page.viewer.timeline
    timeline.evolution.set_pace(60)
    timeline.toggle_evolution()
    assert timeline.evolve.label == "Pause the evolution"
    assert not timeline.follow.value
    seen: list[int] = []

    def again() -> bool:
        seen.append(timeline.shown_iteration)
        return any(before > after for before, after in itertools.pairwise(seen))

    assert eventually(again)
    assert timeline.evolution.playing
    timeline.turn_to(8)
    page.show(folder)
    assert not timeline.evolution.playing
    assert timeline.evolve.label == "Play the evolution"
    page.take(lambda take: take.shot.episode == (folder, 8))


def test_the_evolution_ends_at_the_latest_design_and_shows_no_episode_before(page: Page, folder: RunFolder) -> None:
    written(folder, progress(1), evaluated(folder, 1), progress(2), evaluated(folder, 2))
    page.show(folder)
    timeline = page.viewer.timeline
    timeline.again.value = False
    timeline._place, timeline.follow.value = 0.0, False
    assert timeline._go_on(1.2)
    assert (timeline.shown_iteration, timeline.has_episode) == (1, True)
    assert not timeline._go_on(2.0)
    assert timeline.shown_iteration == 2


def test_an_evolution_steps_by_pace_and_outlives_no_failure() -> None:
    steps: list[float] = []

    def step(iterations: float) -> bool:
        steps.append(iterations)
        if len(steps) == 3:
            raise OSError("the disk is gone")
        return True

    evolution = Evolution(step)
    evolution.set_pace(1e9)
    before = time.monotonic()
    evolution.play()
    evolution.play()  # which changes nothing
    assert eventually(lambda: not evolution.playing)
    assert 0 < sum(steps) <= 500 * (time.monotonic() - before)
    assert len(steps) == 3


def test_live_follows_again(page: Page, folder: RunFolder) -> None:
    written(folder, progress(1), progress(2))
    page.show(folder)
    timeline = page.viewer.timeline
    timeline.turn_to(1)
    timeline.toggle_evolution()
    timeline.toggle_follow()
    assert (timeline.follow.value, timeline.evolution.playing, timeline.iteration.value) == (True, False, 2)


# --- charts ---

values = st.floats(-1e6, 1e6) | st.just(float("nan"))
curves = st.integers(ROOM + 1, 300).flatmap(
    lambda n: st_np.arrays(float, st.tuples(st.integers(1, 3), st.just(n)), elements=values)
)


@given(ys=curves)
def test_thinned_charts_keep_the_minimum_and_the_maximum_of_every_series(ys: np.ndarray) -> None:
    x, *thinned = decimate((np.arange(1.0, ys.shape[1] + 1), *ys), ROOM)
    assert len(x) <= ROOM
    assert (x[0], x[-1]) == (1, ys.shape[1])
    assert (np.diff(x) >= 0).all()
    for y, kept in zip(ys, thinned, strict=True):
        assert len(kept) == len(x)
        np.testing.assert_array_equal(kept[[0, -1]], y[[0, -1]])
        if np.isfinite(y).any():
            assert (np.nanmin(kept), np.nanmax(kept)) == (np.nanmin(y), np.nanmax(y))
        else:
            assert np.isnan(kept).all()


@given(ys=curves)
def test_thinned_charts_keep_the_extremes_of_every_stretch_in_their_order(ys: np.ndarray) -> None:
    x, *thinned = decimate((np.arange(float(ys.shape[1])), *ys), ROOM)
    for begin, end, i in zip(x[1:-1:2].astype(int), x[2:-1:2].astype(int), range(1, ROOM, 2), strict=False):
        for y, kept in zip(ys, thinned, strict=True):
            stretch = y[begin : end + 1]
            finite = stretch[np.isfinite(stretch)]
            if len(finite):
                low, high = finite.argmin(), finite.argmax()
                np.testing.assert_array_equal(kept[i : i + 2], finite[[min(low, high), max(low, high)]])


def test_short_curves_stay_as_they_are() -> None:
    curve = np.arange(3.0), np.array([np.nan, 1.0, 2.0])
    assert decimate(curve, 4) is curve


@given(ys=curves, at=st.floats(-10, 400), logarithmic=st.booleans())
def test_the_line_at_the_shown_iteration_changes_no_curve(ys: np.ndarray, at: float, logarithmic: bool) -> None:
    ys = np.abs(ys) + 1 if logarithmic else ys
    x = np.arange(float(ys.shape[1]))
    longer, *others, line = marked((x, *ys), at, logarithmic=logarithmic)
    assert (np.diff(longer) >= 0).all()
    (top,) = np.flatnonzero(line > 1)
    put_in = [top - 1, top, top + 1]
    assert longer[put_in].tolist() == [np.clip(at, 0, x[-1])] * 3
    assert (np.delete(line, top) < 0).all()  # below its scale, without a gap
    np.testing.assert_array_equal(np.delete(longer, put_in), x)
    for y, other in zip(ys, others, strict=True):
        np.testing.assert_array_equal(np.delete(other, put_in), y)
        ends = np.sort(other[[top - 2, top + 2]])
        slack = 1e-6 * np.abs(ends).max(initial=1)
        assert np.isnan(ends).any() or (ends[0] - slack <= other[top] <= ends[1] + slack)


# --- colours ---


@given(value=st.floats(-3, 3))
def test_a_shade_is_grey_at_zero_and_strongest_at_its_ends(value: float) -> None:
    end = LOW if value < 0 else HIGH
    shares = [(c - m) / (e - m) for c, m, e in zip(shade(value), MIDDLE, end, strict=True)]
    np.testing.assert_allclose(shares, min(abs(value), 1), atol=0.03)


def test_parts_are_coloured_by_their_change_since_the_start(folder: RunFolder) -> None:
    history = written(folder, progress(1))
    low, high = history.design_space.hard_box
    phi = history.initial_phi.copy()
    phi[1] += FAR * (high - low)[1]
    phi[2] -= 0.5 * FAR * (high - low)[2]
    tint = change_tint(history, phi)
    assert dict(tint.colours) == {
        "link_1": MIDDLE, "link_2": HIGH, "link_3": shade(-0.5), "link_4": MIDDLE, "link_5": MIDDLE,
    }  # fmt: skip
    take = make_take(Shot("reacher", (), tuple(phi.tolist()), tint=tint))
    assert tuple(take.robot.colours[take.robot.names.index("link_2")]) == HIGH
    assert tuple(take.robot.colours[take.robot.names.index("base")]) == MIDDLE


def test_a_finger_has_the_colour_of_its_parameter_that_changed_most(tmp_path: Path) -> None:
    history = History(make_hand_run(tmp_path, "pen_press"))
    low, high = history.design_space.hard_box
    phi = history.initial_phi.copy()
    phi[0] += 0.1 * FAR * (high - low)[0]  # the placement of finger 1
    phi[4] -= FAR * (high - low)[4]  # its length
    assert dict(change_tint(history, phi).colours)["finger_1"] == LOW


def test_parts_are_coloured_by_the_last_measured_agreement_of_the_gradients(folder: RunFolder) -> None:
    history = written(
        folder,
        progress(1),
        progress(2, cosine_by_parameter=[-1.0, None, 0.0, 0.5, 1.0]),
        progress(3),
        progress(4, cosine_by_parameter=[1.0] * 5),
    )
    assert agreement_tint(history, 1).colours == ()
    assert "not measured" in agreement_tint(history, 1).meaning
    assert dict(agreement_tint(history, 3).colours) == {
        "link_1": LOW, "link_3": MIDDLE, "link_4": shade(0.5), "link_5": HIGH,
    }  # fmt: skip
    assert dict(agreement_tint(history, 4).colours)["link_1"] == HIGH


def test_colours_and_ghosts_stand_in_the_legend(page: Page, folder: RunFolder) -> None:
    write_episode(folder, 2, {"qpos": np.zeros((4, 5)), "phi": np.full(5, 3.0), "population": np.full((3, 5), 2.5)})
    written(folder, progress(1), progress(2, cosine_by_parameter=[-1.0] * 5), evaluated(folder, 2))
    write_episode(folder, 2, {"qpos": np.zeros((4, 5)), "phi": np.full(5, 3.0), "population": np.full((3, 5), 2.5)})
    page.show(folder)
    looks = page.viewer.looks
    looks.colours.value, looks.explored.value = CHANGE, True
    page.take(lambda take: isinstance(take.shot.tint, Tint) and take.shot.beside.explored)
    assert eventually(lambda: "change since the start" in page.viewer.timeline.legend.content)
    assert "explored designs" in page.viewer.timeline.legend.content
    assert eventually(lambda: "/explored/capsule" in " ".join(page.viewer.player.node_names))
    looks.colours.value = AGREEMENT
    page.take(lambda take: bool(take.shot.tint) and "agreement" in take.shot.tint.meaning)
    page.viewer.timeline.turn_to(1)  # before the first recorded episode
    page.show(folder)
    assert page.take(lambda take: take.shot.beside.tried_in is None)


# --- gallery ---


def test_a_gallery_has_the_starred_designs_first_and_a_few_over_all_iterations(folder: RunFolder) -> None:
    events = [e for i in range(1, 101) for e in (progress(i), evaluated(folder, i, float(i == 40)))]
    pieces = pieces_of(written(folder, *events), (77, 5, 300))
    assert [piece.iteration for piece in pieces[:2]] == [5, 77]
    assert [piece.starred for piece in pieces] == [True, True] + [False] * (len(pieces) - 2)
    others = [piece.iteration for piece in pieces[2:]]
    assert others == sorted(set(others))
    assert {0, 40, 100} <= set(others)
    assert len(others) <= MOST_OTHERS
    assert max(np.diff(others)) < 20
    said = {piece.iteration: piece.words for piece in pieces}
    assert (said[40], said[0]) == ("100 % success, best", "initial")
    assert sum(piece.starred for piece in pieces_of(History(folder), range(1, 101))) == MOST_STARRED
    history = History(folder)
    history.evaluations = [e for e in history.evaluations if e.iteration % 10 == 0]
    assert all(piece.iteration % 10 == 0 for piece in pieces_of(history, ())), "those that were evaluated say more"


def test_a_gallery_is_drawn_when_asked_for_and_a_click_turns_to_a_design(page: Page, folder: RunFolder) -> None:
    written(folder, *(progress(i, phi=[3 - 0.1 * i] * 5) for i in (1, 2, 3)))
    page.album.stars = {NAME: {2}}
    page.show(folder)
    gallery = page.viewer.gallery
    assert page.album.drawn == []
    assert not gallery._links.list.visible
    gallery.refresh()
    assert eventually(lambda: gallery._links.list.visible)
    assert len(page.album.drawn) == 4
    labels = [button.label for button in gallery._links._buttons if button.visible]
    assert labels == ["★ 2", "0", "1", "3"]
    assert all(f'<label for="{button._impl.uuid}"' in gallery.pictures.content for button in gallery._links._buttons)
    gallery._turn(2)
    page.take(lambda take: take.shot.phi == (2.9,) * 5)
    gallery._turn(99)
    assert page.viewer.timeline.shown_iteration == 1


def test_a_gallery_goes_with_its_run_and_says_why_it_can_not_be_drawn(
    page: Page, folder: RunFolder, tmp_path: Path
) -> None:
    written(folder, progress(1))
    page.show(folder)
    page.viewer.gallery.refresh()
    assert eventually(lambda: page.viewer.gallery._links.list.visible)
    page.show(make_run(tmp_path / "other", "another"))
    assert page.viewer.gallery.pictures.content == ""
    page.album.refusal = "no such task <here>"
    page.viewer.gallery.refresh()
    assert eventually(lambda: "no such task &lt;here&gt;" in page.viewer.gallery.note.content)


def test_earlier_designs_stand_beside_the_shown_one_once_they_are_wanted(page: Page, folder: RunFolder) -> None:
    written(folder, *(progress(i, phi=[3 - 0.1 * i] * 5) for i in range(1, 5)))
    page.viewer.looks.trail.value = True
    page.show(folder)
    layer = page.viewer.player._beside["trail"]
    assert eventually(lambda: isinstance(layer._figure, Figure))
    assert any(name.startswith("/trail/") for name in page.viewer.player.node_names)
    assert isinstance(layer._figure, Figure)
    assert len(layer._figure) == 3 * len(page.take().robot)  # those before the latest
    page.viewer.looks.trail.value = False
    assert eventually(lambda: layer._figure is None)
