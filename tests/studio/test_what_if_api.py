"""What-if questions by the API: answers, refusals, and what becomes of them when the one who asked leaves."""

import json
import os
import signal
import threading
from collections.abc import Iterator

import httpx
import pytest
from conftest import TOKEN, Served, add_checkpoint, eventually, make_run, serving

from studio.settings import Settings

RUN = "with-a-policy"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("api")
    add_checkpoint(make_run(folder / "runs", RUN), 2)
    with serving(Settings(port=0, runs=folder / "runs", token=TOKEN, hosts=(), state=folder)) as running:
        yield running


def ask(served: Served, wish: object, what: str = "evaluate", run: str = RUN) -> httpx.Response:
    return served.client.post(f"/api/runs/{run}/{what}", json=wish)


def events(answer: httpx.Response) -> list[tuple[str, dict]]:
    blocks = [block.split("\n") for block in answer.text.strip().split("\n\n")]
    return [(kind.removeprefix("event: "), json.loads(data.removeprefix("data: "))) for kind, data in blocks]


def test_a_design_is_evaluated(served: Served) -> None:
    answer = ask(served, {"design": "3", "phi": {"link_2": 1.0}, "episodes": 4, "seed": 1})
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert found["phi"] == {"link_1": 2.7, "link_2": 1.0, "link_3": 2.7, "link_4": 2.7, "link_5": 2.7}
    assert (found["run"], found["iteration"], found["policy_iteration"], found["episodes"]) == (RUN, 3, 2, 4)
    assert "nearest before" in found["note"]
    assert found["success_interval"][0] <= found["success"] <= found["success_interval"][1]
    assert ask(served, {"design": "3", "phi": [2.7, 1.0, 2.7, 2.7, 2.7], "episodes": 4, "seed": 1}).json() == found
    assert ask(served, {"episodes": 4}).json()["iteration"] == 3


@pytest.mark.parametrize("what", ["evaluate", "sensitivity"])
@pytest.mark.parametrize(
    ("wish", "status", "said"),
    [
        ({"design": "1"}, 404, "no checkpoint up to iteration 1"),
        ({"design": "7"}, 404, "no iteration 7"),
        ({"phi": {"link_7": 1.0}}, 422, "choose from: link_1"),
        ({"phi": {"link_1": 7.0}}, 422, "link_1 must lie inside [0.05, 5] m, not 7"),
        ({"phi": [1.0]}, 422, "5 are needed"),
        ({"episodes": 0}, 422, "episodes"),
        ({"policy": "best"}, 422, "policy"),
        ({"epsiodes": 3}, 422, "epsiodes"),
    ],
)
def test_what_is_not_allowed_is_refused_in_a_sentence(
    served: Served, what: str, wish: object, status: int, said: str
) -> None:
    answer = ask(served, wish, what)
    assert answer.status_code == status, answer.text
    assert said in answer.json()["detail"]


def test_nan_is_no_design(served: Served) -> None:
    body = '{"phi": [NaN, 1, 1, 1, 1]}'
    answer = served.client.post(f"/api/runs/{RUN}/evaluate", content=body)
    assert answer.status_code == 422
    assert "can't be used" in answer.json()["detail"]


def test_an_unknown_run_is_a_404(served: Served) -> None:
    assert ask(served, {}, run="nope").status_code == ask(served, {}, "sensitivity", "nope").status_code == 404


def test_a_design_that_cant_be_put_together_is_refused(served: Served) -> None:
    from conftest import make_hand_run

    add_checkpoint(make_hand_run(served.runs.folder, "pen_press", "hand"), 1)
    answer = ask(served, {"phi": {"angle_1": 0.0, "angle_2": 0.0}}, run="hand")
    assert answer.status_code == 422, answer.text
    assert len(answer.json()["detail"]) > 20


def test_a_sweep_is_told_point_by_point(served: Served) -> None:
    told = events(ask(served, {"episodes": 1}, "sensitivity"))
    assert [kind for kind, _ in told] == ["point"] * 45 + ["done"]
    point = told[0][1]
    assert (point["number"], point["of"], point["parameter"], point["unit"]) == (1, 45, "link_1", "m")
    assert set(point["measured"]) >= {"success", "success_interval", "episode_return", "reward_terms"}


def test_a_changed_design_is_exported(served: Served) -> None:
    phi = [2.0, 1.0, 1.5, 2.5, 3.5]
    query = {"phi": phi, "formats": "urdf"}
    answer = served.client.get(f"/api/runs/{RUN}/designs/3/export/checks", params=query)
    assert answer.status_code == 200, answer.text
    assert answer.json()["name"] == f"{RUN}-000003-changed-by-hand.zip"
    assert served.client.get(f"/api/runs/{RUN}/designs/3/export", params={"phi": [9.0] * 5}).status_code == 422


def test_whoever_leaves_cancels_what_was_asked(served: Served) -> None:
    evaluator = served.app.state.evaluator
    with pytest.raises(httpx.ReadTimeout):
        served.client.post(f"/api/runs/{RUN}/evaluate", json={"episodes": 10_000}, timeout=0.5)
    assert eventually(lambda: evaluator._at_work is None)
    with served.client.stream("POST", f"/api/runs/{RUN}/sensitivity", json={"episodes": 10_000}):
        assert eventually(lambda: evaluator._at_work is not None)
    assert eventually(lambda: evaluator._at_work is None and not evaluator._waiting)


def test_a_process_that_dies_is_told_and_the_server_goes_on(served: Served) -> None:
    evaluator = served.app.state.evaluator
    assert ask(served, {"episodes": 1}).status_code == 200

    def kill_at_work() -> None:
        assert eventually(lambda: evaluator._at_work is not None)
        os.kill(evaluator._process._child.pid, signal.SIGKILL)

    threading.Thread(target=kill_at_work).start()
    answer = ask(served, {"episodes": 10_000})
    assert answer.status_code == 503
    assert "killed by signal 9" in answer.json()["detail"]
    assert ask(served, {"episodes": 1}).status_code == 200
    threading.Thread(target=kill_at_work).start()
    kind, failed = events(ask(served, {"episodes": 10_000}, "sensitivity"))[-1]
    assert kind == "failed"
    assert "killed by signal 9" in failed["detail"]


def test_the_process_ends_with_the_server(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("ends")
    add_checkpoint(make_run(folder / "runs", RUN), 2)
    with serving(Settings(port=0, runs=folder / "runs", token=TOKEN, hosts=(), state=folder)) as running:
        assert ask(running, {"episodes": 1}).status_code == 200
        child = running.app.state.evaluator._process._child
    assert child.wait(30) == -signal.SIGKILL
