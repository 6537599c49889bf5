"""A finished run is no dead end: a person branches from it in the browser, and sees both in a tree."""

import re
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect
from served import Server, events_of, wait_for
from test_studio import enter, open_studio, press, turn_to, viewer_of

from morph_core.protocol import Progress, StateChanged
from morph_core.run_folder import RunFolder, list_runs
from morph_core.train import Trainer
from studio.new_run import StartRun, prepare_run

pytestmark = pytest.mark.browser
TINY: dict[str, object] = {
    "trajectories": 4,
    "proxy.prefit": 5,
    "hidden": 8,
    "evaluation.interval": 2,
    "evaluation.episodes": 2,
}


def finished_run(runs: Path) -> RunFolder:
    folder = prepare_run(runs, StartRun(task="reacher", iterations=4, settings=TINY))
    Trainer(folder).run()
    (folder.path / "heartbeat.json").unlink()  # it says that this process is the trainer
    return folder


def test_a_person_branches_from_a_finished_run(server: Server, page: Page) -> None:
    parent = finished_run(server.runs)
    open_studio(page, server)
    shown = page.request.post(
        f"http://127.0.0.1:{server.port}/api/runs/{parent.id}/show",
        headers={"Origin": f"http://127.0.0.1:{server.port}"},
    )
    assert shown.ok, shown.text()
    frame = viewer_of(page)
    press(frame, "Branch from here (iteration 4)")
    expect(frame.get_by_text(f"branches at iteration 4 of {parent.id}")).to_be_attached()
    enter(frame.locator("body"), "further iterations", 3)
    enter(frame.locator("body"), "α", 0.5)
    press(frame, "Start")

    names = wait_for("the branch", lambda: [name for name in list_runs(server.runs) if name != parent.id], 20)
    branch = RunFolder(server.runs / names[0])
    record = branch.record()
    assert (record.begins_at, record.iterations, record.config["alpha"]) == (4, 7, 0.5)
    wait_for("its end", lambda: [e for e in events_of(branch, StateChanged) if e.status == "finished"], 90)
    assert [progress.iteration for progress in events_of(branch, Progress)] == [5, 6, 7]

    turn_to(frame, "Log")
    expect(frame.get_by_text(re.compile(f"branched at iteration 4 of {parent.id}"))).to_be_visible()
    tree = frame.get_by_text("Branches").locator("xpath=ancestor::div[2]")
    expect(tree.get_by_text(branch.id)).to_be_attached()
    expect(frame.get_by_text(parent.id).first).to_be_attached()
