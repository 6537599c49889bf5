"""The routes behind the runs page: what they give, what they change, and what they refuse with a sentence."""

from collections.abc import Iterator

import httpx
import pytest
from conftest import TOKEN, Served, eventually, make_run, serving

from morph_core.run_folder import RunFolder
from studio.settings import Settings
from studio.shelf.traces import MOST_RUNS


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """One server for all: each test brings runs of its own."""
    folder = tmp_path_factory.mktemp("shelf")
    with serving(Settings(port=0, runs=folder / "runs", token=TOKEN, hosts=(), state=folder)) as running:
        yield running


@pytest.fixture
def ended(served: Served) -> RunFolder:
    """A run of three iterations that nobody else uses."""
    return make_run(served.runs.folder, f"ended-{len(served.runs.ids())}-{id(object()):x}")


def refused(answer: httpx.Response, status: int = 422) -> str:
    assert answer.status_code == status, answer.text
    detail = answer.json()["detail"]
    assert len(detail) > 10
    return detail


def row_of(served: Served, run_id: str) -> dict[str, object] | None:
    return next((row for row in served.client.get("/api/table").json() if row["id"] == run_id), None)


def test_the_table_says_what_each_run_has_come_to(served: Served, ended: RunFolder) -> None:
    row = row_of(served, ended.id)
    assert row is not None
    assert (row["status"], row["task"], row["method"], row["seed"]) == ("stopped", "reacher", "morph", 0)
    outcome = row["outcome"]
    assert isinstance(outcome, dict)
    assert outcome["env_steps"] == 300
    assert 0 <= outcome["seconds"] < 5
    assert outcome["best"] == outcome["last"] == {
        "iteration": 3, "success": 0.5, "episode_return": 0.0, "phi": [2.7] * 5, "milestones": {},
    }  # fmt: skip
    assert row["marks"] == {
        "starred": False, "name": "", "note": "", "tags": [], "archived": False, "starred_designs": [],
    }  # fmt: skip


def test_a_table_that_has_not_changed_is_not_sent_again(served: Served, ended: RunFolder) -> None:
    version = served.client.get("/api/table").headers["ETag"]
    again = served.client.get("/api/table", headers={"If-None-Match": version})
    assert (again.status_code, again.content) == (304, b"")
    served.client.patch(f"/api/runs/{ended.id}/marks", json={"starred": True})
    changed = served.client.get("/api/table", headers={"If-None-Match": version})
    assert changed.status_code == 200
    assert changed.headers["ETag"] != version


def test_marks_are_changed_one_by_one_and_shown_wherever_runs_are_listed(served: Served, ended: RunFolder) -> None:
    address = f"/api/runs/{ended.id}/marks"
    served.client.patch(address, json={"starred": True, "name": "Long <b>links</b>", "tags": ["to print"]})
    marks = served.client.patch(address, json={"note": "α = .3", "archived": True}).json()
    assert marks == {
        "starred": True, "name": "Long <b>links</b>", "note": "α = .3", "tags": ["to print"], "archived": True,
        "starred_designs": [],
    }  # fmt: skip
    (listed,) = (line for line in served.client.get("/api/runs").json() if line["id"] == ended.id)
    row = row_of(served, ended.id)
    assert row is not None
    assert listed["marks"] == row["marks"] == marks
    assert served.client.get(f"/api/runs/{ended.id}").json()["marks"] == marks


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ({"name": "x" * 81}, "a name has at most 80 characters, this one has 81"),
        ({"note": "x" * 2001}, "a note has at most 2000 characters"),
        ({"tags": [str(i) for i in range(13)]}, "a run has at most 12 tags"),
        ({"tags": ["x" * 33]}, "a tag has at most 32 characters and no comma"),
        ({"name": "a\u202eb"}, "U+202E is not"),
        ({"starred": 1}, "Expected `bool`"),
        ({"colour": "red"}, "unknown field `colour`"),
        ([], "Expected `object`"),
    ],
)
def test_a_mark_that_can_not_be_is_refused_and_changes_nothing(
    served: Served, ended: RunFolder, body: object, sentence: str
) -> None:
    served.client.patch(f"/api/runs/{ended.id}/marks", json={"name": "kept"})
    assert sentence in refused(served.client.patch(f"/api/runs/{ended.id}/marks", json=body))
    row = row_of(served, ended.id)
    assert row is not None
    assert isinstance(row["marks"], dict)
    assert (row["marks"]["name"], row["marks"]["tags"]) == ("kept", [])


def test_a_deleted_run_is_in_the_trash_and_comes_back(served: Served, ended: RunFolder) -> None:
    trashed = served.client.delete(f"/api/runs/{ended.id}").json()
    assert trashed["id"] == ended.id
    assert row_of(served, ended.id) is None
    assert served.client.get("/api/trash").json()[0] == trashed
    refused(served.client.delete(f"/api/runs/{ended.id}"), 404)
    restored = served.client.post(f"/api/trash/{ended.id}/restore").json()
    assert restored == row_of(served, ended.id)
    assert "choose from" in refused(served.client.post(f"/api/trash/{ended.id}/restore"), 404)


def test_an_emptied_trash_gives_nothing_back(served: Served, ended: RunFolder) -> None:
    served.client.delete(f"/api/runs/{ended.id}")
    assert served.client.delete("/api/trash").json()["runs"] >= 1
    assert served.client.get("/api/trash").json() == []
    assert 'no run "' in refused(served.client.post(f"/api/trash/{ended.id}/restore"), 404)


def test_a_running_run_is_not_deleted(served: Served) -> None:
    run_id = served.client.post("/api/runs", json={"task": "reacher"}).json()["id"]
    assert "stop it, then delete it" in refused(served.client.delete(f"/api/runs/{run_id}"))
    assert row_of(served, run_id) is not None


def test_a_thumbnail_is_a_picture_of_the_best_design(served: Served, ended: RunFolder) -> None:
    best, initial = (
        served.client.get(f"/api/runs/{ended.id}/thumbnail.png", params={"design": which}) for which in ("best", "0")
    )
    assert (best.status_code, best.headers["content-type"]) == (200, "image/png")
    assert best.content.startswith(b"\x89PNG")
    assert best.content != initial.content
    assert "has no iteration 999" in refused(
        served.client.get(f"/api/runs/{ended.id}/thumbnail.png", params={"design": "999"}), 404
    )


def test_traces_hold_the_evaluations_of_each_run(served: Served, ended: RunFolder) -> None:
    drawn = served.client.get("/api/traces", params={"run": [ended.id, ended.id]}).json()
    (trace,) = drawn["traces"]
    assert (trace["run"], trace["env_steps"], trace["success"], trace["iteration"]) == (ended.id, [300], [0.5], [3])
    assert (trace["phi"], trace["parameters"][0]["name"]) == ([[2.7] * 5], "link_1")
    assert (drawn["means"], drawn["confidence"]) == ([], 0.95)


def test_the_viewer_turns_to_the_design_that_was_clicked(served: Served, ended: RunFolder) -> None:
    assert served.client.post(f"/api/runs/{ended.id}/show", params={"iteration": 2}).status_code == 200
    assert eventually(lambda: served.viewer.turned_to)
    assert served.viewer.turned_to == [(ended.id, 2)]
    served.client.post(f"/api/runs/{ended.id}/show")
    assert eventually(lambda: served.viewer.turned_to == [(ended.id, 2), (ended.id, None)])
    assert "has no iteration 9" in refused(
        served.client.post(f"/api/runs/{ended.id}/show", params={"iteration": 9}), 404
    )
    assert "greater than or equal to 0" in refused(
        served.client.post(f"/api/runs/{ended.id}/show", params={"iteration": -1})
    )
    assert served.viewer.turned_to == [(ended.id, 2), (ended.id, None)]


def test_no_more_runs_are_drawn_than_can_be_told_apart(served: Served) -> None:
    names = [f"run-{i}" for i in range(MOST_RUNS + 1)]
    assert "at most 100 runs are drawn at once, these are 101" in refused(
        served.client.get("/api/traces", params={"run": names})
    )
    refused(served.client.get("/api/traces"))


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("PATCH", "/api/runs/none-such/marks"),
        ("DELETE", "/api/runs/none-such"),
        ("DELETE", "/api/runs/.trash"),
        ("GET", "/api/runs/none-such/thumbnail.png"),
        ("GET", "/api/traces?run=none-such"),
        ("POST", "/api/trash/none-such/restore"),
    ],
)
def test_an_unknown_run_is_told(served: Served, method: str, path: str) -> None:
    refused(served.client.request(method, path), 404)


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "/runs"), ("GET", "/api/table"), ("PATCH", "/api/runs/run/marks"), ("DELETE", "/api/runs/run"),
        ("DELETE", "/api/trash"), ("POST", "/api/trash/run/restore"), ("GET", "/page/vendor/tables.js"),
    ],
)  # fmt: skip
def test_nothing_is_open_to_who_has_no_token_or_comes_from_elsewhere(served: Served, method: str, path: str) -> None:
    base = f"http://127.0.0.1:{served.port}"
    assert httpx.request(method, base + path).status_code == 401
    assert served.client.request(method, path, headers={"Origin": "http://evil.example"}).status_code == 403
