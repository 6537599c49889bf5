"""The recorded runs that come with the studio: what they say of themselves, that nobody can change them, their film."""

import fnmatch
import functools
import json
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import NAME, ROOT, TOKEN, Page, append, eventually, make_run, progress
from fastapi.testclient import TestClient
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.protocol import Evaluation, Pause, StateChanged
from morph_core.run_folder import RunFolder, RunFolderError, read_episode, write_episode
from studio.app import create_app
from studio.cli.serve import main as serve
from studio.new_run import Branch, StartRun
from studio.recordings import ABOUT, Recording, Recordings
from studio.runs import Runs
from studio.settings import Settings
from studio.shelf.marks import MarksChange
from studio.viewer.caption import caption_of, change_words
from studio.viewer.film import CLIPS, LENGTH, Film
from tests.bench.record import make

RECORDED = ROOT / "studio" / "recorded"
SHIPPED = Recordings()
TASKS = ("mouse_click", "pen_press", "reacher")
LARGEST = 3_000_000
"""Bytes that all recorded runs may have together."""


def recording(task: str) -> Recording:
    found = SHIPPED.of(task)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    return Runs(tmp_path_factory.mktemp("runs"))


# --- what comes with the studio ---


def test_there_is_one_of_each_task_and_all_are_small_and_in_the_wheel() -> None:
    assert SHIPPED.names() == [f"recorded-{task}" for task in TASKS]
    assert SHIPPED.of("a_task_of_ones_own") is None
    files = [path for path in RECORDED.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= LARGEST
    shipped = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["studio"]
    for path in files:
        name = path.relative_to(ROOT / "studio").as_posix()
        assert any(fnmatch.fnmatch(name, glob) and name.count("/") == glob.count("/") for glob in shipped), name


@pytest.mark.parametrize("task", TASKS)
def test_it_says_how_it_came_about_and_what_it_came_to(task: str) -> None:
    history, origin = recording(task).history, recording(task).origin
    last = history.last_evaluation
    assert last is not None
    assert last.final
    assert (origin.successes, origin.episodes) == (round(last.sampled_success * 256), 256)
    assert origin.command.startswith(f"morph-studio train {task} --method {history.record.method}")
    assert f"--seed {history.record.seed}" in origin.command
    assert "whatever it came to" in origin.chosen
    assert str(history.record.seed) in origin.chosen
    assert origin.processor
    assert {"morph-studio", "mujoco", "torch"} <= origin.versions.keys()
    assert "%" in origin.outcome
    assert f"{history.iteration} iterations" in recording(task).label
    assert history.status == "finished"
    assert not (history.folder.path / "checkpoints").exists()


def test_what_the_studio_made_of_a_run_is_that_run(tmp_path: Path) -> None:
    run = make_run(tmp_path, ended=None)
    phi = [1 / 3] * 5
    name = write_episode(run, 1, {"qpos": np.full((4, 5), 1 / 3), "phi": np.array(phi), "population": np.zeros((9, 5))})
    append(
        run, StateChanged(status="starting", iteration=0), StateChanged(status="running", iteration=0),
        progress(1, phi=phi),
        Evaluation(
            iteration=1, env_steps=100, phi=phi, sampled_success=0.25, sampled_return=0.0, deterministic_success=0.5,
            deterministic_return=0.0, episode=name, episodes=4,
        ),
        StateChanged(status="finished", iteration=1),
    )  # fmt: skip
    made = Recording(RunFolder(make([run.path], tmp_path / "out")))
    assert made.history.record.id == made.history.folder.id == "recorded-reacher"
    assert (made.origin.run, made.origin.successes, made.origin.episodes) == (NAME, 1, 4)
    np.testing.assert_allclose(made.history.phi, phi, rtol=1e-5)
    arrays = read_episode(made.history.folder, 1)
    np.testing.assert_allclose(arrays["qpos"], np.full((4, 5), 1 / 3), atol=1e-4)
    assert "population" not in arrays


# --- nobody's own, and not to be changed ---


def test_it_is_opened_like_a_run_and_is_not_among_them(runs: Runs) -> None:
    name = "recorded-reacher"
    assert runs.get(name).iteration == recording("reacher").history.iteration
    assert runs.summary(name).status == "finished"
    assert runs.row(name).outcome.best is not None
    assert name in runs.watched({name})
    assert name not in runs.watched()
    assert runs.ids() == []
    assert runs.summaries() == []
    runs.show_newest()
    assert runs.shown is None


@pytest.mark.parametrize(
    "change",
    [
        lambda runs, name: runs.send(name, Pause()),
        lambda runs, name: runs.resume(name),
        lambda runs, name: runs.discard(name),
        lambda runs, name: runs.mark(name, MarksChange(starred=True)),
        lambda runs, name: runs.star(name, "latest", True),
        lambda runs, name: runs.start(StartRun(branch=Branch(name, 5))),
    ],
)
def test_it_refuses_to_be_changed_and_says_what_to_do(runs: Runs, change: Callable[[Runs, str], object]) -> None:
    before = sorted((path, path.stat().st_mtime_ns) for path in RECORDED.rglob("*"))
    with pytest.raises(ValueError, match=r"it can be watched, not .*; Start it live trains one of your own"):
        change(runs, "recorded-reacher")
    assert sorted((path, path.stat().st_mtime_ns) for path in RECORDED.rglob("*")) == before
    assert runs.ids() == []


def test_a_run_of_ones_own_goes_before_a_recorded_one_of_its_name(tmp_path: Path) -> None:
    own = make_run(tmp_path, "recorded-reacher")
    runs = Runs(tmp_path)
    assert runs.get(own.id).iteration == 3
    assert runs.discard(own.id).id == own.id


def test_the_api_lists_and_reads_it(tmp_path: Path) -> None:
    damaged = shutil.copytree(RECORDED, tmp_path / "recorded")
    (damaged / "recorded-pen_press" / "events.jsonl").unlink()
    runs = Runs(tmp_path / "runs", recordings=Recordings(damaged))
    app = create_app(Settings(port=0, runs=runs.folder, token=TOKEN, hosts=(), state=tmp_path), runs=runs)
    client = TestClient(app, base_url="http://127.0.0.1", headers={"Authorization": f"Bearer {TOKEN}"})
    listed = {each["run"]: each for each in client.get("/api/recorded").json()}
    assert listed["recorded-reacher"]["label"].startswith("recorded: 211 iterations")
    assert listed["recorded-reacher"]["origin"]["seconds"] > 0
    assert "install morph-studio anew" in listed["recorded-pen_press"]["problem"]
    assert client.get("/api/runs").json() == []
    assert client.get("/api/runs/recorded-reacher").json()["iteration"] == 211
    assert client.get("/api/runs/recorded-reacher/rollouts/5").status_code == 200
    refused = client.delete("/api/runs/recorded-reacher")
    assert refused.status_code == 422
    assert "not deleted" in refused.json()["detail"]


@pytest.mark.parametrize("damage", ["run.json", "events.jsonl", ABOUT])
@pytest.mark.parametrize("how", [Path.unlink, lambda path: path.write_bytes(b'{"format": [')])
def test_a_damaged_one_is_refused_by_one_sentence(tmp_path: Path, damage: str, how: Callable[[Path], object]) -> None:
    folder = shutil.copytree(RECORDED / "recorded-mouse_click", tmp_path / "recorded-mouse_click")
    how(folder / damage)
    with pytest.raises(RunFolderError, match=r"recorded-mouse_click .*; install morph-studio anew to see it"):
        Recordings(tmp_path).of("mouse_click")


def test_one_that_nothing_was_measured_of_is_refused(tmp_path: Path) -> None:
    folder = shutil.copytree(RECORDED / "recorded-mouse_click", tmp_path / "recorded-mouse_click")
    about = json.loads((folder / ABOUT).read_bytes())
    (folder / ABOUT).write_text(json.dumps(about | {"episodes": 0}))
    with pytest.raises(RunFolderError, match="is empty; install morph-studio anew"):
        Recordings(tmp_path).of("mouse_click")


# --- its film ---


@settings(max_examples=50)
@given(task=st.sampled_from(TASKS), moments=st.lists(st.floats(0, LENGTH, exclude_max=True), min_size=2))
def test_a_film_goes_once_through_the_run(task: str, moments: list[float]) -> None:
    history = recording(task).history
    film = _film(task)
    seen = [film.iteration_at(moment) for moment in sorted(moments)]
    assert seen == sorted(seen)
    assert all(history.begins_at <= iteration <= history.iteration for iteration in seen)
    for moment in moments:
        clip = film.clip_at(moment)
        assert clip is None or clip.iteration == film.iteration_at(moment)


@functools.cache
def _film(task: str) -> Film:
    return Film(recording(task).history)


@pytest.mark.parametrize("task", TASKS)
def test_a_film_begins_with_the_initial_design_and_ends_with_the_last_episode(task: str) -> None:
    history, film = recording(task).history, _film(task)
    assert film.iteration_at(0) == history.begins_at
    assert film.clip_at(0) is None
    assert len(film.clips) == CLIPS
    assert film.clips[-1].iteration == history.iteration
    assert film.clips[-1].ends == pytest.approx(LENGTH)
    assert all(before.ends < after.begins for before, after in zip(film.clips, film.clips[1:], strict=False))


def test_a_film_goes_on_without_an_episode_that_is_damaged(tmp_path: Path) -> None:
    folder = shutil.copytree(RECORDED / "recorded-reacher", tmp_path / "recorded-reacher")
    (folder / "episodes" / "000005.npz").write_bytes(b"PK")
    found = Recordings(tmp_path).of("reacher")
    assert found is not None
    film = Film(found.history)
    assert [clip.iteration for clip in film.clips] == [clip.iteration for clip in _film("reacher").clips[1:]]
    assert film.clips[-1].ends == pytest.approx(LENGTH)


def test_the_caption_says_what_is_seen_how_often_it_succeeds_and_what_has_changed() -> None:
    history = recording("pen_press").history
    caption = caption_of(history, 35, "a label", presents=True, enter="train it live", clip=_film("pen_press").clips[1])
    assert (caption.label, caption.iteration, caption.success) == ("a label", "iteration 35 of 98", "success 50 %")
    assert caption.detail == "64 of 128 episodes on Hw-Phy, iteration 35"
    assert "episode on Hw-Phy, 1.7 times as fast as it was" in caption.playing
    assert "length 12.0 → " in caption.change
    assert change_words(history, 0) == "the initial design"
    assert caption_of(history, 4, "", presents=False, enter="").success == "not tried yet"


# --- on the page ---


def caption(page: Page) -> dict[str, object]:
    node = page.viewer.stage.caption._node
    return json.loads(node.text) if node is not None and node.text else {}


@pytest.fixture
def visit(page: Page) -> Page:
    """A page to which all recorded runs are known, and which has not been told of any other."""
    page.viewer.beginning.recordings = SHIPPED
    return page


def test_the_start_page_plays_the_recorded_run_of_the_chosen_task_where_there_is_no_other(visit: Page) -> None:
    viewer = visit.viewer
    viewer.show({}, {})
    assert eventually(lambda: caption(visit))
    assert str(caption(visit)["label"]).startswith("recorded: ")
    assert str(caption(visit)["label"]).endswith(", shown in 20 s")
    assert viewer.stage.projector.history is recording(viewer.start.task.value).history
    for task in TASKS:
        viewer.start.task.value = task
        assert viewer.stage.projector.history is recording(task).history
        assert visit.take(lambda take, task=task: take.shot.task == task)
        assert recording(task).origin.chosen.split(";")[0] in viewer.recorded.about.content
    assert viewer.presented[0].doing.startswith(recording(viewer.start.task.value).label), "spectators are told, too"
    place = viewer.stage.projector._place
    assert eventually(lambda: viewer.stage.projector._place > place)
    viewer.open("elsewhere")
    assert viewer.stage.projector.history is None
    assert caption(visit) == {}


def test_where_there_are_runs_it_is_offered_and_not_played(visit: Page, tmp_path: Path) -> None:
    viewer = visit.viewer
    visit.show(make_run(tmp_path / "runs"))
    viewer.open(None)
    assert viewer.stage.projector.history is None
    assert viewer.recorded.folder.visible
    assert viewer.recorded.play.visible
    viewer.beginning.want_film(True)
    assert viewer.stage.projector.history is not None
    assert viewer.recorded.live.visible
    viewer.beginning.want_film(False)
    assert viewer.stage.projector.history is None
    assert visit.take(lambda take: take.shot == viewer.start.preview)


def test_a_damaged_one_leaves_the_start_page_as_it_was_with_a_sentence(visit: Page, tmp_path: Path) -> None:
    folder = tmp_path / "recorded"
    shutil.copytree(RECORDED, folder)
    for path in folder.glob("*/run.json"):
        path.write_text("{}")
    visit.viewer.beginning.recordings = Recordings(folder)
    visit.viewer.show({}, {})
    assert "install morph-studio anew" in visit.viewer.recorded.about.content
    assert not visit.viewer.recorded.play.visible
    assert visit.viewer.stage.projector.history is None
    assert visit.take(lambda take: take.shot == visit.viewer.start.preview)


def test_an_opened_one_is_labelled_and_starts_live_by_one_press(visit: Page) -> None:
    history = recording("pen_press").history
    name = history.folder.id
    visit.viewer.show({name: history}, {name: ("finished", "")}, name)
    assert eventually(lambda: caption(visit))
    assert str(caption(visit)["label"]) == recording("pen_press").label
    assert not caption(visit)["presents"]
    assert visit.viewer.presented[0].doing.startswith(recording("pen_press").label)
    assert visit.viewer.recorded.live.visible
    assert not visit.viewer.run.branch.visible
    visit.viewer.beginning.train_live(None)
    (wish,) = visit.started
    assert (wish.task, wish.method, wish.seed, wish.env_steps) == ("pen_press", "morph", 310, 500_000)


def test_the_command_line_begins_in_presenters_mode(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    served: list[Settings] = []
    monkeypatch.setattr("studio.app.serve", lambda settings, _: served.append(settings))
    for words in ([], ["--present"]):
        assert serve(["--runs", str(tmp_path), *words]) == 0
    assert [settings.present for settings in served] == [False, True]


def test_presenters_mode_plays_the_film_of_a_run_and_trains_live_by_a_key(visit: Page, tmp_path: Path) -> None:
    viewer = visit.viewer
    deeds = {key: deed.do for deed in viewer._deeds() for key in deed.keys}
    history = visit.show(make_run(tmp_path / "runs", ended="finished"))
    deeds["enter"](None)
    assert visit.started == []  # the key does nothing while the panels are there
    deeds["F"](None)
    assert viewer.view.presents
    assert viewer.stage.projector.history is history
    assert eventually(lambda: caption(visit).get("presents"))
    assert caption(visit)["label"] == f"{NAME}: finished, shown in 20 s"
    assert caption(visit)["enter"]
    deeds["enter"](None)
    assert [wish.task for wish in visit.started] == ["reacher"]
    visit.show(history.folder, "running")
    assert viewer.stage.projector.history is None
    assert eventually(lambda: caption(visit).get("label") == f"{NAME}: running")
    assert caption(visit)["enter"] == ""
    deeds["enter"](None)
    assert len(visit.started) == 1  # it is being trained already
    deeds["escape"](None)
    assert not viewer.view.presents
    assert caption(visit) == {}
