"""The recipes of CONTRIBUTING: what they show is written into a package, and runs as a part of it."""

import re
import shutil
import tomllib
from pathlib import Path
from typing import Any

import anyio
import httpx
import pytest
import viser

from studio.app import create_app
from studio.recordings import Recordings
from studio.settings import Settings
from tests import forked
from tests.packages import ROOT, beside, python, write_package

CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()
FILES = dict(re.findall(r"^```python\n# robots/(\w+)\.py\n(.*?)^```$", CONTRIBUTING, re.DOTALL | re.MULTILINE))
OF_THE_STUDIO = dict(
    re.findall(r"^```python\n# studio/([\w/]+)\.py\n(.*?)^```$", CONTRIBUTING, re.DOTALL | re.MULTILINE)
)
(POINTS,) = re.findall(r"^```toml\n(.*?)^```$", CONTRIBUTING, re.DOTALL | re.MULTILINE)
RUN = """
from itertools import islice
from morph_core import make_method, make_task, start
from morph_core.catalogue import broken_plugins

assert not broken_plugins(), broken_plugins()
small = {{"trajectories": 8, "hidden": 16, "ppo.epochs": 1, "ppo.minibatches": 1}}
for name, named, settings in {runs!r}:
    task = make_task(name)
    method = make_method(named, task, small | settings)
    state = start(task, method, seed=0)
    progress = list(islice(method.iterations(task, state), 2))
    print(method.rules(), "|", progress[-1].iteration, state.phi.tolist() != task.design_space.initial.tolist())
"""
RUNS = [
    ("spoke", "morph", {}, "z explored by design, φ searched by cma, projection none"),
    ("reacher", "morph", {"search": "compass", "search.step": 0.2}, "z explored by design, φ searched by compass"),
    ("reacher", "morph", {"exploration": "signs"}, "z explored by signs, φ searched by cma"),
    ("reacher", "best_of", {"designs.sigma": 2.0}, "φ is the design whose episode returned most"),
    ("spoke", "best_of", {}, "φ is the design whose episode returned most"),
    (
        "spoke",
        "morph",
        {"exploration": "signs", "search": "compass", "search.step": 0.01},
        "z explored by signs, φ searched by compass",
    ),
]
"""Task, method, settings, and what such a run says of its rules."""
ADDED = [("searches", "compass", {"search": "compass"}), ("explorations", "signs", {"exploration": "signs"})]
"""Where one new file goes, the name of what it adds, and how it is asked for."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the package of the recipes is installed."""
    site = tmp_path_factory.mktemp("recipes")
    groups = tomllib.loads(POINTS)["project"]["entry-points"]
    lines = [line for group, points in groups.items() for line in (f"[{group}]", *map(" = ".join, points.items()))]
    write_package(site, "robots", "\n".join(lines), '"""The package of the recipes."""')
    (site / "robots").mkdir()
    shutil.move(site / "robots.py", site / "robots" / "__init__.py")
    for name, source in FILES.items():
        (site / "robots" / f"{name}.py").write_text(source)
    return site


def test_every_entry_point_of_the_recipes_has_its_file() -> None:
    named = [place for points in tomllib.loads(POINTS)["project"]["entry-points"].values() for place in points.values()]
    assert {place.split(":")[0] for place in named} == {f"robots.{name}" for name in FILES}
    assert len(named) == 4


@pytest.fixture(scope="module")
def shown(site: Path) -> list[str]:
    """What the runs of the recipes print."""
    runs = [(task, method, settings) for task, method, settings, _ in RUNS]
    program = forked.python(RUN.format(runs=runs), beside(site))
    assert program.wait() == 0, program.said("errors")
    return program.said("output").splitlines()


@pytest.mark.parametrize(("run", "rules"), [(i, rules) for i, (*_, rules) in enumerate(RUNS)])
def test_what_a_recipe_shows_runs(shown: list[str], run: int, rules: str) -> None:
    said, did = shown[run].split(" | ")
    assert said.startswith(rules)
    assert did == "2 True"


@pytest.mark.slow
def test_in_this_repository_a_new_file_is_all_it_takes(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "morph_core", tmp_path / "morph_core", ignore=shutil.ignore_patterns("__pycache__"))
    for folder, name, _ in ADDED:
        (tmp_path / "morph_core" / folder / f"{name}.py").write_text(FILES[name])
    runs = [("reacher", "morph", settings) for *_, settings in ADDED]
    shown = python(RUN.format(runs=runs), tmp_path).splitlines()
    for (_, name, _), line in zip(ADDED, shown, strict=True):
        said, did = line.split(" | ")
        assert name in said
        assert did == "2 True"


def shown_in(path: str) -> dict[str, Any]:
    """Return the names of a file of the studio that CONTRIBUTING shows and the studio does not have."""
    assert not (ROOT / "studio" / f"{path}.py").exists()
    names: dict[str, Any] = {}
    exec(compile(OF_THE_STUDIO[path], path, "exec"), names)
    return names


def test_the_route_of_the_recipe_answers_and_refuses(tmp_path: Path) -> None:
    token = {"Authorization": "Bearer a token of this test"}
    app = create_app(Settings(runs=tmp_path / "runs", state=tmp_path, token="a token of this test"))
    app.include_router(shown_in("api/mass")["mass_router"](app.state.runs))

    async def ask(design: str, headers: dict[str, str]) -> httpx.Response:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1:8000") as client:
            return await client.get(f"/api/runs/recorded-pen_press/mass?design={design}", headers=headers)

    found = anyio.run(ask, "0", token)
    assert (found.status_code, 0.1 < found.json() < 5) == (200, True)
    assert anyio.run(ask, "x", token).status_code == 404
    assert anyio.run(ask, "0", {}).status_code == 401


def test_the_panel_of_the_recipe_shows_a_run() -> None:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    panel = shown_in("viewer/mass")["MassPanel"](server.gui)
    panel.update(Recordings().get("recorded-reacher").history, 0)
    assert re.search(r"\d g", panel.words.content)
    panel.clear()
    assert panel.words.content == ""
    server.stop()


def test_the_lines_of_a_recipe_are_as_long_as_ours() -> None:
    assert FILES
    shown = [*FILES.values(), *OF_THE_STUDIO.values()]
    assert [line for source in shown for line in source.splitlines() if len(line) > 120] == []
