"""The example package in the studio: offered, started, watched and downloaded, beside packages that can't be used."""

import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect
from served import Server, events_of, wait_for
from test_episodes import choose
from test_studio import nodes_of, open_studio, press, robot_of, turn_to

from morph_core.protocol import Evaluation
from tests.packages import OWN_ROBOT, beside, install, write_package

TINY = {"trajectories": 8, "evaluation.episodes": 4, "ppo.minibatches": 1, "ppo.epochs": 1}
BROKEN = "[morph.searches]\nhooke = springs:Hooke\n"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the example is installed, and a package that can't be imported."""
    site = tmp_path_factory.mktemp("own_robot") / "site"
    install(OWN_ROBOT, site)
    write_package(site, "springs", BROKEN, "raise RuntimeError('no spring is attached')")
    return site


@pytest.fixture
def server(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """A studio that has found what is installed in `site`."""
    monkeypatch.setenv("PYTHONPATH", beside(site)["PYTHONPATH"])
    server = Server(tmp_path / "runs")
    try:
        server.start()
        yield server
    finally:
        server.stop()


@pytest.mark.browser
def test_a_task_of_another_package_is_started_watched_and_downloaded(server: Server, page: Page) -> None:
    api = f"http://127.0.0.1:{server.port}/api"
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    frame = open_studio(page, server)

    # It is offered, and what can't be used is named.
    listed = page.request.get(f"{api}/tasks").json()
    assert [task["name"] for task in listed["tasks"]][-1] == "own_throw"
    assert listed["methods"][-1] == "random_walk"
    settings = {field["name"]: field for field in listed["tasks"][-1]["settings"]["morph"]}
    assert settings["exploration"]["choices"][-1] == "uniform"
    assert settings["search"]["choices"][-1] == "scatter"
    assert settings["search.tries"]["only_with"] == "scatter"
    (broken,) = listed["broken"]
    assert (broken["name"], broken["package"]) == ("hooke", "springs 1.0")
    assert broken["reason"] == "RuntimeError: no spring is attached"
    expect(frame.get_by_text("no spring is attached").first).to_be_attached()
    choose(frame, "task", "own_throw")
    choose(frame, "search", "scatter")
    wait_for("a ball in the scene", lambda: "/objects/sphere" in nodes_of(frame), 30)

    refused = page.request.post(f"{api}/runs", data={"task": "own_throw", "settings": {"search.tries": 3}})
    assert refused.status == 422
    assert '"search.tries" does nothing with search cma, only with scatter' in refused.json()["detail"]
    order = {"task": "own_throw", "iterations": 3, "settings": TINY | {"search": "scatter", "evaluation.interval": 1}}
    answer = page.request.post(f"{api}/runs", data=order)
    assert answer.ok, answer.text()
    run = server.only_run()
    page.request.post(f"{api}/runs/{run.id}/show")
    wait_for("the last evaluation", lambda: len(events_of(run, Evaluation)) == 3, 120)

    # It is watched: the arm swings, the ball flies, and the numbers are those of its parts.
    expect(frame.get_by_text("φ searched by scatter").first).to_be_attached()
    expect(frame.get_by_text("Success: the ball touches the disc").first).to_be_attached()
    expect(frame.get_by_text("upper arm", exact=True).first).to_be_attached()
    expect(frame.get_by_text("printed parts", exact=True)).to_be_hidden()
    wanted = {"/objects/sphere", "/scenery/box", "/scenery/cylinder", "/ruler/lines"}
    wait_for("ball, floor and disc", lambda: wanted <= set(nodes_of(frame)), 30)
    posture = robot_of(frame)
    wait_for("a moving arm", lambda: robot_of(frame) != posture, 30)

    turn_to(frame, "Export")
    press(frame, "Check and prepare")
    expect(frame.get_by_text(re.compile(r"✓ \d+ comparisons agree"))).to_be_visible(timeout=200_000)
    with page.expect_download() as download:
        frame.get_by_role("button", name=re.compile("^Download ")).dispatch_event("click")
    with zipfile.ZipFile(download.value.path()) as bundle:
        names = set(bundle.namelist())
    assert {"robot.xml", "robot.urdf", "policy.npz", "run_policy.py", "provenance.json"} <= names
    assert [error for error in errors if "unsafe-eval" not in error] == []
