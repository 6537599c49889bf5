"""Two designs side by side: by function, by API, and on the command line."""

import json
from pathlib import Path

import msgspec
import pytest
from conftest import NAME, make_hand_run, make_run
from fastapi.testclient import TestClient

from morph_core.history import History
from morph_core.protocol import Evaluation
from morph_core.run_folder import EventLog, RunFolder, RunFolderError
from studio.app import create_app
from studio.cli import run as morph_studio
from studio.compare import Compared, compare, side_of, split_place
from studio.settings import Settings

OTHER = "20260102-000000-reacher-direct-s1"
HAND = "20260101-000000-hand-direct-s0"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Return a folder with two runs of the reacher, whose last iterations were evaluated, and one of a hand."""
    runs = tmp_path / "runs"
    for name, success, value in ((NAME, 0.5, -2.0), (OTHER, 0.75, -1.0)):
        folder = make_run(runs, name, ended="finished")
        log = EventLog(folder)
        log.append(
            Evaluation(
                iteration=2 if name == NAME else 3, env_steps=300, phi=[2.8 if name == NAME else 2.7] * 5,
                sampled_success=success, sampled_return=value, deterministic_success=0.0,
                deterministic_return=0.0, episodes=100,
                reward_terms={"distance": value - 1.0, "goal": 1.0}, return_interval=(value - 0.5, value + 0.5),
            )
        )  # fmt: skip
        log.close()
    make_hand_run(runs, "pen_press", HAND)
    return runs


def history(runs: Path, name: str) -> History:
    return History(RunFolder(runs / name))


def as_json(found: Compared) -> object:
    return msgspec.json.decode(msgspec.json.encode(found))


def test_two_designs_stand_side_by_side_with_their_differences(runs: Path) -> None:
    found = compare(history(runs, NAME), "2", history(runs, OTHER), "3")
    assert (found.a.run, found.a.iteration, found.b.run, found.b.iteration) == (NAME, 2, OTHER, 3)
    assert found.a.success_interval == pytest.approx((0.404, 0.596), abs=1e-3)  # Wilson's, of 50 of 100
    assert found.a.return_interval == (-2.5, -1.5)
    assert found.differences.success == pytest.approx(0.25)
    assert found.differences.episode_return == pytest.approx(1.0)
    assert found.differences.reward_terms == pytest.approx({"distance": 1.0, "goal": 0.0})
    assert found.differences.phi == pytest.approx({f"link_{i}": -0.1 for i in range(1, 6)})
    assert found.units == {f"link_{i}": "m" for i in range(1, 6)}
    assert found.a.mass == pytest.approx(sum(found.a.masses.values()))
    assert found.differences.mass is not None
    assert found.differences.mass < 0  # shorter links weigh less
    assert found.differences.masses.keys() == found.a.masses.keys()


def test_an_iteration_without_an_evaluation_says_which_one_has_one(runs: Path) -> None:
    side = side_of(history(runs, NAME), "1")
    assert (side.success, side.reward_terms) == (None, {})
    assert side.note == f"iteration 1 of {NAME} was not evaluated: the nearest evaluation is of iteration 2"
    found = compare(history(runs, NAME), "1", history(runs, OTHER), "3")
    assert (found.differences.success, found.differences.episode_return) == (None, None)


def test_a_run_that_did_not_write_down_its_episodes_has_no_interval(runs: Path) -> None:
    side = side_of(history(runs, NAME), "3")
    assert (side.success, side.success_interval) == (0.5, None)


def test_what_cant_be_compared_is_refused(runs: Path) -> None:
    with pytest.raises(ValueError, match=f"{NAME} is of reacher, {HAND} of pen_press; choose two runs of one task"):
        compare(history(runs, NAME), "best", history(runs, HAND), "best")
    with pytest.raises(RunFolderError, match="choose best, latest or 0 to 3"):
        compare(history(runs, NAME), "9", history(runs, OTHER), "best")


def test_a_place_is_a_run_with_or_without_a_design() -> None:
    assert split_place("a-run@40") == ("a-run", "40")
    assert split_place("a-run") == ("a-run", "best")


def test_the_api_compares_and_refuses(runs: Path) -> None:
    token = "a-token-of-these-tests"
    app = create_app(Settings(runs=runs, token=token, open_browser=False))
    client = TestClient(app, base_url="http://127.0.0.1", headers={"Authorization": f"Bearer {token}"})
    answer = client.get("/api/compare", params={"a": f"{NAME}@2", "b": f"{OTHER}@best"})
    assert answer.status_code == 200, answer.text
    assert answer.json() == as_json(compare(history(runs, NAME), "2", history(runs, OTHER), "best"))
    refused = client.get("/api/compare", params={"a": NAME, "b": HAND})
    assert (refused.status_code, "different tasks" in refused.json()["detail"]) == (422, True)
    assert client.get("/api/compare", params={"a": NAME, "b": "nothing"}).status_code == 404
    assert client.get("/api/compare", params={"a": NAME, "b": f"{OTHER}@77"}).status_code == 404
    assert client.get("/api/compare", params={"a": NAME}).status_code == 422


def test_the_command_line_compares_and_refuses(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert morph_studio(["compare", f"{NAME}@2", OTHER, "--runs", str(runs), "--json"]) == 0
    found = compare(history(runs, NAME), "2", history(runs, OTHER), "best")
    assert json.loads(capsys.readouterr().out) == as_json(found)
    assert morph_studio(["compare", f"{NAME}@2", OTHER, "--runs", str(runs)]) == 0
    lines = {" ".join(line.split()) for line in capsys.readouterr().out.splitlines()}
    assert f"A: {NAME}, iteration 2, 100 episodes" in lines
    assert "success [95 %] 0.500 [0.40, 0.60] 0.750 [0.66, 0.82] +0.250" in lines
    assert "link_1 [m] 2.800 2.700 -0.100" in lines
    for words, sentence in (
        ([NAME, HAND], "different tasks"),
        ([f"{NAME}@x", OTHER], "choose best, latest"),
        (["no", OTHER], "unknown run"),
    ):
        assert morph_studio(["compare", *words, "--runs", str(runs)]) == 2
        assert sentence in capsys.readouterr().err
