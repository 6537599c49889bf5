"""evolution.html as a file: what it carries, what it leaves out and says so, and which runs it refuses."""

import base64
import gzip
import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from conftest import ROOT, append, make_hand_run, make_run, progress
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.catalogue import make_task
from morph_core.history import History
from morph_core.protocol import Evaluation
from morph_core.run_folder import RunFolder, write_episode
from morph_core.tasks.hand import FINGER_RADIUS
from studio.cli import run
from studio.shelf.marks import Marks, write_marks
from studio.show import bodies, course, evolution, sheet
from studio.show.evolution import build_evolution
from studio.show.pack import Pack
from studio.show.sheet import Page
from studio.show.thin import thinned
from studio.viewer.figure import Figure
from studio.viewer.ghosts import filled, start_posture

SHIPPED = ROOT / "studio" / "show" / "shipped"
ARRAYS = {"f4": "<f4", "f8": "<f8", "i4": "<i4", "i2": "<i2", "u1": "u1"}


PICTURE = "data:image/png;base64,AAAA"


@pytest.fixture(autouse=True, scope="module")
def no_pictures() -> Iterator[None]:
    """Draw no pictures but where a test is about them: they take longer than all else."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(evolution, "picture", lambda *_: PICTURE)
        yield


def unpacked(content: bytes) -> Any:
    """Return the document that a pack holds, with its arrays in their places."""
    length = int.from_bytes(content[:8], "little")

    def placed(value: Any) -> Any:
        if isinstance(value, list):
            return [placed(item) for item in value]
        if not isinstance(value, dict):
            return value
        if {"at", "kind", "shape"} == set(value):
            count = int(np.prod(value["shape"]))
            return np.frombuffer(content, ARRAYS[value["kind"]], count, 8 + length + value["at"]).reshape(
                value["shape"]
            )
        return {name: placed(item) for name, item in value.items()}

    return placed(json.loads(content[8 : 8 + length]))


def carried(page: Page) -> Any:
    (packed,) = re.findall(rb'<script type="text/plain" id="evolution">([^<]*)</script>', page.content)
    return unpacked(gzip.decompress(base64.b64decode(packed)))


def designs(folder: RunFolder, count: int) -> None:
    """Let a run of the reacher go on with designs that all differ."""
    append(folder, *(progress(i, env_steps=100 * i, phi=[2.0 - 0.001 * i] * 5) for i in range(4, 4 + count)))


# --- what it carries --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reacher(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, Page]:
    folder = make_run(tmp_path_factory.mktemp("runs"))
    return folder, build_evolution([History(folder)])


def test_the_page_loads_nothing_and_allows_its_own_scripts_alone(reacher: tuple[RunFolder, Page]) -> None:
    html = reacher[1].content.decode()
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]+)"', html)
    scripts = re.findall(r"<script(?: type=\"module\")?>(.*?)</script>", html, re.DOTALL)
    hashes = {f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in scripts}
    allowed = dict(part.split(" ", 1) for part in policy.split("; "))
    assert len(scripts) == 2
    assert (allowed["default-src"], allowed["img-src"]) == ("'none'", "data:")
    assert set(allowed["script-src"].split()) == hashes
    assert not {"connect-src", "frame-src", "font-src"} & set(allowed)
    assert not re.findall(r'(?:src|href)="(?!data:)', html)


def test_every_body_is_where_the_viewer_has_it(reacher: tuple[RunFolder, Page]) -> None:
    (made,), task = carried(reacher[1])["runs"], make_task("reacher")
    history, parts = History(reacher[0]), made["cast"]["parts"]
    for design, iteration in enumerate(made["course"]["design_iterations"]):
        _, phi = history.design(str(iteration))
        model = task.scene(phi).compile()
        figure = Figure.from_model(model, filled(model, start_posture(task, phi)))
        numbers = made["designs"]["course"][:, :, design]
        assert sorted(part["name"] for part in parts) == sorted(figure.names)
        for i, name in enumerate(figure.names):
            (place,) = (
                k for k, part in enumerate(parts)
                if part["name"] == name and np.allclose(numbers[k, 3:6], figure.positions[0, i], atol=1e-6)
            )  # fmt: skip
            np.testing.assert_allclose(numbers[place, :3], figure.sizes[i], atol=1e-6)
            np.testing.assert_allclose(numbers[place, 6:], figure.wxyz[0, i], atol=1e-6)
    assert made["high"][0] > 5 * 2.7, "the episode, in which the arm is stretched out, is framed too"


def test_the_course_has_each_iteration_with_its_phi_and_its_bounds(reacher: tuple[RunFolder, Page]) -> None:
    (made,), space = carried(reacher[1])["runs"], make_task("reacher").design_space
    assert made["course"]["iterations"].tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(
        made["course"]["phi"].T, [space.initial, *([3.0 - 0.1 * i] * 5 for i in (1, 2, 3))], rtol=1e-6
    )
    np.testing.assert_allclose(made["course"]["lo"].T, np.tile(space.lo, (4, 1)), rtol=1e-6)
    assert made["course"]["exact"].tolist() == [1, 1, 1, 1]
    assert [mark["kind"] for mark in made["course"]["marks"]] == ["episode", "best"]
    charts = {chart["title"]: chart for chart in made["course"]["charts"]}
    assert charts["Success on Hw-Phy"]["axis"] == "episodes [%]"
    assert charts["Success on Hw-Phy"]["lines"][0]["values"].tolist() == [50]
    assert charts["Design φ: link"]["axis"] == "link [m]"
    assert "Agreement of g_task and g_hw" not in charts  # the run measured none


@pytest.mark.parametrize("task", ["pen_press", "mouse_click"])
def test_an_episode_is_played_where_it_was_recorded(tmp_path: Path, task: str) -> None:
    folder, made = make_hand_run(tmp_path, task), make_task(task)
    phi = np.array(History(folder).progress[0].phi)
    qpos = np.repeat(start_posture(made, phi), 6, 0)
    qpos[:, 0] += np.linspace(0, -0.1, 6)  # the palm goes down
    half = np.linspace(1.95, 2.25, 6)  # rad: from 2/3 pi on MuJoCo gives the negative of an orientation
    qpos[:, made.hand.joints + 3], qpos[:, made.hand.joints + 6] = np.cos(half), np.sin(half)
    contact = np.full((5, 2, 3), np.nan)
    contact[2, 1] = [0.01, -0.02, 0.03]
    steps = {"success": np.array([0, 0, 0, 0, 1]), "milestones/pressed": np.array([0, 0, 1, 1, 0]), "contact": contact}
    name = write_episode(folder, 1, {"qpos": qpos, "phi": phi, **steps})
    append(folder, evaluated(1, phi.tolist(), name))
    (run_,) = carried(build_evolution([History(folder)]))["runs"]
    (episode,), parts = run_["episodes"], run_["cast"]["parts"]
    model = made.scene(phi).compile()
    figure = Figure.from_model(model, filled(model, qpos))
    places = np.cumsum(episode["steps"], axis=2, dtype=np.int16) / 32767  # (n, 7, T + 1)
    moving = [i for i, name in enumerate(figure.names) if name not in ("table", "goal")]
    names = [parts[part]["name"] for part in episode["parts"]]
    assert sorted(name for name in names if name != "mount") == sorted(figure.names[i] for i in moving)
    turned = places[[k for k, name in enumerate(names) if name == "mount"], :, 0]  # a finger stands on each
    roots = np.array([model.body(f"finger_{i + 1}_proximal").pos for i in range(made.hand.fingers)])
    expected = (roots[:, 0] + 1j * roots[:, 1]) / np.hypot(roots[:, 0], roots[:, 1])
    np.testing.assert_allclose(np.exp(2j * np.arctan2(turned[:, 6], turned[:, 3])), expected, atol=1e-3)
    for k, part in enumerate(episode["parts"]):
        if names[k] == "mount":
            continue
        nearest = min(
            (i for i in moving if figure.names[i] == parts[part]["name"]),
            key=lambda i: np.abs(episode["reach"] * places[k, :3, 0] - figure.positions[0, i]).max(),
        )
        np.testing.assert_allclose(episode["reach"] * places[k, :3].T, figure.positions[:, nearest], atol=1e-4)
        agreement = np.abs((places[k, 3:].T * figure.wxyz[:, nearest]).sum(1))
        np.testing.assert_allclose(agreement, 1, atol=1e-4)
        assert (np.abs(np.diff(places[k, 3:], axis=1)) < 0.5).all(), "an orientation never jumps to its negative"
    assert episode["success"].tolist() == [0, 0, 0, 0, 1]
    assert episode["pressed"].tolist() == [0, 0, 1, 1, 0]
    assert (episode["contact"] == -32768).all(2).sum() == 9
    np.testing.assert_allclose(episode["contact"][2, 1] / 32767 * episode["reach"], [0.01, -0.02, 0.03], atol=1e-4)
    links = [part for part in parts if part["name"].endswith(("proximal", "distal"))]
    assert {part["kind"] for part in links} == {"link"}
    for part in links:
        corners = run_["cast"]["meshes"][part["mesh"]]["vertices"]
        assert np.abs(corners[:, 2]).max() == pytest.approx(0.1 + FINGER_RADIUS, abs=0.001)  # m
        assert np.abs(corners[:, 2]).min() > 0.05, "a corner in the middle would not move with its end"
        assert np.abs(corners[:, :2]).max() < FINGER_RADIUS + 0.0005


def evaluated(iteration: int, phi: list[float], episode: str | None = None, success: float = 0.5) -> Evaluation:
    return Evaluation(
        iteration=iteration, env_steps=100 * iteration, phi=phi, sampled_success=success, sampled_return=0.0,
        deterministic_success=0.25, deterministic_return=0.0, episode=episode,
    )  # fmt: skip


@settings(max_examples=25)
@given(st.data())
def test_a_document_comes_back_as_it_was(data: st.DataObject) -> None:
    arrays = data.draw(st.lists(st.tuples(st.sampled_from(sorted(ARRAYS)), st.lists(st.integers(0, 200), max_size=9))))
    pack = Pack()
    document = {"words": data.draw(st.text()), "arrays": [pack.array(np.array(v), kind) for kind, v in arrays]}
    found = unpacked(pack.content(document))
    assert found["words"] == document["words"]
    assert [array.tolist() for array in found["arrays"]] == [values for _, values in arrays]


# --- what is left out -------------------------------------------------------------------------------------------------


@given(st.integers(1, 400), st.integers(2, 60), st.lists(st.integers(0, 399), max_size=80))
def test_ends_and_marks_are_kept_first_and_never_too_many(count: int, most: int, marked: list[int]) -> None:
    marked = [i for i in marked if i < count]
    kept = thinned(count, most, marked)
    assert kept == sorted(set(kept))
    assert len(kept) <= most
    assert {0, count - 1} <= set(kept)
    room = most - len({0, count - 1})
    assert set(list(dict.fromkeys(i for i in marked if i not in (0, count - 1)))[:room]) <= set(kept)
    if count <= most:
        assert kept == list(range(count))
    elif not marked:
        assert max(np.diff(kept)) <= 2 * (count - 1) / max(most - 3, 1) + 1, "what is kept lies evenly"


def test_more_designs_than_fit_are_thinned_and_the_page_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evolution, "MOST_DESIGNS", 6)
    folder = make_run(tmp_path)
    designs(folder, 40)
    write_marks(folder.path, Marks(starred_designs=(17,)))
    page = build_evolution([History(folder)])
    (made,) = carried(page)["runs"]
    kept, rows = made["course"]["design_iterations"], made["course"]["iterations"].tolist()
    assert len(kept) <= 6
    assert {0, 3, 17, 43} <= set(kept)  # first, best, starred and last
    assert "Of 44 different designs the page holds the bodies of" in page.missing
    assert page.missing.split(".")[0] in page.content.decode()
    for row, design in enumerate(made["course"]["design"]):
        assert kept[design] == max(i for i in kept if i <= rows[row]), "a body that is left out is the one before"
    assert made["course"]["exact"].sum() == len(kept)


def test_more_iterations_than_fit_are_thinned_and_the_page_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(course, "MOST_ROWS", 10)
    folder = make_run(tmp_path)
    designs(folder, 40)
    page = build_evolution([History(folder)])
    (made,) = carried(page)["runs"]
    rows = made["course"]["iterations"].tolist()
    assert len(rows) <= 10
    assert {0, 3, 43} <= set(rows)
    assert "Of 44 iterations the page holds" in page.missing


def test_episodes_beyond_the_budget_are_left_out_and_the_page_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = make_run(tmp_path)
    designs(folder, 40)
    rng = np.random.default_rng(0)
    for i in range(10, 40, 5):
        name = write_episode(folder, i, {"qpos": rng.normal(size=(9, 5)), "phi": np.full(5, 2.0)})
        append(folder, evaluated(i, [2.0] * 5, name, success=0.9 if i == 20 else 0.1))
    monkeypatch.setattr(evolution, "EPISODE_BYTES", 4000)
    page = build_evolution([History(folder)])
    (made,) = carried(page)["runs"]
    kept = [episode["iteration"] for episode in made["episodes"]]
    assert 3 <= len(kept) < 7
    assert {3, 20, 35} <= set(kept)
    assert f"Of 7 recorded episodes the page holds {len(kept)}" in page.missing
    other = RunFolder(Path(shutil.copytree(folder.path, tmp_path / "other")))
    both = carried(build_evolution([History(folder), History(other)]))["runs"]
    assert all(len(one["episodes"]) < len(kept) for one in both), "two runs share the room"


def test_a_mesh_beyond_the_limit_is_a_box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bodies, "MESH_BYTES", 100)
    page = build_evolution([History(make_hand_run(tmp_path, "mouse_click"))])
    (made,) = carried(page)["runs"]
    assert made["cast"]["meshes"] == []
    assert not any(part["kind"] == "mesh" for part in made["cast"]["parts"])
    assert "drawn as the boxes round them" in page.missing


# --- what is missing --------------------------------------------------------------------------------------------------


def test_a_run_without_an_episode_says_so(tmp_path: Path) -> None:
    page = build_evolution([History(make_hand_run(tmp_path, "pen_press"))])
    assert "recorded no episode" in page.missing
    assert carried(page)["runs"][0]["episodes"] == []


def test_a_design_that_cannot_be_built_is_a_gap_with_its_reason(tmp_path: Path) -> None:
    folder = make_hand_run(tmp_path, "pen_press")
    phi = History(folder).progress[0].phi
    phi[0] = 1.5  # the first finger stands where the second one does
    append(folder, msgspec.structs.replace(History(folder).progress[0], iteration=2, phi=phi, seq=0))
    page = build_evolution([History(folder)])
    (made,) = carried(page)["runs"]
    assert "1 of 3 designs can't be built and have no body, that of iteration 2 because fingers 1 and 2" in page.missing
    assert made["designs"]["reasons"][:2] == ["", ""]
    assert "fingers 1 and 2" in made["designs"]["reasons"][2]
    assert (made["designs"]["course"][:, :3, 2] == 0).all()
    assert (made["designs"]["course"][:, :3, 1] > 0).any()


def test_a_damaged_episode_is_left_out(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    folder.episode(3).write_bytes(b"no archive")
    page = build_evolution([History(folder)])
    assert carried(page)["runs"][0]["episodes"] == []
    assert "No recorded episode can be read" in page.missing


def test_a_task_that_is_not_installed_leaves_traces_and_table(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    record = json.loads((folder.path / "run.json").read_bytes()) | {"task": "juggle"}
    (folder.path / "run.json").write_text(json.dumps(record))
    page = build_evolution([History(folder)])
    (made,) = carried(page)["runs"]
    assert 'the task can\'t be made here: unknown task "juggle"' in page.missing
    assert made["designs"] is None
    assert made["course"]["iterations"].tolist() == [0, 1, 2, 3]
    assert "<th scope=row>link_1<td>" in page.content.decode()


def test_a_run_that_has_only_begun_is_its_initial_design(tmp_path: Path) -> None:
    page = build_evolution([History(make_run(tmp_path, ended=None))])
    (made,) = carried(page)["runs"]
    assert made["course"]["iterations"].tolist() == [0]
    assert made["designs"]["reasons"] == [""]


def test_a_picture_of_the_best_design_stands_in_for_the_bodies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    monkeypatch.setattr(evolution, "picture", lambda task, phi: drawn.append(phi.tolist()) or sheet.picture(task, phi))
    html = build_evolution([History(make_run(tmp_path))]).content.decode()
    assert drawn == [[2.7] * 5]
    (source,) = re.findall(r'<img class="still" src="data:image/png;base64,([^"]+)" alt="Run [^"]+iteration 3 in', html)
    assert base64.b64decode(source).startswith(b"\x89PNG")


def test_what_a_run_is_called_is_text(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    write_marks(folder.path, Marks(name="<img onerror=x>"))
    renamed = folder.path.rename(tmp_path / "<img onerror=y>{{style}}")
    html = build_evolution([History(RunFolder(renamed))]).content.decode()
    assert "<img onerror" not in html
    assert "&lt;img onerror=y&gt;{{style}}" in html


@pytest.mark.parametrize("name", evolution.SCRIPTS)
def test_what_a_run_says_is_never_set_as_html(name: str) -> None:
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write", (SHIPPED / name).read_text())


# --- several runs, and the command ------------------------------------------------------------------------------------


def test_runs_of_one_task_stand_side_by_side(tmp_path: Path) -> None:
    folders = [make_run(tmp_path, f"reacher-{letter}") for letter in "abcd"]
    page = build_evolution([History(folder) for folder in folders])
    assert [made["id"] for made in carried(page)["runs"]] == [folder.id for folder in folders]


Make = Callable[[Path], list[RunFolder]]


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda runs: [make_run(runs, f"r{i}") for i in range(5)], "at most 4 runs stand side by side, these are 5"),
        (lambda runs: [make_run(runs, "r")] * 2, "a run stands beside others once: r, r"),
        (
            lambda runs: [make_run(runs, "r"), make_hand_run(runs, "pen_press", "h")],
            "runs of one task stand side by side, these are of 2: r of reacher, h of pen_press",
        ),
    ],
)
def test_runs_that_cannot_stand_side_by_side_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], make: Make, sentence: str
) -> None:
    folders, out = make(tmp_path), tmp_path / "evolution.html"
    words = ["replay", *(folder.id for folder in folders), "--runs", str(tmp_path), "--html", str(out)]
    assert run(words) == 2
    assert capsys.readouterr().err == f"morph-studio: replay: {sentence}\n"
    assert not out.exists()


def test_the_command_writes_the_page_and_says_what_it_lacks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = make_hand_run(tmp_path, "pen_press"), tmp_path / "evolution.html"
    words = ["replay", folder.id, "--runs", str(tmp_path), "--html", str(out)]
    assert run(words) == 0
    said = capsys.readouterr()
    assert said.out == f"{out}\n"
    assert "recorded no episode" in said.err
    assert run([*words, "--json"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert json.loads(said.out)["bytes"] == out.stat().st_size


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--html", "x.html"], "RUN is missing"),
        (["r"], "--html PATH.html, which writes the evolution as one page"),
        (["r", "--check", "--html", "x.html"], "give one of --check"),
        (["r", "s", "--check"], "--check compares one run, not 2"),
        (["r", "--html", "x.html", "--until", "2"], "--until goes with --check"),
        (["r", "--html", "nowhere/x.html"], "there is no folder nowhere to write into"),
    ],
)
def test_words_that_do_not_go_together_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], sentence: str
) -> None:
    make_run(tmp_path, "r")
    make_run(tmp_path, "s")
    assert run(["replay", *words, "--runs", str(tmp_path)]) == 2
    assert sentence in capsys.readouterr().err
