"""Exports take seconds: few are made at once, some wait, and further ones are refused; nobody else waits for them."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import pytest

from studio import app
from studio.export.bundle import Bundle
from studio.settings import Settings
from studio.turns import AT_ONCE, MOST_WAITING, BusyError, Turns
from tests.studio.conftest import TOKEN, Served, make_run, serving


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with serving(Settings(port=0, runs=tmp_path / "runs", token=TOKEN, hosts=(), state=tmp_path)) as running:
        yield running


def test_a_flood_of_exports_is_refused_with_a_sentence_and_others_are_served(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    done, at_work = threading.Event(), list[int]()

    def build(*_: object) -> Bundle:
        at_work.append(1)
        done.wait(20)
        return Bundle("design.zip", {}, [], b"zip")

    monkeypatch.setattr(app, "build_bundle", build)
    run = make_run(served.runs.folder, "20260101-a", ended="finished").id
    most = AT_ONCE + MOST_WAITING
    with ThreadPoolExecutor(most + 1) as crowd:
        asked = [crowd.submit(served.client.get, f"/api/runs/{run}/designs/best/export") for _ in range(most + 1)]
        try:
            refused = next(as_completed(asked, 20)).result()
            assert refused.status_code == 503
            assert refused.headers["retry-after"] == "60"
            assert "try again in a minute" in refused.json()["detail"]
            assert served.client.get(f"/api/runs/{run}/evolution.html").status_code == 503, "it takes its turn as well"
            assert served.client.get("/api/runs").status_code == 200
            assert len(at_work) == AT_ONCE
        finally:
            done.set()
        assert sorted(answer.result().status_code for answer in asked) == [200] * most + [503]
    assert served.client.get(f"/api/runs/{run}/designs/best/export").status_code == 200


def test_a_turn_is_given_back_whatever_happens() -> None:
    turns = Turns(1, 0)
    for _ in range(3):
        with pytest.raises(ZeroDivisionError), turns.turn():
            raise ZeroDivisionError
    with turns.turn(), pytest.raises(BusyError), turns.turn():
        pass
