"""Keys and commands, news of runs, and what is explained where it is set."""

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
from conftest import NAME, ROOT, Page, Served, eventually, make_run

from morph_core.history import History
from morph_core.protocol import AnyEvent, Evaluation, Pause, Status, StepIteration
from morph_core.run_folder import EventLog, RunFolder
from studio.viewer import explain
from studio.viewer.news import GOAL, News

SIGNS = {"←": "arrowleft", "→": "arrowright", "Space": "space", "Enter": "enter", "Esc": "escape"}


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return make_run(tmp_path / "runs", NAME, ended="finished")


def do(page: Page, key: str) -> None:
    """Do what a key does."""
    (deed,) = (deed for deed in page.viewer._deeds() if key in deed.keys)
    deed.do(None)


# --- keys ---


def test_the_help_names_every_key_and_no_other(page: Page) -> None:
    help_text = (ROOT / "studio" / "page" / "index.html").read_text()
    rows = [row for row in re.findall(r"<tr><td>(.*?)</td>", help_text) if "Ctrl" not in row]
    told = [SIGNS.get(key, key) for row in rows for key in re.findall(r"<kbd>(.*?)</kbd>", row) if key != "?"]
    assert sorted(told) == sorted(key for deed in page.viewer._deeds() for key in deed.keys)


def test_every_deed_is_a_command_of_the_palette_once_for_each_key(page: Page) -> None:
    commands = [c._impl.props for c in page.server.gui._command_handle_from_uuid.values()]
    for deed in page.viewer._deeds():
        keys = [c.hotkey for c in commands if c.label == deed.label]
        assert keys == list(deed.keys or (None,))
    hotkeys = [c.hotkey for c in commands if c.hotkey]
    assert len(hotkeys) == len(set(hotkeys))


def test_arrows_go_through_the_iterations_and_stay_within_the_run(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    timeline = page.viewer.timeline
    for key, shown in (("arrowleft", 2), ("arrowleft", 1), ("arrowleft", 0), ("arrowleft", 0), ("arrowright", 1)):
        do(page, key)
        assert timeline.shown_iteration == shown
    for _ in range(5):
        do(page, "arrowright")
    assert timeline.shown_iteration == 3
    assert not timeline.follow.value
    do(page, "L")
    assert timeline.follow.value


def test_keys_pause_the_run_open_a_branch_and_the_form_of_a_new_run(page: Page, folder: RunFolder) -> None:
    page.show(folder, "running")
    do(page, "P")
    assert page.commands == [(NAME, Pause())]
    playing = page.viewer.player.playing
    do(page, "space")
    assert page.viewer.player.playing is not playing
    do(page, "S")
    assert eventually(lambda: list(page.album.starred(History(folder))) == [3])
    do(page, "B")
    assert page.viewer.selected is None
    assert page.viewer.start.source.visible
    do(page, "N")
    assert not page.viewer.start.source.visible


def test_the_palette_offers_what_has_no_key(page: Page, folder: RunFolder) -> None:
    page.show(folder, "paused")
    deeds = {deed.label: deed for deed in page.viewer._deeds()}
    deeds["Step the run"].do(None)
    assert page.commands == [(NAME, StepIteration())]
    deeds["Change this body: what if"].do(None)
    assert page.viewer.what_if.open
    deeds["Close what if"].do(None)
    assert not page.viewer.what_if.open


def test_without_a_run_what_needs_one_does_nothing(page: Page) -> None:
    page.viewer.show({}, {}, None)
    for deed in page.viewer._deeds():
        deed.do(None)
    assert page.commands == []
    assert page.exported == []
    assert page.viewer.selected is None


# --- news ---


def told(news: News, folder: RunFolder, status: Status, message: str = "") -> list[str]:
    pieces = news.look({folder.id: History(folder)}, {folder.id: (status, message)})
    return [f"{piece.title}: {piece.sentence}" for piece in pieces]


def append(folder: RunFolder, event: AnyEvent) -> None:
    log = EventLog(folder)
    log.append(event)
    log.close()


def evaluation(iteration: int, success: float) -> Evaluation:
    return Evaluation(
        iteration=iteration, env_steps=100, phi=[2.0] * 5, sampled_success=success, sampled_return=0.0,
        deterministic_success=success, deterministic_return=0.0,
    )  # fmt: skip


def test_a_goal_and_an_end_are_told_once(folder: RunFolder) -> None:
    news = News()
    assert told(news, folder, "running") == []
    append(folder, evaluation(4, GOAL - 0.01))
    assert told(news, folder, "running") == []
    append(folder, evaluation(5, GOAL))
    assert told(news, folder, "running") == [f"Goal reached: {NAME}: 95 % success at iteration 5"]
    append(folder, evaluation(6, 1.0))
    assert told(news, folder, "running") == []
    assert told(news, folder, "finished") == [f"Run finished: {NAME}: iteration 3, 100 % success"]
    assert told(news, folder, "finished") == []


@pytest.mark.parametrize("status", ["failed", "lost"])
def test_a_failure_is_told_with_its_reason(folder: RunFolder, status: Status) -> None:
    news = News()
    told(news, folder, "running")
    assert told(news, folder, status, "loss is NaN") == [f"Run {status}: {NAME}: loss is NaN"]


def test_whoever_comes_later_is_told_nothing_old(folder: RunFolder) -> None:
    append(folder, evaluation(5, 1.0))
    news = News()
    assert told(news, folder, "finished") == []
    append(folder, evaluation(6, 1.0))
    assert told(news, folder, "running") == []


# --- what is explained ---


@pytest.mark.parametrize("explained", [explain.alpha(), explain.projection(), explain.exploration()])
def test_an_explanation_is_a_picture_and_sentences(explained: str) -> None:
    picture = ElementTree.fromstring(explained[explained.index("<svg") : explained.index("</svg>") + 6])
    assert len(picture) >= 4
    words = re.sub("<[^>]+>", "", explained[explained.index("</svg>") :])
    assert re.fullmatch(r"[A-Z].{40,}\.", words)


def test_what_a_method_does_not_have_is_not_explained(page: Page) -> None:
    form = page.viewer.start
    assert all(html.visible for html in form.settings._explained.values())
    form.method.value = "no_hw_opt"
    assert not form.settings._explained["alpha"].visible


# --- the page ---


def test_legends_of_charts_show_values_only_under_the_pointer(served: Served) -> None:
    page = served.client.get("/viewer/").text
    assert "u-value" in page[page.rindex("<style>") : page.index("</head>")]


def test_the_tour_points_at_what_there_is(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    places = re.findall(r'tab\("(\w[\w ]*)"\)', (ROOT / "studio" / "page" / "tour.js").read_text())
    source = "".join(path.read_text() for path in (ROOT / "studio" / "viewer").glob("*.py"))
    assert len(places) == 4
    for place in places:
        assert f'add_tab("{place}"' in source
