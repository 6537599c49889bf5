"""The API says what there is, does what it is asked, and refuses with a sentence what it can't do."""

import contextlib
import io
import json
import re
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import httpx
import hypothesis
import numpy as np
import pytest
from conftest import TOKEN, Served, eventually, make_run, serving
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from hypothesis.errors import Unsatisfiable

from morph_core.catalogue import make_method, make_task
from morph_core.config import paths_of
from morph_core.presets import PRESETS
from morph_core.protocol import Pause, StateChanged
from morph_core.run_folder import EventLog, RunFolder
from studio.settings import Settings

HEALTHY = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.filter_too_much]
TYPES = (
    "pause", "resume", "step", "stop", "checkpoint", "set_alpha", "set_projection", "set_bound", "lock", "unlock",
    "inject_design",
)  # fmt: skip


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """One server for all: each test brings runs of its own."""
    folder = tmp_path_factory.mktemp("api")
    with serving(Settings(port=0, runs=folder / "runs", token=TOKEN, hosts=(), state=folder)) as running:
        yield running


@pytest.fixture(scope="module")
def run_id(served: Served) -> str:
    """A run whose stand-in is at work."""
    made = served.client.post("/api/runs", json={"task": "reacher", "seed": 3, "settings": {"alpha": 0.5}})
    assert made.status_code == 201, made.text
    name = made.json()["id"]
    assert eventually(lambda: served.client.get(f"/api/runs/{name}").json()["status"] == "running")
    return name


@pytest.fixture
def ended(served: Served) -> RunFolder:
    """A run of three iterations that nobody else uses."""
    return make_run(served.runs.folder, f"ended-{len(served.runs.ids())}")


def names(served: Served) -> list[str]:
    return [line["id"] for line in served.client.get("/api/runs").json()]


def inbox(served: Served, run_id: str) -> int:
    """Return how many commands the run has been sent so far."""
    run = served.client.get(f"/api/runs/{run_id}").json()
    return len(run["acknowledged"]) + len(list(RunFolder(served.runs.folder / run_id).commands.glob("[0-9]*")))


def refused(answer: httpx.Response, status: int = 422) -> str:
    assert answer.status_code == status, answer.text
    detail = answer.json()["detail"]
    assert isinstance(detail, str)
    assert len(detail) > 10
    return detail


# --- tasks ------------------------------------------------------------------------------------------------------------


def test_tasks_come_with_everything_a_form_needs(served: Served) -> None:
    answer = served.client.get("/api/tasks").json()
    assert set(answer["methods"]) == {"morph", "no_hw_opt", "direct", "cmaes_rl", "transform2act", "value_gradient"}
    (reacher,) = (task for task in answer["tasks"] if task["name"] == "reacher")
    options = {option["name"]: option for option in reacher["options"]}
    assert options["tunnel"]["choices"] == ["zigzag", "paper"]
    assert options["tunnel"]["default"] == "zigzag"
    settings = {field["name"]: field for field in reacher["settings"]["morph"]}
    assert settings["alpha"] == {
        "name": "alpha", "type": "float", "default": 1.0, "choices": None, "lo": 0.0, "hi": 1e6,
        "range": "≥ 0, ≤ 1000000",
        "only_with": None,
        "doc": "alpha: weight of the divergence between proxy and Hw-Phy in Eq. 2.",
    }  # fmt: skip
    assert settings["exploration"]["choices"] == ["design", "gaussian", "gaussian_iid"]
    assert (settings["search.ridge"]["only_with"], settings["exploration.noise"]["only_with"]) == (
        "drift",
        "gaussian_iid",
    )
    assert set(dict(paths_of(make_method("morph", make_task("reacher"))))) <= set(settings)
    assert "alpha" not in {field["name"] for field in reacher["settings"]["no_hw_opt"]}
    assert all(field["doc"] for fields in reacher["settings"].values() for field in fields)
    assert list(answer["method_titles"]) == answer["methods"]
    assert all(answer["method_titles"].values())
    assert answer["broken"] == []
    assert [p["name"] for p in reacher["parameters"]] == [f"link_{i}" for i in range(1, 6)]
    assert answer["tasks"][0] == reacher  # what the page shows first
    assert reacher["z_unit"] == "m"


def test_a_hand_says_what_it_can_be_run_with(served: Served) -> None:
    tasks = {task["name"]: task for task in served.client.get("/api/tasks").json()["tasks"]}
    hand = tasks["pen_press"]
    settings = {field["name"]: field for field in hand["settings"]["morph"]}
    assert (settings["exploration"]["choices"], hand["z_unit"]) == (["design"], "")
    assert settings["search"]["choices"] == ["cma", "cma_debiased", "drift"]  # its Hw-Phy has no gradient
    options = {option["name"]: option for option in hand["options"]}
    assert options["grasp"]["choices"] == ["any_two", "two_besides_presser"]
    assert all(option["doc"] for option in options.values())  # those that it has from the common hand too
    answer = served.client.post("/api/runs", json={"task": "pen_press", "settings": {"exploration": "gaussian"}})
    assert answer.status_code == 422
    assert 'choose from: "design"' in answer.json()["detail"]


# --- runs -------------------------------------------------------------------------------------------------------------


def test_a_started_run_is_listed_and_shown(served: Served, run_id: str) -> None:
    served.client.post(f"/api/runs/{run_id}/show")
    (line,) = (line for line in served.client.get("/api/runs").json() if line["current"])
    assert (line["id"], line["seed"]) == (run_id, 3)
    run = served.client.get(f"/api/runs/{run_id}").json()
    assert run["config"]["alpha"] == 0.5
    assert run["phi"] == [3.0] * 5
    assert eventually(lambda: served.viewer.shown and served.viewer.shown[-1][2] == run_id)


def test_a_preset_is_told_and_taken(served: Served) -> None:
    presets = {preset["name"]: preset for preset in served.client.get("/api/tasks").json()["presets"]}
    assert presets["paper"] == {"name": "paper", "meaning": PRESETS["paper"].meaning, "method": "morph"}
    wish = {"task": "reacher", "preset": "paper", "settings": {"projection": "none"}}
    config = served.client.post("/api/runs", json=wish).json()["config"]
    assert (config["exploration"]["name"], config["projection"], config["freeze_success"]) == ("gaussian", "none", 0.8)


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ({"task": "reach"}, "choose from: "),
        ({"task": "reacher", "method": "magic"}, "choose from: morph"),
        ({"task": "reacher", "settings": {"alfa": 1}}, "choose from: "),
        ({"task": "reacher", "settings": {"alpha": "1"}}, "alpha must be a number"),
        ({"task": "reacher", "settings": {"trajectories": 7}}, "trajectories must be a multiple of 2"),
        ({"task": "reacher", "task_options": {"tunnel": ["zigzag"]}}, "choose from: zigzag, paper"),
        ({"task": "reacher", "preset": "letter"}, 'unknown preset "letter"; choose from: studio, paper'),
        ({"task": "reacher", "preset": "paper", "method": "direct"}, "one of the method morph, not of direct"),
        ({"task": "reacher", "iterations": 0}, "iterations"),
        ({"task": "reacher", "seed": -1}, "seed"),
        ({"task": "reacher", "colour": "red"}, "colour"),
        ({}, "task"),
        ([], "Expected `object`"),
    ],
)
def test_a_run_that_can_not_be_is_refused_and_not_made(served: Served, body: object, sentence: str) -> None:
    before = names(served)
    assert sentence in refused(served.client.post("/api/runs", json=body))
    assert names(served) == before


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "1" * 400])
def test_numbers_that_json_does_not_have_are_refused(served: Served, run_id: str, number: str) -> None:
    sent, before = inbox(served, run_id), names(served)
    start = '{"task": "reacher", "settings": {"alpha": NUMBER}}'
    refused(served.client.post("/api/runs", content=start.replace("NUMBER", number)))
    for command in (
        '{"type": "set_alpha", "alpha": NUMBER}',
        '{"type": "lock", "name": "link_1", "value": NUMBER}',
        '{"type": "set_bound", "name": "link_1", "lo": 1, "hi": NUMBER}',
        '{"type": "inject_design", "phi": [1, 1, 1, 1, NUMBER]}',
    ):
        refused(served.client.post(f"/api/runs/{run_id}/commands", content=command.replace("NUMBER", number)))
    assert inbox(served, run_id) == sent
    assert names(served) == before


@pytest.mark.parametrize("content", [b"", b"{", b"null", b"\xff", b"[" * 100_000, b'"pause"', b'{"type": "explode"}'])
def test_what_is_no_command_is_refused(served: Served, run_id: str, content: bytes) -> None:
    refused(served.client.post(f"/api/runs/{run_id}/commands", content=content))


def test_a_body_that_is_too_long_is_refused(served: Served, run_id: str) -> None:
    assert served.client.post(f"/api/runs/{run_id}/commands", content=b" " * (2 << 20)).status_code == 413


def test_an_unknown_run_lists_the_choices_on_every_route(served: Served, ended: RunFolder) -> None:
    for method, rest in (
        ("GET", ""), ("POST", "/commands"), ("POST", "/resume"), ("POST", "/show"), ("GET", "/events"),
        ("GET", "/metrics"), ("GET", "/designs"), ("GET", "/episodes/3"), ("GET", "/designs/best/export"),
        ("GET", "/evolution.html"),
    ):  # fmt: skip
        content = b'{"type": "pause"}' if rest == "/commands" else None
        answer = served.client.request(method, f"/api/runs/nobody{rest}", content=content)
        assert ended.id in refused(answer, 404), rest


@pytest.mark.parametrize("name", ["..", "%2e%2e", "..%2f..%2fetc", "%00", "a" * 300, "%E2%80%AE", "..\\x"])
def test_a_name_that_leads_elsewhere_is_no_run(served: Served, name: str) -> None:
    assert served.client.get(f"/api/runs/{name}/metrics").status_code in (404, 400)


# --- commands ---------------------------------------------------------------------------------------------------------


def test_a_command_is_numbered_and_acknowledged(served: Served, run_id: str) -> None:
    sent = inbox(served, run_id)
    answer = served.client.post(f"/api/runs/{run_id}/commands", json={"type": "pause"})
    assert (answer.status_code, answer.json()) == (202, {"id": sent + 1})
    assert eventually(lambda: served.client.get(f"/api/runs/{run_id}").json()["status"] == "paused")
    said = served.client.get(f"/api/runs/{run_id}").json()["acknowledged"][-1]
    assert (said["id"], said["accepted"], said["command"]) == (sent + 1, True, {"type": "pause"})


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ({"type": "set_bound", "name": "link_1", "lo": 3, "hi": 2}, "the lower bound of link_1 must be below"),
        ({"type": "set_bound", "name": "link_1", "lo": 1, "hi": 9}, "inside [0.05, 5] m"),
        ({"type": "set_bound", "name": "arm", "lo": 1, "hi": 2}, "choose from: link_1"),
        ({"type": "lock", "name": "link_1", "value": -1}, "inside [0.05, 5] m"),
        ({"type": "unlock", "name": "link_7"}, "choose from: link_1"),
        ({"type": "set_alpha", "alpha": -0.1}, "must lie in [0, 1000000]"),
        ({"type": "set_projection", "projection": "up"}, "projection"),
        ({"type": "inject_design", "phi": [1, 2]}, "5 are needed"),
        ({"type": "pause", "now": True}, "now"),
    ],
)
def test_a_command_that_can_not_be_is_refused_in_words(
    served: Served, run_id: str, command: dict[str, object], sentence: str
) -> None:
    sent = inbox(served, run_id)
    assert sentence in refused(served.client.post(f"/api/runs/{run_id}/commands", json=command))
    assert inbox(served, run_id) == sent


def test_a_run_that_has_ended_says_that_it_takes_no_commands(served: Served, ended: RunFolder) -> None:
    answer = served.client.post(f"/api/runs/{ended.id}/commands", json={"type": "pause"})
    assert "is stopped: resume it" in refused(answer)


def test_resume_starts_a_trainer_once(served: Served, ended: RunFolder) -> None:
    assert served.client.post(f"/api/runs/{ended.id}/resume").status_code == 202
    assert "has a trainer already" in refused(served.client.post(f"/api/runs/{ended.id}/resume"))
    assert refused(served.client.post(f"/api/runs/{ended.id}/resume", json={"further": 0}))


def test_the_viewer_shows_what_the_page_has_chosen(served: Served, ended: RunFolder) -> None:
    assert served.client.get(f"/api/runs/{ended.id}").json()["current"] is False
    assert served.client.post(f"/api/runs/{ended.id}/show").json()["current"] is True
    assert eventually(lambda: served.viewer.turned_to[-1:] == [(ended.id, None)])


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=4,
)
commands = st.fixed_dictionaries(
    {"type": st.sampled_from(TYPES)},
    optional={name: values for name in ("alpha", "projection", "name", "lo", "hi", "value", "phi", "x")},
)


@given(commands)
@hypothesis.settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_command_makes_the_server_stumble(served: Served, ended: RunFolder, command: dict[str, Any]) -> None:
    answer = served.client.post(f"/api/runs/{ended.id}/commands", content=json.dumps(command))
    refused(answer)
    assert list(ended.commands.iterdir()) == []


@given(st.dictionaries(st.sampled_from(["task", "method", "seed", "settings", "task_options", "parameters"]), values))
@hypothesis.settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_wish_makes_the_server_stumble(served: Served, wish: dict[str, Any]) -> None:
    refused(served.client.post("/api/runs", content=json.dumps(wish)))


# --- results ----------------------------------------------------------------------------------------------------------


def test_metrics_are_the_traces_of_the_run(served: Served, ended: RunFolder) -> None:
    metrics = served.client.get(f"/api/runs/{ended.id}/metrics").json()
    assert [p["iteration"] for p in metrics["progress"]] == [1, 2, 3]
    assert [e["sampled_success"] for e in metrics["evaluations"]] == [0.5]


def test_designs_are_the_evolution_of_phi(served: Served, ended: RunFolder) -> None:
    designs = served.client.get(f"/api/runs/{ended.id}/designs").json()
    assert designs["names"] == [f"link_{i}" for i in range(1, 6)]
    assert designs["units"] == ["m"] * 5
    assert (designs["best"], designs["latest"]) == (3, 3)
    assert [d["iteration"] for d in designs["designs"]] == [0, 1, 2, 3]
    assert designs["designs"][3]["phi"] == pytest.approx([2.7] * 5)


def test_a_rollout_comes_as_it_was_recorded(served: Served, ended: RunFolder) -> None:
    answer = served.client.get(f"/api/runs/{ended.id}/episodes/3")
    assert np.load(io.BytesIO(answer.content), allow_pickle=False)["qpos"].shape == (4, 5)


@pytest.mark.parametrize("iteration", ["4", "-1", "x", "9" * 30, "³", "..%2f..%2frun.json"])
def test_a_rollout_that_is_not_there_lists_the_choices(served: Served, ended: RunFolder, iteration: str) -> None:
    answer = served.client.get(f"/api/runs/{ended.id}/episodes/{iteration}")
    assert answer.status_code == 404
    if "%2f" not in iteration:
        assert "choose from: 3" in refused(answer, 404)


def test_a_rollout_that_links_elsewhere_is_not_followed(served: Served, ended: RunFolder, tmp_path: Path) -> None:
    secret = tmp_path / "secret.npz"
    secret.write_bytes(b"secret")
    ended.episode(7).symlink_to(secret)
    assert "no plain file" in refused(served.client.get(f"/api/runs/{ended.id}/episodes/7"), 404)


def test_the_evolution_is_downloaded_as_a_page_and_never_opened_as_one_of_ours(
    served: Served, ended: RunFolder
) -> None:
    answer = served.client.get(f"/api/runs/{ended.id}/evolution.html")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-disposition"] == f'attachment; filename="{ended.id}-evolution.html"'
    assert answer.text.startswith("<!doctype html>")
    again = served.client.get(f"/api/runs/{ended.id}/evolution.html", params={"beside": ended.id})
    assert "a run stands beside others once" in refused(again)
    unknown = served.client.get(f"/api/runs/{ended.id}/evolution.html?beside=nobody")
    assert 'unknown run "nobody"; choose from: ended-' in refused(unknown, 404)


def test_an_export_is_a_zip_with_mjcf_urdf_and_provenance(served: Served, ended: RunFolder) -> None:
    answer = served.client.get(f"/api/runs/{ended.id}/designs/best/export")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/zip"
    assert ".zip" in answer.headers["content-disposition"]
    names = zipfile.ZipFile(io.BytesIO(answer.content)).namelist()
    assert any(name.endswith(".xml") for name in names)
    assert any(name.endswith(".urdf") for name in names)
    assert any(name.endswith("provenance.json") for name in names)


def test_what_an_export_would_hold_can_be_seen_before_it_is_downloaded(served: Served, ended: RunFolder) -> None:
    answer = served.client.get(f"/api/runs/{ended.id}/designs/best/export/checks", params={"formats": "urdf,stl"})
    assert answer.status_code == 200, answer.text
    checked = answer.json()
    assert checked["name"].endswith(".zip")
    assert {"robot.urdf", "parts/link_1.stl"} <= {file["path"] for file in checked["files"]}
    assert all(check["passed"] for check in checked["checks"])
    assert any("mass of link_1" in check["name"] for check in checked["checks"])


def test_a_design_is_brought_into_a_run_and_starts_another(served: Served, ended: RunFolder) -> None:
    bundle = served.client.get(f"/api/runs/{ended.id}/designs/best/export", params={"formats": "urdf"}).content
    started = served.client.post("/api/designs", content=bundle, params={"seed": 3, "method": "no_hw_opt"})
    assert started.status_code == 201, started.text
    state = started.json()
    assert (state["task"], state["seed"], state["method"]) == ("reacher", 3, "no_hw_opt")
    assert [p["initial"] for p in state["parameters"]] == pytest.approx([2.7] * 5)
    assert eventually(lambda: served.client.get(f"/api/runs/{state['id']}").json()["status"] == "running")
    with zipfile.ZipFile(io.BytesIO(bundle)) as archive:
        design = archive.read("design.json")
    sent = served.client.post(f"/api/runs/{state['id']}/designs", content=design)
    assert sent.status_code == 202, sent.text

    def injected() -> bool:
        answers = served.client.get(f"/api/runs/{state['id']}").json()["acknowledged"]
        return any(a["command"] == {"type": "inject_design", "phi": pytest.approx([2.7] * 5)} for a in answers)

    assert eventually(injected)


@pytest.mark.parametrize("body", [b"", b"<mujoco/>", b"[]", b"PK\x03\x04", b'{"kind": "morph-studio design"}'])
def test_what_is_no_design_is_refused(served: Served, ended: RunFolder, body: bytes) -> None:
    for path in ("/api/designs", f"/api/runs/{ended.id}/designs"):
        refused(served.client.post(path, content=body))


def test_an_export_can_be_of_one_format(served: Served, ended: RunFolder) -> None:
    answer = served.client.get(f"/api/runs/{ended.id}/designs/0/export", params={"formats": "mjcf"})
    assert not any(name.endswith(".urdf") for name in zipfile.ZipFile(io.BytesIO(answer.content)).namelist())
    refused(served.client.get(f"/api/runs/{ended.id}/designs/0/export", params={"formats": "dwg"}))
    answer = served.client.get(f"/api/runs/{ended.id}/designs/0/export", params={"printer": "prusa"})
    assert "choose from: bambu_a1_mini" in refused(answer)


@pytest.mark.parametrize("which", ["4", "worst", "-1", "9" * 50, "²"])
def test_an_unknown_design_lists_the_choices(served: Served, ended: RunFolder, which: str) -> None:
    assert "choose" in refused(served.client.get(f"/api/runs/{ended.id}/designs/{which}/export"), 404)


# --- events -----------------------------------------------------------------------------------------------------------


def sent_events(answer: httpx.Response) -> Iterator[dict[str, Any]]:
    for line in answer.iter_lines():
        if line.startswith("data: "):
            yield json.loads(line.removeprefix("data: "))


def test_events_come_in_order_and_can_be_taken_up_again(served: Served, ended: RunFolder) -> None:
    url = f"/api/runs/{ended.id}/events"
    whole = served.client.get(url, params={"follow": False})
    assert whole.headers["content-type"].startswith("text/event-stream")
    assert [event["seq"] for event in sent_events(whole)] == [1, 2, 3, 4, 5, 6]
    assert "event: progress\n" in whole.text
    rest = served.client.get(url, params={"follow": False, "after": 4})
    assert [event["seq"] for event in sent_events(rest)] == [5, 6]
    again = served.client.get(url, params={"follow": False}, headers={"Last-Event-ID": "5"})
    assert [event["seq"] for event in sent_events(again)] == [6]


def test_events_go_on_live(served: Served, ended: RunFolder) -> None:
    with served.client.stream("GET", f"/api/runs/{ended.id}/events", params={"after": 6}) as answer:
        EventLog(ended).append(StateChanged(status="running", iteration=3, message="live"))
        begin = time.monotonic()
        assert next(sent_events(answer))["message"] == "live"
        assert time.monotonic() - begin < 2.0


@pytest.mark.parametrize("after", ["-1", "x", "1e3", "9" * 40])
def test_an_odd_start_of_events_is_refused(served: Served, ended: RunFolder, after: str) -> None:
    assert "after" in refused(served.client.get(f"/api/runs/{ended.id}/events", params={"after": after}))


# --- trouble ----------------------------------------------------------------------------------------------------------


def test_an_unreadable_run_is_a_line_of_the_list_and_a_reason(served: Served, ended: RunFolder) -> None:
    (served.runs.folder / "torn").mkdir()
    (served.runs.folder / "torn" / "run.json").write_text("{")
    lines = {line["id"]: line for line in served.client.get("/api/runs").json()}
    assert lines["torn"]["status"] == "unreadable"
    assert "run.json" in lines["torn"]["reason"]
    assert served.client.get("/api/runs/torn").json()["status"] == "unreadable"
    assert "run.json" in refused(served.client.get("/api/runs/torn/metrics"), 404)
    assert served.client.get(f"/api/runs/{ended.id}/metrics").status_code == 200


def test_a_disk_that_refuses_is_told_and_the_server_lives(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    before = names(served)
    monkeypatch.setattr("studio.new_run.create_run", full)
    said = refused(served.client.post("/api/runs", json={"task": "reacher"}), 503)
    assert said == f"the disk refuses: No space left on device: make room where the runs are, or in {gettempdir()}"
    assert names(served) == before


def test_the_docs_list_every_route_and_need_no_other_server(served: Served) -> None:
    page = served.client.get("/docs")
    schema = served.client.get("/openapi.json").json()
    assert page.status_code == 200
    assert all(path in page.text for path in schema["paths"])
    assert "http://" not in page.text.replace("http://www.w3.org", "")
    assert re.findall("<script[^>]*>", page.text) == ['<script src="page/theme.js">']
    assert {"StartRun", "Summary", "Progress", Pause.__name__} <= set(schema["components"]["schemas"])


@pytest.mark.slow
def test_schemathesis_finds_no_server_error(served: Served, ended: RunFolder) -> None:
    """Values that the schema allows and some that it does not; the run in the path is a real one half of the time."""
    import schemathesis

    schema = schemathesis.openapi.from_dict(served.client.get("/openapi.json").json())
    answers: list[int] = []
    for found in schema.get_all_operations():
        operation: Any = found
        for mode in ("positive", "negative"):
            _fuzz(operation.ok(), schemathesis.GenerationMode(mode), served, ended.id, answers)
    assert len(answers) > 300
    assert max(answers) < 500


def _fuzz(operation: Any, mode: Any, served: Served, run_id: str, answers: list[int]) -> None:
    @given(case=operation.as_strategy(generation_mode=mode), real=st.booleans())
    @hypothesis.settings(max_examples=25, deadline=None, suppress_health_check=HEALTHY, database=None)
    def fuzz(case: Any, real: bool) -> None:
        if real and "run_id" in (case.path_parameters or {}):
            case.path_parameters["run_id"] = run_id
        if operation.path.endswith("/events"):
            case.query = {**(case.query or {}), "follow": "false"}
        answer = case.call(base_url=str(served.client.base_url), headers=dict(served.client.headers), timeout=20)
        answers.append(answer.status_code)

    with contextlib.suppress(Unsatisfiable):  # a route without parameters has nothing to get wrong
        fuzz()
