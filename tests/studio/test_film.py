"""Films and stills: what their frames show and say, that an interruption loses little, and what is refused."""

import contextlib
import dataclasses
import io
import os
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import imageio_ffmpeg
import msgspec
import numpy as np
import psutil
import pytest
from conftest import append, make_hand_run, make_run, progress
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

from morph_core import shapes
from morph_core.history import History
from morph_core.protocol import Evaluation, Recorded
from morph_core.run_folder import RunFolder, write_episode
from studio.cli import run
from studio.film import reel as reel_module
from studio.film.errors import DiskFullError, FilmError
from studio.film.lens import Lens
from studio.film.page import Pages
from studio.film.plan import LONGEST, Script, Story, plan_episode, plan_evolution
from studio.film.reel import PART, Reel
from studio.film.solid import rounded
from studio.film.stage import Stage
from studio.film.still import Format, Still, read_size
from studio.film.vector import _hidden_first
from studio.film.words import caption_of, milestone_times, table_of

SMALL = (320, 240)


@pytest.fixture(scope="module")
def reached(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run of the reacher with five iterations, an evaluation of 64 episodes in the third, and its episodes."""
    folder = make_run(tmp_path_factory.mktemp("runs"), ended="finished")
    steps = 4
    arrays_of = {
        "qpos": np.linspace(0, 0.5, 5 * (steps + 1)).reshape(steps + 1, 5), "phi": np.full(5, 2.7),
        "success": np.array([False, False, True, True]), "reward_terms/distance": np.array([-3.0, -2.0, -1.0, 4.0]),
        "contact": np.full((steps, 1, 3), 0.5),
    }  # fmt: skip
    name = write_episode(folder, 3, {**arrays_of, "recorded": np.array([0, 0, 0, -1])})
    append(
        folder,
        Evaluation(
            iteration=3, env_steps=300, phi=[2.7] * 5, sampled_success=0.75, sampled_return=2.0, episodes=64,
            deterministic_success=0.25, deterministic_return=0.0, episode=name,
            recorded=[Recorded("median", -2.0, True)],
        ),
        progress(4, phi=[2.6] * 5), progress(5, phi=[2.5] * 5),
    )  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def script(reached: RunFolder) -> Script:
    return Script(plan_evolution([History(reached)], SMALL, 5, 2.0))


@pytest.fixture(scope="module")
def ready(reached: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of a small film that nothing interrupted."""
    out = tmp_path_factory.mktemp("films") / "whole.mp4"
    made = Reel.of(plan_evolution([History(reached)], SMALL, 5, 2.0), out)
    made.render(1, lambda _: None)
    made.join()
    return out.read_bytes()


# --- what is seen when ------------------------------------------------------------------------------------------------


@settings(max_examples=12)
@given(fps=st.integers(5, 60), seconds=st.floats(2, 40))
def test_an_evolution_goes_forward_through_all_iterations_and_ends_with_the_episode(
    reached: RunFolder, fps: int, seconds: float
) -> None:
    script = Script(plan_evolution([History(reached)], SMALL, fps, seconds))
    moments = [script.at(frame) for frame in range(script.frames)]
    acts = list(dict.fromkeys(moment.act for moment in moments))
    assert acts == ["opening", "evolution", "standing", "episode", "closing"]
    iterations = [m.iteration for m in moments if m.act != "episode"]
    assert iterations == sorted(iterations)
    assert {0, 5} <= {*iterations}
    steps = np.diff([m.iteration for m in moments if m.act == "evolution"])
    assert steps.max() <= 5 / min(len(steps), 200)  # no leaps
    assert sum(m.act == "evolution" for m in moments) == round(seconds * fps)
    times = [m.time for m in moments if m.act == "episode"]
    assert times == [frame / fps for frame in range(len(times))]
    with pytest.raises(IndexError):
        script.at(script.frames)


def test_between_two_iterations_the_body_is_between_theirs(reached: RunFolder) -> None:
    story = Story(plan_evolution([History(reached)], SMALL, 5).sides[0])
    assert story.between(3.5) == pytest.approx([2.65] * 5)
    assert story.between(99) == pytest.approx([2.5] * 5)


def test_a_film_shows_a_run_as_far_as_it_had_come(reached: RunFolder) -> None:
    side = plan_evolution([History(reached)], SMALL, 5).sides[0]
    before = Story(dataclasses.replace(side, until=2))
    assert (before.iterations, before.evaluations) == ([0, 1, 2], [])


def test_an_episode_is_played_from_its_first_posture_to_its_last(script: Script) -> None:
    moments = [script.at(frame) for frame in range(script.frames)]
    seen = [script.picture(0, moment) for moment in moments if moment.act in ("episode", "closing")]
    postures = [instant for _, instant in seen]
    assert postures == sorted(postures)
    assert (postures[0], postures[-1]) == (0, seen[0][0].frames - 1)
    assert 0 < postures[1] < postures[-1]


def test_an_evolution_ends_with_an_episode_of_its_best_design(tmp_path: Path) -> None:
    history = History(make_run(tmp_path))
    history.evaluations.append(msgspec.structs.replace(history.evaluations[-1], iteration=5, sampled_success=0.1))
    assert plan_evolution([history], SMALL, 5).sides[0].iteration == 3


def test_a_film_that_would_be_too_long_says_the_limit(reached: RunFolder) -> None:
    film = dataclasses.replace(plan_evolution([History(reached)], SMALL, 5), seconds=LONGEST)
    with pytest.raises(FilmError, match="the longest one takes 300 s"):
        Script(film)


def test_a_design_that_cannot_be_built_leaves_the_last_one_that_can(
    reached: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    story = Story(plan_evolution([History(reached)], SMALL, 5).sides[0])
    before = story.body(3.0)
    monkeypatch.setattr(type(story.task), "buildable", lambda _, phi: phi[..., 0] > 2.55)
    assert np.array_equal(story.body(5.0).robot.sizes, story.body(4.0).robot.sizes)
    assert not np.array_equal(story.body(5.0).robot.sizes, before.robot.sizes)
    with pytest.raises(FilmError, match=r"the design of iteration 5 can't be built.*leaves it out"):
        story.exactly(5)
    monkeypatch.setattr(type(story.task), "buildable", lambda _, phi: phi[..., 0] > 9)
    with pytest.raises(FilmError, match=r"no design of .* can be built"):
        story.body(5.0)


# --- what is said -----------------------------------------------------------------------------------------------------


def at_iteration(script: Script, iteration: float) -> str:
    frames = range(script.frames)
    moments = [script.at(f) for f in frames if script.at(f).act in ("opening", "evolution", "standing")]
    nearest = min(moments, key=lambda m: abs(m.iteration - iteration))
    return caption_of(script, 0, nearest).detail


def test_a_caption_says_the_success_its_episodes_and_when_it_was_measured(script: Script) -> None:
    assert at_iteration(script, 0) == "initial design, not trained yet"
    assert at_iteration(script, 2) == "success 20 % of the iteration's own episodes; not evaluated yet"
    assert at_iteration(script, 3) == "success 75 % of 64 episodes"
    assert at_iteration(script, 5) == "success 75 % of 64 episodes, measured in iteration 3"


def test_the_caption_of_an_episode_says_its_time_and_what_it_came_to(script: Script) -> None:
    frame = next(f for f in range(script.frames) if script.at(f).act == "episode")
    caption = caption_of(script, 0, script.at(frame))
    assert caption.headline == "iteration 3 · 0.0 s of 0.4 s"
    assert caption.detail == "median episode: succeeds, return −2.0 · success 75 % of 64 episodes"
    assert caption.subject == f"morph · {script.stories[0].history.folder.id}"
    assert caption_of(script, 0, script.at(script.frames - 1)).headline == "iteration 3 · 0.4 s of 0.4 s"
    episode = script.stories[0].episode
    assert episode is not None
    assert milestone_times(episode) == {"goal": pytest.approx(0.3)}


def test_the_table_has_every_parameter_with_its_unit_and_change(script: Script, tmp_path: Path) -> None:
    (group,) = table_of(script.stories[0], 5)
    assert group.bounds == "0.05 to 5.00 m"
    assert [(row.name, row.value, row.change) for row in group.rows] == [
        (f"link {k}", "2.50 m", "−0.50 m") for k in range(1, 6)
    ]
    assert group.rows[0].share == pytest.approx((2.5 - 0.05) / 4.95)
    hand = make_hand_run(tmp_path, "pen_press")
    groups = table_of(Story(plan_evolution([History(hand)], SMALL, 5).sides[0]), 1)
    assert [(g.name, g.rows[0].value, g.rows[0].change) for g in groups] == [
        ("placement", "5.7°", "+5.7°"), ("length", "17.0 cm", "+5.0 cm"),
    ]  # fmt: skip


# --- pictures ---------------------------------------------------------------------------------------------------------


@given(
    points=arrays.arrays(float, (6, 3), elements=st.floats(-2, 2, width=32)),
    direction=st.sampled_from([(0.55, -1.0, 0.5), (0.0, 0.0, 1.0), (0.0, -0.3, 1.0)]),
    perspective=st.booleans(),
)
def test_a_lens_sees_all_points_as_large_as_they_can_be(
    points: np.ndarray, direction: tuple[float, float, float], perspective: bool
) -> None:
    points = points + np.linspace(0, 0.1, 18).reshape(6, 3)  # never all in one place
    free = (30.0, 50.0, 330.0, 250.0)
    seen = Lens.framing(points, np.array(direction), free, perspective=perspective).project(points)
    low, high = seen[:, :2].min(0), seen[:, :2].max(0)
    assert (low >= np.array(free[:2]) - 1e-3).all()
    assert (high <= np.array(free[2:]) + 1e-3).all()
    if not perspective:
        assert max((high - low) / (np.array(free[2:]) - np.array(free[:2]))) == pytest.approx(1.0)
    nearer = points @ (np.array(direction) / np.linalg.norm(direction))
    assert np.argmax(seen[:, 2]) == np.argmax(nearer) or np.ptp(nearer) < 1e-6


def test_round_sides_are_smooth_and_edges_stay_sharp() -> None:
    vertices, faces = shapes.cylinder()
    corners, normals = rounded(vertices[faces].astype(float))
    side = np.abs(normals[..., 2]) < 0.5
    radial = corners[side][:, :2] / np.linalg.norm(corners[side][:, :2], axis=1, keepdims=True)
    assert normals[side][:, :2] == pytest.approx(radial, abs=0.02)
    vertices, faces = shapes.box()
    _, normals = rounded(vertices[faces].astype(float))
    assert np.sort(np.abs(normals), axis=2)[..., 2] == pytest.approx(1.0)


def test_a_scene_stands_on_clear_ground_and_what_is_nearer_hides_the_rest(script: Script) -> None:
    take = script.stories[0].episode
    assert take is not None
    points = take.robot.corners([0])
    lens = Lens.framing(points, np.array([0.0, 0.0, 1.0]), (20, 20, 140, 100), perspective=False)
    image = np.asarray(Stage(lens, 160, 120, contacts=False, shadows=False).picture(take, 0))
    assert image.shape == (120, 160, 4)
    x, y, _ = lens.project(take.robot.positions[0, 1].astype(float))  # the middle of a link
    assert image[int(y), int(x), 3] > 0
    assert 0 < (image[..., 3] == 0).mean() < 1
    edges = (image[..., 3] > 0) & (image[..., 3] < 255)
    assert edges.any()  # several samples for each pixel


def test_the_pale_design_keeps_its_colours_beside_the_one_that_moves(script: Script) -> None:
    take = script.stories[0].episode
    assert take is not None
    lens = Lens.framing(take.robot.corners([0]), np.array([0.0, 0.0, 1.0]), (20, 20, 140, 100), perspective=False)
    stage = Stage(lens, 160, 120, ghost=take.robot.moved(np.array([0.3, 0.3, 0.0])), contacts=False)
    image = np.asarray(stage.picture(take, 0)).astype(int)
    pale = (image[..., 3] > 90) & (image[..., 3] < 100)  # neither in front, nor at an edge
    assert pale.sum() > 30
    assert np.ptp(image[pale][:, :3], axis=1).min() > 10  # grey is what a shadow is


def test_what_encodes_obeys_no_terminal_and_is_as_nice_as_we_are(reached: RunFolder, tmp_path: Path) -> None:
    reel = Reel.of(plan_episode([(History(reached), "best")], None, SMALL, 5), tmp_path / "film.mp4")
    known = {child.pid for child in psutil.Process().children()}
    with contextlib.suppress(FilmError), reel._encoder(tmp_path / "none"):
        (encoder,) = {child.pid for child in psutil.Process().children()} - known
        assert os.getsid(encoder) == os.getsid(0)  # the system divides the processor among sessions
        assert os.getpgid(encoder) != os.getpgrp()


def test_frames_have_the_size_of_the_film_and_change_with_the_design(script: Script) -> None:
    pages = Pages(script)
    frames = [script.frames * share // 100 for share in (0, 55, 55)]
    first, later, again = (np.asarray(pages.frame(frame)) for frame in frames)
    assert first.shape == (240, 320, 3)
    assert np.array_equal(later, again)
    assert (first != later).any(2).mean() > 0.005


def test_two_runs_stand_side_by_side_and_the_shorter_one_waits(reached: RunFolder, tmp_path: Path) -> None:
    other = make_run(tmp_path, "20260101-000000-reacher-morph-s1", ended="finished")
    film = plan_evolution([History(reached), History(other)], SMALL, 5, 2.0)
    script = Script(film)
    moment = next(script.at(f) for f in range(script.frames) if script.at(f).act == "standing")
    assert [caption_of(script, side, moment).headline for side in (0, 1)] == ["iteration 5 of 5", "iteration 3 of 3"]
    picture = np.asarray(Pages(script).frame(script.frames - 1))
    assert picture.shape == (240, 320, 3)
    left, right = picture[40:120, :160], picture[40:120, 160:]
    assert (left != right).any()


# --- rendered, interrupted, resumed -----------------------------------------------------------------------------------


ODD_MP4 = "http:%d 'ü .mp4"
"""A name that ffmpeg would take for an address and a number of a picture."""


def test_an_interrupted_film_goes_on_and_has_the_same_bytes(reached: RunFolder, ready: bytes, tmp_path: Path) -> None:
    film = plan_evolution([History(reached)], SMALL, 5, 2.0)
    out = tmp_path / ODD_MP4
    drawn = 0

    def interrupt(frames: int) -> None:
        nonlocal drawn
        drawn += frames
        if drawn == PART + 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Reel.of(film, out).render(1, interrupt)
    assert not out.exists()
    assert sorted(path.name for path in (tmp_path / f"{ODD_MP4}.parts").iterdir()) == ["000000.mp4", "film.json"]
    told: list[int] = []
    resumed = Reel.of(film, out)
    resumed.render(1, told.append)
    assert told[0] == PART  # those that are there
    assert sum(told) == resumed.frames == Script(film).frames
    resumed.join()
    assert out.read_bytes() == ready
    assert [path.name for path in tmp_path.iterdir()] == [ODD_MP4]
    assert imageio_ffmpeg.count_frames_and_secs(str(out)) == (resumed.frames, pytest.approx(resumed.frames / 5))
    assert next(imageio_ffmpeg.read_frames(str(out)))["size"] == SMALL


def test_parts_of_another_film_are_not_taken(reached: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "film.mp4"
    first = Reel.of(plan_evolution([History(reached)], SMALL, 5, 2.0), out)
    first.path(first.parts()[0]).write_bytes(b"a part")
    (first.folder / "notes.odt").write_bytes(b"of somebody")
    assert first.parts()[0] not in Reel.of(first.film, out).missing()
    other = Reel.of(dataclasses.replace(first.film, fps=10), out)
    assert other.missing() == other.parts()
    script = Script(first.film)
    before = reel_module._digest(script)
    assert before == reel_module._digest(Script(first.film))
    script.stories[0].phis[1] += 0.1
    assert reel_module._digest(script) != before, "the run was trained anew"
    assert (first.folder / "notes.odt").exists()


def test_a_gif_lasts_as_long_as_its_film(reached: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "pipe:%03d 'ü.gif"
    made = Reel.of(plan_episode([(History(reached), "best")], None, SMALL, 5), out)
    made.render(1, lambda _: None)
    made.join()
    with Image.open(out) as image:
        assert image.size == SMALL
        lasts = 0
        for frame in range(image.n_frames):
            image.seek(frame)
            lasts += image.info["duration"]
    assert lasts == pytest.approx(1000 * made.frames / 5, abs=20)


def test_a_full_disk_and_a_missing_ffmpeg_are_told_with_what_still_works(
    reached: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["replay", str(reached.path), "--video", str(tmp_path / "film.mp4")]
    with monkeypatch.context() as patched:
        patched.setattr(reel_module.shutil, "disk_usage", lambda _: SimpleNamespace(free=10**6))
        assert run(words) == 1
    assert "1 MB are free" in capsys.readouterr().err
    with monkeypatch.context() as patched:
        patched.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: (_ for _ in ()).throw(RuntimeError("none")))
        assert run(words) == 1
    assert "what still works: a still" in capsys.readouterr().err
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "imageio_ffmpeg", None)
        assert run(words) == 1
    assert 'pip install "morph-studio[video]"' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_what_ffmpeg_says_of_a_full_disk_becomes_a_sentence(reached: RunFolder, tmp_path: Path) -> None:
    made = Reel.of(plan_episode([(History(reached), "best")], None, SMALL, 5), tmp_path / "film.mp4")
    full = made._why(b"av_interleaved_write_frame(): No space left on device")
    assert isinstance(full, DiskFullError)
    assert "the same command goes on from there" in str(full)
    assert "ffmpeg can't encode the film: Unknown encoder" in str(made._why(b"first\nUnknown encoder 'libx264'"))


# --- stills -----------------------------------------------------------------------------------------------------------


def test_a_png_has_its_size_on_paper_and_clear_ground(reached: RunFolder) -> None:
    still = Still(History(reached), "best")
    with Image.open(io.BytesIO(still.png(Format(50, 40, 300, bar=True)))) as image:
        assert image.size == (round(50 / 25.4 * 300), round(40 / 25.4 * 300))
        assert image.info["dpi"] == pytest.approx((300, 300), abs=0.1)
        alpha = np.asarray(image)[..., 3]
    assert not alpha[[0, 0, -1, -1], [0, -1, 0, -1]].any()
    assert alpha.max() == 255


def test_an_svg_is_made_of_shapes_alone_and_needs_no_pillow(
    reached: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    svg = Still(History(reached), "best", 0.2).svg(Format(*read_size("2x1.5in"), 300, bar=True)).decode()
    assert re.match(r'<svg xmlns="[^"]+" width="50.800mm" height="38.100mm" viewBox="0 0 50.800 38.100">', svg)
    assert svg.count("<path") > 50
    assert not re.search("<rect|<image|href|script", svg)
    assert re.search(r">\d+ (m|cm|mm)</text>", svg)
    numbers = np.array([float(n) for n in re.findall(r"[ML](-?[\d.]+) ", svg)])
    assert numbers.min() >= 0
    assert numbers.max() <= 50.8


@settings(max_examples=30)
@given(st.lists(st.tuples(arrays.arrays(float, (3, 2), elements=st.integers(0, 20)), st.integers(0, 5)), max_size=8))
def test_what_is_drawn_later_hides_what_is_farther(triangles: list[tuple[np.ndarray, int]]) -> None:
    seen = np.array([np.column_stack([c + 0.1, np.full(3, d + 0.01 * k)]) for k, (c, d) in enumerate(triangles)])
    seen = seen.reshape(-1, 3, 3)
    order = _hidden_first(seen, 21, 21)
    painted, nearest = np.full(441, -1), np.full(441, -np.inf)
    expected = painted.copy()
    for k in order:
        painted[reel_covered(seen[k])] = k
    for k in range(len(seen)):
        at = reel_covered(seen[k])
        closer = at[nearest[at] < seen[k, 0, 2]]
        nearest[closer], expected[closer] = seen[k, 0, 2], k
    assert np.array_equal(painted, expected)
    assert {*order.tolist()} == {*expected[expected >= 0].tolist()}


def reel_covered(triangle: np.ndarray) -> np.ndarray:
    from morph_core.picture import covered

    return covered(triangle[None], 21, 21)[1]


@pytest.mark.parametrize("words", ["85", "85px", "5mm", "85x5mm", "2000mm", "x40mm", "nan mm", ""])
def test_a_size_that_is_none_says_what_is_allowed(words: str) -> None:
    with pytest.raises(FilmError, match="from 10 to 1000 mm"):
        read_size(words)


def test_a_still_that_would_take_gigabytes_is_refused(reached: RunFolder) -> None:
    with pytest.raises(FilmError, match="more than 40 million"):
        Still(History(reached), "best").png(Format(800, 800, 600, bar=False))


# --- on the command line ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--video", "film.avi"], "a film ends in .mp4 or .gif"),
        (["--still", "still.jpg"], "a still ends in .svg or .png"),
        (["--video", "no/film.mp4"], "there is no folder no"),
        (["--video", "f.mp4", "--still", "s.svg"], "not both"),
        (["--video", "f.mp4", "--size", "1921x1080"], "even numbers of pixels"),
        (["--video", "f.mp4", "--size", "1080x1920"], "a width of 1.25 to 2.4 times"),
        (["--video", "f.mp4", "--fps", "0"], "--fps must be from 5 to 60"),
        (["--video", "f.mp4", "--seconds", "1e9"], "--seconds must be from 2 to 240"),
        (["--video", "f.mp4", "--jobs", "0"], "--jobs must be from 1 to 64"),
        (["--video", "f.mp4", "--at", "1"], "--at goes with --still"),
        (["--video", "f.mp4", "--design", "4"], "no episode was recorded of iteration 4"),
        (["--video", "f.mp4", "--design", "77"], "has no iteration 77"),
        (["--video", "f.mp4", "--design", "best", "--episode", "failed"], "no failed episode"),
        (["--still", "s.svg", "--at", "99"], "--at must be from 0 to 0.40 s"),
        (["--still", "s.png", "--dpi", "9999"], "--dpi must be from 72 to 1200"),
        (["--still", "s.png", "--fps", "30"], "--fps goes with --video"),
        (["--scale-bar"], "give one of --check"),
        (["--check", "--dpi", "300"], "--dpi goes with --video or --still"),
    ],
)
def test_what_can_not_be_is_refused_with_what_can(
    reached: RunFolder, tmp_path: Path, flags: list[str], said: str, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert run(["replay", str(reached.path), *flags]) in (1, 2)
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_run_without_iteration_or_episode_says_what_still_works(tmp_path: Path) -> None:
    empty = make_run(tmp_path, "20260101-000000-reacher-morph-s2", ended=None)
    with pytest.raises(FilmError, match="a still shows its initial design"):
        plan_evolution([History(empty)], SMALL, 5)
    assert Still(History(empty), "0").svg(Format(85, None, 300, bar=False)).startswith(b"<svg")
    hand = History(make_hand_run(tmp_path, "mouse_click"))
    with pytest.raises(FilmError, match="what still works: the evolution"):
        plan_episode([(hand, "best")], None, SMALL, 5)
    script = Script(plan_evolution([hand], SMALL, 5, 2.0))
    assert caption_of(script, 0, script.at(script.frames - 1)).detail == "no episode was recorded"
    with pytest.raises(FilmError, match="different tasks"):
        plan_evolution([hand, History(make_run(tmp_path))], SMALL, 5)


def test_a_still_is_written_and_named(reached: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "still.svg"
    assert run(["replay", f"{reached.path}@3", "--still", str(out), "--size", "60mm"]) == 0
    assert capsys.readouterr().out == f"{out}\n"
    assert b'width="60.000mm"' in out.read_bytes()


@pytest.mark.slow
def test_two_processes_make_the_same_film_as_one_in_full_size(
    reached: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def film(name: str, jobs: int) -> Path:
        out = tmp_path / name
        flags = ["--fps", "10", "--jobs", str(jobs), "--json"]
        assert run(["replay", f"{reached.path}@3", "--video", str(out), *flags]) == 0
        return out

    one, two = film("one.mp4", 1), film("two.mp4", 2)
    assert one.read_bytes() == two.read_bytes()
    assert next(imageio_ffmpeg.read_frames(str(two)))["size"] == (1920, 1080)
    assert '"frames"' in capsys.readouterr().out
