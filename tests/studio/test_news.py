"""The list of runs is sent when it changes: as lines that have changed, once, compressed, and not at all otherwise."""

import shutil
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from conftest import NAME, TOKEN, Served, make_run, serving
from hypothesis import given
from hypothesis import strategies as st

from morph_core.protocol import Status
from studio.lines import Summary
from studio.news import Change, News
from studio.settings import Settings

KEY = "a-key-of-a-browser"


class _Told:
    """A folder whose list is what a test says."""

    def __init__(self) -> None:
        self.lines: list[Summary] = []

    def summaries(self) -> list[Summary]:
        return self.lines


STATES = st.dictionaries(st.sampled_from("abcde"), st.sampled_from(["running", "stopped", "lost"]), max_size=5)


@given(st.lists(STATES, min_size=1, max_size=8), st.data())
def test_whoever_puts_changes_together_has_the_list(states: list[dict[str, Status]], data: st.DataObject) -> None:
    told = _Told()
    news = News(told)  # pyright: ignore[reportArgumentType]
    known, version = {}, 0
    for state in states:
        told.lines = [Summary(id=name, status=status) for name, status in state.items()]
        if not data.draw(st.booleans()):  # this reader misses some of the changes; another one makes the list be read
            news.since(0)
            continue
        change = news.since(version)
        lines = known | {line.id: line for line in change.lines}
        known = {name: lines[name] for name in (known if change.ids is None else change.ids)}
        version = change.version
        assert list(known.values()) == told.lines
        assert news.since(version) == Change(version, [], None)


def test_a_line_that_has_not_changed_is_not_sent_again() -> None:
    told = _Told()
    told.lines = [Summary(id="a", status="running"), Summary(id="b", status="running")]
    news = News(told)  # pyright: ignore[reportArgumentType]
    version = news.since(0).version
    told.lines = [told.lines[0], Summary(id="b", status="stopped")]
    change = news.since(version)
    assert ([line.id for line in change.lines], change.ids) == (["b"], None)
    assert news.since(version + 99).ids == ["a", "b"], "a version that never was is answered by everything"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """One server for all tests of this file; each works on a run of its own."""
    folder = tmp_path_factory.mktemp("news")
    with serving(Settings(port=0, runs=folder / "runs", token=TOKEN, hosts=(), state=folder)) as running:
        yield running


def bulletin(served: Served, **words: object) -> dict[str, Any]:
    return served.client.get("/api/news", params={"desk": KEY, **words}).raise_for_status().json()  # pyright: ignore[reportArgumentType]


def test_news_come_as_soon_as_there_are_any(served: Served) -> None:
    make_run(served.runs.folder)
    first = bulletin(served)
    assert [run["id"] for run in first["runs"]] == first["ids"] == [NAME]
    assert first["boot"] == served.client.get("/healthz").json()["boot"]

    began = time.monotonic()
    nothing = bulletin(served, after=first["mark"], wait=1)
    assert time.monotonic() - began > 0.9
    assert (nothing["is_new"], nothing["runs"], nothing["ids"]) == (False, [], None)

    threading.Timer(0.3, lambda: served.client.patch(f"/api/runs/{NAME}/marks", json={"starred": True})).start()
    began = time.monotonic()
    news = bulletin(served, after=nothing["mark"], wait=15)
    assert time.monotonic() - began < 10
    assert ([run["marks"]["starred"] for run in news["runs"]], news["ids"]) == ([True], None)

    served.client.delete(f"/api/runs/{NAME}").raise_for_status()
    assert bulletin(served, after=news["mark"])["ids"] == []


def test_another_view_of_this_browser_is_news_and_that_of_another_is_not(served: Served) -> None:
    mark = bulletin(served)["mark"]
    served.client.put("/api/desks/a-key-of-another-one", json={"run": "x"}).raise_for_status()
    assert not bulletin(served, after=mark)["is_new"]
    served.client.put(f"/api/desks/{KEY}", json={"run": "x"}).raise_for_status()
    news = bulletin(served, after=mark)
    assert (news["is_new"], news["seen"]["run"], news["runs"]) == (True, "x", [])


@pytest.mark.parametrize("words", ["after=1", "after=x.1.1", "wait=21", "wait=nan", "desk=short", "wait=-1"])
def test_an_odd_question_is_refused(served: Served, words: str) -> None:
    assert served.client.get(f"/api/news?{words}").status_code == 422


def test_a_mark_of_another_server_is_answered_by_everything(served: Served) -> None:
    news = bulletin(served, after=f"{'0' * 16}.7.7")
    assert (news["is_new"], news["ids"]) == (True, served.runs.ids())


def test_a_stopping_server_lets_go_of_those_who_wait(settings: Settings) -> None:
    with serving(settings) as served:
        mark, answers = bulletin(served)["mark"], []
        thread = threading.Thread(target=lambda: answers.append(bulletin(served, after=mark, wait=20)))
        thread.start()
        time.sleep(0.3)
        served.app.state.stopping.set()
        thread.join(10)
    assert [answer["is_new"] for answer in answers] == [False]


def test_an_idle_page_costs_next_to_nothing_and_the_first_list_is_compressed(served: Served) -> None:
    made = make_run(served.runs.folder, "20260102-000000-copied")
    for number in range(1, 50):
        shutil.copytree(made.path, made.path.with_name(f"20260102-000000-copied-{number}"))
    everything = served.client.get("/api/news")
    assert len(everything.json()["runs"]) >= 50
    assert int(everything.headers["content-length"]) < len(everything.content) / 8
    answer = served.client.get("/api/news", params={"after": everything.json()["mark"], "wait": 1})
    sent = len(answer.content) + size_of(answer.headers.raw) + size_of(answer.request.headers.raw)
    assert sent < 2 * 1024, "and the page asks every ten seconds"


@pytest.mark.parametrize("path", ["/api/runs", "/api/table"])
def test_a_list_that_has_not_changed_is_not_sent_again(served: Served, path: str) -> None:
    make_run(served.runs.folder, f"20260103-000000-for-{path[5:]}")
    whole = served.client.get(path)
    tag = whole.headers["etag"]
    for known in (tag, f"W/{tag}", f'"x", {tag}', f'"a, b",W/{tag}', "*"):
        again = served.client.get(path, headers={"If-None-Match": known})
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
    twice = served.client.get(path, headers=[("If-None-Match", '"x"'), ("If-None-Match", tag)])
    assert twice.status_code == 304
    for other in ('"other"', "", tag.strip('"'), f'"x,{tag[1:]}'):
        assert served.client.get(path, headers={"If-None-Match": other}).content == whole.content


def size_of(headers: list[tuple[bytes, bytes]]) -> int:
    return sum(len(name) + len(value) + 4 for name, value in headers)


def test_the_table_gives_single_rows(served: Served) -> None:
    for name in ("20260104-a", "20260104-b", "20260104-c"):
        make_run(served.runs.folder, name)
    rows = served.client.get("/api/table", params={"run": ["20260104-a", "20260104-c", "none"]}).json()
    assert [row["id"] for row in rows] == ["20260104-c", "20260104-a"]


def test_a_folder_whose_name_is_no_text_is_listed_by_its_bytes(served: Served) -> None:
    made = make_run(served.runs.folder, "20260105-a")
    strange = str(made.path.parent).encode() + b"/\xff\x1b[2J"
    shutil.copytree(str(made.path).encode(), strange)
    listed = served.client.get("/api/runs").raise_for_status().json()
    assert listed[-1]["id"] == "\\xff\x1b[2J"
    assert "rename it" in listed[-1]["reason"]


def test_a_run_that_is_removed_says_so_to_whoever_follows_it(served: Served) -> None:
    folder = make_run(served.runs.folder, "20260106-a")
    with served.client.stream("GET", f"/api/runs/{folder.id}/events") as events:
        lines = events.iter_lines()
        threading.Timer(0.3, lambda: served.client.delete(f"/api/runs/{folder.id}")).start()
        said = [line for line in lines if line]
    assert said[-2] == "event: gone"
    assert "unknown run" in said[-1]
